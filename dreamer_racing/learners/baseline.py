"""Base class of the model-free learners PPO and SAC."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn

from dreamer_racing.learners.gradient_step import FiniteGuard, gradient_norms
from dreamer_racing.learners.learner import ValueFunction
from dreamer_racing.learners.networks import BaselinePolicy, NetworkSize, check_layers, layers_of
from dreamer_racing.modules import Interface


class BaselineLearner(ABC):
    """Base of learners with an actor, one optimiser and a saved state.

    Attributes:
        actor: Network of the policy.
        networks: Trained parameters by the name of their network.
        optimizer: Optimiser of all networks.
        device: Where the networks live and updates run.
        updates: Number of gradient steps so far.
    """

    actor: ProbabilisticTensorDictSequential
    networks: dict[str, list[nn.Parameter]]
    optimizer: torch.optim.Optimizer

    def __init__(self, size: NetworkSize, interface: Interface, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.updates = 0
        self._keys = interface.observation_keys
        self._size = layers_of(size, interface)
        self._guard = FiniteGuard(lag=2 if self.device.type == "cuda" else 0)

    def policy(self, deterministic: bool = False) -> BaselinePolicy:
        """Return the policy that is trained, which shares this learner's parameters."""
        return BaselinePolicy(self.actor, deterministic)

    def evaluation_policy(self) -> BaselinePolicy:
        """Return the policy that is trained, because no weights are averaged."""
        return self.policy()

    def value_function(self) -> ValueFunction | None:
        """Return the critic's value function; None for learners without a critic of states."""
        return None

    def check_finite(self) -> None:
        """Wait for pending updates; raise ``NonFiniteLossError`` if one of them was not finite."""
        self._guard.settle()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, except the global random generators."""
        parts = {name: module.state_dict() for name, module in self._modules().items()}
        return {"size": self._size, **parts, "optimizer": self.optimizer.state_dict(), "updates": self.updates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned.

        Raises:
            ValueError: If the networks have another size; nothing is changed then.
        """
        check_layers(state_dict["size"], self._size)
        for name, module in self._modules().items():
            module.load_state_dict(state_dict[name])
        rate = self.optimizer.param_groups[0]["lr"]
        self.optimizer.load_state_dict(state_dict["optimizer"])
        self.optimizer.param_groups[0]["lr"] = rate  # a setting of this learner, not state
        self.updates = state_dict["updates"]

    def _gradient_step(
        self, loss: Tensor, metrics: dict[str, Tensor], batch: TensorDictBase, clip: float | None = None
    ) -> dict[str, Tensor]:
        """Make a gradient step unless something is not finite, each network's norm clipped; return all metrics."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norms = gradient_norms(self.networks)
        if clip is not None:
            for name, parameters in self.networks.items():
                nn.utils.clip_grads_with_norm_(parameters, clip, norms[f"gradient_norm/{name}"])
        metrics = {name: value.detach() for name, value in {**metrics, **norms, "loss": loss}.items()}
        self._guard.check(metrics, batch)
        self.optimizer.step()
        self.updates += 1
        return metrics

    @abstractmethod
    def _modules(self) -> dict[str, nn.Module]:
        """Return the modules to save, by name."""
