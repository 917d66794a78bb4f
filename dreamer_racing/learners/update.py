"""Base class of learners with a world model: gradient step, averaged weights and saved state around the losses.

Shape legend: B batch, T time, N environments, D belief, S state, F = D + S features.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.gradient_step import (
    FiniteGuard,
    GraphedStep,
    check_scalars,
    gradient_norms,
    restore,
    step_with_gradients,
)
from dreamer_racing.learners.learner import Timer, ValueFunction, seeded, untimed
from dreamer_racing.learners.saved import UnmatchedWeights, check_saved, check_weights, load_parameters, own_state
from dreamer_racing.losses import Latents, LossConfig, WorldModelLoss, find_targets, policy_drift, replay_critic_loss
from dreamer_racing.modules import Agent, DreamerPolicy, Interface, ModelSize, get_size
from dreamer_racing.modules.layers import autocast, cast_once, use_few_kernels
from dreamer_racing.modules.rssm import CONTEXT, LatentFormat, join_features
from dreamer_racing.settings import check_settings


class WorldModelLearner(ABC):
    """Base of learners that minimise the losses of ``compute_losses``.

    Attributes:
        algorithm: Name of the algorithm; a checkpoint belongs to one algorithm.
        loss_config: Settings of the losses.
        world_model_loss: Loss of the agent's world model.
        behavior: Names of the agent's networks that the optimiser trains besides the world model.
        own_networks: Networks that are not part of the agent, by name: the world-model loss with the networks of its
            targets, and those of the algorithm.
        optimizer: Optimiser with a group for the world model and for each of the ``behavior`` networks.
        latents: Belief and state of the last batch's records, ``[B, T]``, to refresh the replay's latents; with
            ``cuda_graph`` the next update overwrites them.
        averaged: Copy of the agent with exponentially averaged weights, or None.
        discount: γ, a scalar that ``adjust`` can change.
        entropy_scale: Weight of the actor's entropy, likewise.
        horizon: H, imagined actions from each start.
        updates: Number of updates so far.

    Raises:
        ValueError: If a setting is out of its range, or a loss is unknown.
    """

    algorithm: ClassVar[str]
    behavior: ClassVar[Sequence[str]]
    Losses: ClassVar[type[LossConfig]]

    def __init__(self, agent: Agent, losses: LossConfig | None = None, config: LearnerConfig | None = None) -> None:
        self.loss_config = losses or self.Losses()
        self.config = config or LearnerConfig()
        check_settings(self.loss_config)
        check_settings(self.config)
        if self.loss_config.min_std > self.loss_config.max_std:
            raise ValueError(f"min_std={self.loss_config.min_std} is above max_std={self.loss_config.max_std}.")
        self.agent = agent
        self.device = next(agent.parameters()).device
        self.world_model_loss = WorldModelLoss(agent, self.loss_config).to(self.device)
        self.own_networks: dict[str, nn.Module] = {"world_model_loss": self.world_model_loss, **self.make_networks()}
        self.discount = torch.tensor(float(self.loss_config.discount), device=self.device)
        self.entropy_scale = torch.tensor(float(self.loss_config.entropy_scale), device=self.device)
        few = self.device.type == "cuda" if self.config.few_kernels is None else self.config.few_kernels
        self._casts_once = few and bool(self.config.mixed_precision)
        if few:
            use_few_kernels(nn.ModuleList([agent, *self.own_networks.values()]))
        self.averaged = None if self.config.average_rate is None else copy.deepcopy(agent).requires_grad_(False)
        self.latents: TensorDictBase  # of the last batch
        self.horizon = self.config.imagination_horizon
        self.updates = 0
        self._trained = self._parameters()
        self.optimizer = self._make_optimizer()
        self._rates = [group["lr"] for group in self.optimizer.param_groups]
        self._guard = FiniteGuard(lag=2 if self.device.type == "cuda" else 0)
        self._graph = self._make_graph() if self.config.cuda_graph else None

    @classmethod
    def make(
        cls,
        size: ModelSize | str,
        interface: Interface | None = None,
        losses: LossConfig | None = None,
        config: LearnerConfig | None = None,
        *,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> Self:
        """Make an agent and its learner.

        Args:
            size: Model size, or its name.
            interface: Observations and actions of the agent; ``Interface.of(env)`` derives it from an environment.
            losses: Settings of the losses.
            config: Settings of the update.
            device: Where the networks live and updates run.
            seed: Seed of the initial weights; None draws them from the global generator. Later sampling always uses the
                device's global generator, which your checkpoints should save, too.

        Raises:
            ValueError: If a setting is out of its range, or a loss is unknown.
        """
        losses = losses or cls.Losses()
        check_settings(losses)
        decodes = any(target.decodes for target in find_targets(losses.world_model))
        with seeded(seed):
            agent = Agent(get_size(size), interface or Interface(), decodes, losses.min_std, losses.max_std).to(device)
            return cls(agent, losses, config)

    @abstractmethod
    def compute_losses(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Return all losses (``loss_*``, which carry gradient) and metrics of a batch ``[B, T]``, scalars."""

    @abstractmethod
    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Learn from a batch of replayed records.

        Args:
            batch: Records ``[B, T]``: the encoder's observations, ``previous_action``, ``reward``, ``is_init``,
                ``terminated``, ``truncated``, scalars ``(B, T, 1)``; optionally ``context``, the stored latents, from
                which windows then start, and which ``drift_scale`` requires.
            timed: Makes a context manager that times an activity: ``world_model``, ``imagine`` (actor and critic, even
                if nothing is imagined), ``optimise``, ``exchange`` (between processes), ``improve``. The split is only
                meaningful on a CPU.

        Returns:
            Scalar tensors on the device: all losses and metrics that were computed, ``gradient_norm/<network>`` (before
            clipping) and ``loss``. Reading one waits for the device, so do it rarely.

        Raises:
            KeyError: If the batch lacks a key that a loss needs.
            NonFiniteLossError: If a loss, gradient or reward is not finite. On a CPU the networks are unchanged then,
                unless it was PPO's update; on a CUDA device it is raised two checks late, because waiting for the
                device would stall it.
        """

    @property
    def modules(self) -> nn.ModuleDict:
        """Modules that a gradient step reads and writes."""
        return nn.ModuleDict({"agent": self.agent, "world_model_loss": self.world_model_loss})

    def make_networks(self) -> dict[str, nn.Module]:
        """Make the algorithm's networks that are not part of the agent, by name; here none."""
        return {}

    @property
    def weights(self) -> list[Tensor]:
        """Parameters of all networks, including the averaged ones."""
        averaged = [] if self.averaged is None else [self.averaged]
        return list(nn.ModuleList([self.agent, *self.own_networks.values(), *averaged]).parameters())

    @property
    def size(self) -> ModelSize:
        """Size of the networks."""
        return self.agent.size

    @property
    def latent_format(self) -> LatentFormat:
        """Format in which a replay buffer stores this learner's latents."""
        return self.agent.world_model.rssm.latent_format

    @property
    def evaluation_agent(self) -> Agent:
        """Agent that is evaluated and exported: the averaged one if it is kept, else the trained one."""
        return self.agent if self.averaged is None else self.averaged

    def policy(self, deterministic: bool = False) -> DreamerPolicy:
        """Return the policy of the trained networks, which shares their parameters."""
        return DreamerPolicy(self.agent.world_model, self.agent.actor, deterministic)

    def evaluation_policy(self) -> DreamerPolicy:
        """Return the policy of `evaluation_agent`, which shares its parameters."""
        return DreamerPolicy(self.evaluation_agent.world_model, self.evaluation_agent.actor)

    @property
    def learning_rates(self) -> dict[str, float]:
        """Current learning rates by what they train."""
        rates = [group["lr"] for group in self.optimizer.param_groups]
        return dict(zip(("world_model", *self.behavior), rates, strict=True))

    def value_function(self) -> ValueFunction:
        """Return the value function of the critic that the actor learns from."""
        return self._value

    @torch.no_grad()
    def _value(self, acted: TensorDictBase) -> Tensor:
        """Return the critic's values ``(N, 1)`` at the latents that `DreamerPolicy` wrote under "next"."""
        after = acted["next"].select("belief", "state").to(self.device)
        return self.evaluation_agent.critic.value(join_features(after["belief"], after["state"]))

    def open_loop(self, batch: TensorDictBase, num_observed: int) -> tuple[Tensor, Tensor]:
        """Observe the first ``num_observed`` records of a batch ``[B, T]``, then predict the others from their actions.

        Always by the trained networks, not the averaged ones, because the decoders of targets have no average.

        Returns:
            Beliefs ``(B, T, D)`` and states ``(B, T, S)``.
        """
        batch = batch.to(self.device)
        return self.agent.world_model.open_loop(
            batch, batch.get("previous_action"), batch.get("is_init").squeeze(-1), num_observed
        )

    def drift_losses(self, latents: Latents, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return ``loss_drift`` and ``policy_drift`` of a batch ``[B, T]`` with stored latents, if turned on."""
        scale = self.loss_config.drift_scale
        if not scale:
            return {}
        if batch.get(CONTEXT, None) is None:
            raise KeyError(
                f"drift_scale={scale:g} compares the policy at stored and at new latents, but the batch has no "
                f"{CONTEXT!r}: store latents (replay.context=true), or set drift_scale=0."
            )
        before, after, same = self.stored_and_current_features(latents, batch)
        drift = policy_drift(self.agent.actor, before, after, same.float())
        return {"loss_drift": scale * drift, "policy_drift": drift.detach()}

    def replay_critic_losses(
        self, latents: Latents, batch: TensorDictBase, bootstrap: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return ``loss_replay_critic`` of a batch ``[B, T]``, if turned on: the agent's critic learns its λ-returns.

        With ``replay_value_gradient`` the latents learn to tell what these depend on, too. The returns continue with
        the ``bootstrap`` values ``(B, T, 1)``; None for the critic's own.
        """
        numbers = self.loss_config
        if not numbers.replay_value_scale:
            return {}
        features = latents.features if numbers.replay_value_gradient else latents.features.detach()
        loss = replay_critic_loss(
            self.agent.critic, features, batch, self.discount, numbers.lambda_, numbers.slow_critic_scale, bootstrap
        )
        return {"loss_replay_critic": numbers.replay_value_scale * loss}

    def stored_and_current_features(self, latents: Latents, batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return the stored and the current features of records; each stores the latents of the one before it.

        Returns:
            Stored and current features of all records but the last, ``(B, T - 1, F)`` each, and a bool mask
            ``(B, T - 1, 1)`` that is False where the next record begins an episode, and so stores other latents.
        """
        before = join_features(*self.latent_format.unpack(batch[CONTEXT][:, 1:]))
        return before, latents.features[:, :-1], ~batch["is_init"][:, 1:]

    def gradient_step(self, batch: TensorDictBase, timed: Timer) -> dict[str, Tensor]:
        """Make one gradient step on a batch ``[B, T]``; return its losses and metrics as `update` does."""
        batch = batch.to(self.device, non_blocking=True)
        if not self.config.cuda_graph:  # here, so that gradients of a refused batch do not remain
            self.optimizer.zero_grad(set_to_none=True)
        metrics = self._backward(batch, timed) if self._graph is None else self._graph(batch)
        if parallel.num_processes() > 1:
            # One all-reduce of a flat tensor, outside of the captured graph, instead of `DistributedDataParallel`: one
            # backward pass serves several losses, and a non-finite metric reaches all processes with the gradients, so
            # that all stop at the same update.
            with timed("exchange"):
                networks = (parameter for parameters in self._trained.values() for parameter in parameters)
                metrics = parallel.average_gradients(networks, metrics) | gradient_norms(self._trained)
        self._guard.check(metrics, batch)
        with timed("optimise"):
            step_with_gradients(self.optimizer)
            self.agent.critic.update_slow(self.config.slow_critic_rate)
        self.updates += 1
        return metrics

    def _backward(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Compute losses and gradients of a batch; return detached scalars."""
        cast_weights = cast_once(self.modules, torch.bfloat16) if self._casts_once else nullcontext()
        with self.autocast(), cast_weights:
            metrics = self.compute_losses(batch, timed)
        check_scalars(metrics)
        total = torch.stack([value for key, value in metrics.items() if key.startswith("loss_")]).sum()
        with timed("optimise"):
            total.backward()
            norms = gradient_norms(self._trained)
        return {key: value.detach() for key, value in (metrics | norms | {"loss": total}).items()}

    @torch.no_grad()
    def average_weights(self) -> None:
        """Update the averaged weights, if they are kept; during the first updates they are the plain mean of all."""
        if self.averaged is not None and self.config.average_rate is not None:
            rate = max(self.config.average_rate, 1.0 / self.updates)
            torch._foreach_lerp_(list(self.averaged.parameters()), list(self.agent.parameters()), rate)

    def adjust(
        self,
        *,
        rates: float | None = None,
        world_model_rate: float = 1.0,
        discount: float | None = None,
        entropy_scale: float | None = None,
        min_std: float | None = None,
        max_std: float | None = None,
        **others: Any,
    ) -> None:
        """Set scheduled hyperparameters, from the next update on; the others stay as they are.

        These are settings, not state: call it again after `load_state_dict`.

        Args:
            rates: Factor on the configured learning rates of all optimisers.
            world_model_rate: Further factor on the world model's learning rate; needs ``rates``.
            discount: γ.
            entropy_scale: Weight of the actor's entropy.
            min_std: Smallest standard deviation of actions, for the trained and the averaged actor.
            max_std: Largest standard deviation of actions, likewise.
            others: Hyperparameters of other algorithms, which are refused by a ``TypeError``.

        Raises:
            ValueError: If ``world_model_rate`` is given without ``rates``.
        """
        if others:
            raise TypeError(
                f"adjust({', '.join(sorted(others))}=...): a learner of {self.algorithm} has no such hyperparameter."
            )
        if rates is None and world_model_rate != 1.0:
            raise ValueError(f"adjust(world_model_rate={world_model_rate:g}) is a factor on rates: give rates=, too.")
        if rates is not None:
            for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
                group["lr"] = rate * rates
            self.optimizer.param_groups[0]["lr"] *= world_model_rate
        fill_given((self.discount, discount), (self.entropy_scale, entropy_scale))
        for name, bound in (("min_std", min_std), ("max_std", max_std)):
            if bound is not None:
                for agent in (self.agent, self.evaluation_agent):
                    agent.actor.get_buffer(name).fill_(bound)

    def check_finite(self) -> None:
        """Wait for pending updates, so that no bad weights are saved.

        Raises:
            NonFiniteLossError: If one of them was not finite.
        """
        self._guard.settle()

    def autocast(self) -> torch.autocast:
        """Return the autocast context of the networks: bfloat16 if ``mixed_precision``, else off."""
        return autocast(self.device, bool(self.config.mixed_precision))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, except the global random generators."""
        return {
            "algorithm": self.algorithm,
            "size": asdict(self.size),
            "image_size": self.agent.interface.image_size,
            "agent": self.agent.state_dict(),
            "own_networks": {name: own_state(network, self.agent) for name, network in self.own_networks.items()},
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
            **({} if self.averaged is None else {"averaged": self.averaged.state_dict()}),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned.

        Raises:
            ValueError: If it was saved with another algorithm, model size, loss or environment; nothing is changed
                then.
        """
        check_saved(state_dict, self.algorithm, self.agent, self.own_networks)
        self.agent.load_state_dict(state_dict["agent"])
        for name, network in self.own_networks.items():
            network.load_state_dict(state_dict["own_networks"][name], strict=False)
        if self.averaged is not None:
            self.averaged.load_state_dict(state_dict.get("averaged", state_dict["agent"]))
        restore(self.optimizer, state_dict["optimizer"])
        self.updates = state_dict["updates"]

    def adopt(self, state_dict: dict[str, Any], behavior: bool = True) -> UnmatchedWeights:
        """Load the weights of another learner's ``state_dict``, whatever its algorithm; return what remains unmatched.

        They are the weights that were evaluated: the averaged ones if it kept them. Nothing else is loaded: no
        optimiser, counters, bounds of the actor's standard deviation, collected steps or statistics. A network outside
        the agent that the other learner lacks, such as a critic of the state, keeps its initial weights.

        Args:
            state_dict: Of the other learner.
            behavior: Whether actor and critics are loaded, too; if not, only the world model with its targets.

        Raises:
            ValueError: If it was saved with another model size or environment; nothing is changed then.
        """
        unmatched = check_weights(state_dict, self.agent, self.own_networks)
        flying = state_dict.get("averaged", state_dict["agent"])
        if not behavior:
            flying = {name: value for name, value in flying.items() if name.startswith("world_model.")}
        for agent in filter(None, (self.agent, self.averaged)):
            load_parameters(agent, flying)
        for name, network in self.own_networks.items():
            if behavior or name == "world_model_loss":
                load_parameters(network, state_dict["own_networks"].get(name, {}))
        return unmatched

    def _parameters(self) -> dict[str, list[nn.Parameter]]:
        """Return the trained parameters by network; the world model's include those of its loss."""
        networks: dict[str, list[nn.Module]] = {"world_model": [self.agent.world_model, self.world_model_loss]}
        networks |= {name: [self.agent.get_submodule(name)] for name in self.behavior}
        return {
            name: [p for p in nn.ModuleList(parts).parameters() if p.requires_grad] for name, parts in networks.items()
        }

    def _make_optimizer(self) -> torch.optim.Optimizer:
        """Make the optimiser of the 2025 reference, LaProp with adaptive gradient clipping."""
        from torchrl.trainers.algorithms import DreamerV3Optimizer

        rate = self.config.learning_rate
        groups: list[dict[str, Any]] = [{"params": self._trained["world_model"], "lr": rate}]
        groups += [
            {"params": self._trained[name], "lr": self.config.behavior_learning_rate or rate} for name in self.behavior
        ]
        return DreamerV3Optimizer(groups, lr=rate, warmup_steps=self.config.warmup_updates)

    def _make_graph(self) -> GraphedStep:
        """Return ``_backward`` as a step that is replayed as one CUDA graph."""
        if self.device.type != "cuda":
            raise ValueError(f"cuda_graph=True needs a CUDA device, but the learner is on {str(self.device)!r}.")
        return GraphedStep(self._backward, self.modules)

    def store_latents(self, latents: Latents) -> None:
        """Keep the latents of a batch's records, to refresh those in the replay buffer."""
        shape = latents.belief.shape[:2]
        self.latents = TensorDict({"belief": latents.belief.detach(), "state": latents.state.detach()}, shape)


def fill_given(*numbers: tuple[Tensor, float | None]) -> None:
    """Set scalar tensors, which a captured CUDA graph reads, to the values beside them, if these are not None."""
    for number, value in numbers:
        if value is not None:
            number.fill_(value)
