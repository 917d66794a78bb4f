"""Networks, policy and base class of the model-free learners PPO and SAC.

The networks are a CNN for images, the symlog of IMU readings, raw vectors, then one MLP.

Shape legend: N any batch, A action, O outputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from dreamer_racing.learners.gradient_step import FiniteGuard, gradient_norms, restore
from dreamer_racing.learners.learner import ValueFunction
from dreamer_racing.modules import Interface
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.interface import IMU, PIXELS


@dataclass
class NetworkSize:
    """Hidden layers of actor and critic.

    Attributes:
        layers: Number of hidden layers. Reference: paper, Section IV: four-layer MLPs.
        units: Width of the hidden layers. Reference: paper, Section IV: 768.
    """

    layers: int = 4
    units: int = 768


class ImageTrunk(nn.Module):
    """Three convolutions and a linear layer for images of at least 36 × 36 pixels.

    The paper only says "a CNN"; this is the CNN of Stable-Baselines3, on which its code builds.

    Example:
        >>> ImageTrunk()(torch.zeros(2, 64, 64, 3, dtype=torch.uint8)).shape
        torch.Size([2, 512])

    Reference: Mnih et al. 2015, "Human-level control through deep reinforcement learning", Methods.
    """

    features = 512
    smallest_image = 36

    def __init__(self, image_size: int = 64) -> None:
        super().__init__()
        if image_size < self.smallest_image:
            raise ValueError(
                f"image_size={image_size}: the CNN of the baselines needs images of at least {self.smallest_image} × "
                f"{self.smallest_image} pixels."
            )
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Conv2d(64, 64, 3, 1), nn.ReLU()
        )
        with torch.no_grad():
            flat = self.convolutions(torch.zeros(1, 3, image_size, image_size)).numel()
        self.linear = nn.Linear(flat, self.features)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map images uint8 ``(..., H, W, 3)`` to ``(..., 512)``."""
        batch = pixels.shape[:-3]
        maps = self.convolutions(pixels.flatten(0, -4).permute(0, 3, 1, 2).float().div_(255.0))
        return self.linear(maps.flatten(1)).relu().view(*batch, self.features)


class ObservationNetwork(nn.Module):
    """Network from the observations under ``in_keys``, and optionally an action, to O outputs.

    The initial weights of the last layer are multiplied by ``output_scale``.

    Example:
        >>> network = ObservationNetwork(Interface(pixels=False, vector_dim=21), 1, NetworkSize(2, 32))
        >>> network(torch.zeros(5, 21)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self, interface: Interface, outputs: int, size: NetworkSize, with_action: bool = False, output_scale: float = 1
    ) -> None:
        super().__init__()
        self.in_keys = [*interface.observation_keys, *(["action"] if with_action else [])]
        self.trunk = ImageTrunk(interface.image_size) if interface.pixels else None
        inputs = (ImageTrunk.features if interface.pixels else 0) + interface.vector_dim
        inputs += interface.action_dim if with_action else 0
        layers: list[nn.Module] = []
        for _ in range(size.layers):
            layers += [nn.Linear(inputs, size.units), nn.ELU()]
            inputs = size.units
        last = nn.Linear(inputs, outputs)
        last.weight.data *= output_scale
        last.bias.data.zero_()
        self.mlp = nn.Sequential(*layers, last)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map the tensors under ``in_keys`` to ``(..., O)``."""
        preprocess = {PIXELS: self.trunk, IMU: symlog}
        parts = []
        for key, value in zip(self.in_keys, inputs, strict=True):
            function = preprocess.get(key)
            parts.append(value if function is None else function(value))
        return self.mlp(parts[0] if len(parts) == 1 else torch.cat(parts, -1))


class GaussianNetwork(nn.Module):
    """An ``ObservationNetwork`` whose outputs ``parameters`` turns into ``loc`` and ``scale`` of a distribution."""

    def __init__(self, network: ObservationNetwork, parameters: nn.Module) -> None:
        super().__init__()
        self.in_keys = network.in_keys
        self.network = network
        self.parameters_of = parameters

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Map the tensors under ``in_keys`` to ``loc`` and ``scale``, ``(..., A)``."""
        return self.parameters_of(self.network(*inputs))


class NetworkModule(TensorDictModuleBase):
    """Module that applies a network to keys of a TensorDict, a faster ``TensorDictModule``.

    ``TensorDictModule`` looks for pandas on the disk at every write (tensordict 0.14.3), which takes a tenth of the
    time of SAC from vectors.
    """

    def __init__(self, network: ObservationNetwork | GaussianNetwork, out_keys: list[str]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(network.in_keys), list(out_keys)
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the outputs."""
        outputs = self.network(*(tensordict.get(key) for key in self.in_keys))
        for key, value in zip(self.out_keys, outputs if isinstance(outputs, tuple) else (outputs,), strict=True):
            tensordict.set(key, value)
        return tensordict


def make_actor(network: ObservationNetwork, parameters: nn.Module, distribution: type) -> ProbabilisticActor:
    """Make an actor that samples from a distribution with the ``loc`` and ``scale`` that ``parameters`` returns."""
    return ProbabilisticActor(
        NetworkModule(GaussianNetwork(network, parameters), ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        return_log_prob=True,
    )


class BaselinePolicy(TensorDictModuleBase):
    """Policy of an actor without memory, which is shared, not copied.

    Args:
        actor: The actor.
        deterministic: Act by the distribution's ``deterministic_sample``; may be set at any time.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential, deterministic: bool = False) -> None:
        super().__init__()
        self.in_keys = list(actor.in_keys)
        self.out_keys = list(actor.out_keys)
        self.actor = actor
        self.deterministic = deterministic

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(..., A)`` and the actor's other outputs."""
        kind = ExplorationType.DETERMINISTIC if self.deterministic else ExplorationType.RANDOM
        with set_exploration_type(kind):
            return self.actor(tensordict)

    def make_primer(self) -> Transform:
        """Return an empty transform, because this policy has no recurrent state."""
        return Compose()


def layers_of(size: NetworkSize, interface: Interface) -> dict[str, Any]:
    """Return the description of networks that a checkpoint keeps: their hidden layers and their inputs."""
    image_size = interface.image_size if interface.pixels else None
    widths = {"numbers": interface.vector_dim, "actions": interface.action_dim}
    return {**asdict(size), "image_size": image_size, "imu": interface.vector_key == IMU, **widths}


def check_layers(saved: dict[str, Any], present: dict[str, Any]) -> None:
    """Check that ``layers_of`` saved networks are those of this learner's.

    Raises:
        ValueError: If they differ.
    """
    if (saved["image_size"] is None) is not (present["image_size"] is None):
        there, here = (str(layers["image_size"] is not None).lower() for layers in (saved, present))
        raise ValueError(
            f"The checkpoint's networks were made with env.from_pixels={there}, this learner's with {here}: set "
            f"env.from_pixels={there}, or start a new run."
        )
    if (there := saved["imu"]) is not present["imu"]:
        raise ValueError(
            f"The checkpoint's networks were made {'with' if there else 'without'} env.imu, and this learner's are "
            f"made {'without' if there else 'with'} it: set it as it was, or start a new run."
        )
    for key, setting in (("layers", "network.layers"), ("units", "network.units"), ("image_size", "env.image_size")):
        if saved[key] != present[key]:
            raise ValueError(
                f"The checkpoint's networks were made with {setting}={saved[key]}, this learner's with {present[key]}: "
                f"set {setting}={saved[key]}, or start a new run."
            )
    for key, what in (("numbers", "observed numbers, as of env.vector"), ("actions", "actions")):
        if (there := saved[key]) != present[key]:
            raise ValueError(
                f"The checkpoint's networks were made for {there} {what}, this learner's for {present[key]}: set it as "
                "it was, or start a new run."
            )


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
        restore(self.optimizer, state_dict["optimizer"])
        self.updates = state_dict["updates"]

    def _gradient_step(
        self, loss: Tensor, metrics: dict[str, Tensor], batch: TensorDictBase, clip: float | None = None
    ) -> dict[str, Tensor]:
        """Make a gradient step, each network's norm clipped, and return all metrics.

        Raises:
            NonFiniteLossError: If something is not finite: on a CPU before the step, on a CUDA device two checks later.
        """
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
