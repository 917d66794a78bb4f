"""What every learner with a world model needs around its losses: one gradient step, averaged weights, and its state.

Shape legend: B batch, T time, N environments, D belief, S state, F = D + S features.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.gradient_step import FiniteGuard, GraphedStep, gradient_norms, make_optimizer, restore
from dreamer_racing.learners.learner import Timer, ValueFunction, seeded, untimed
from dreamer_racing.learners.saved import Unmatched, check_saved, check_weights, load_parameters, own_state
from dreamer_racing.losses import Latents, LossConfig, WorldModelLoss, find_targets, policy_drift
from dreamer_racing.modules import Agent, DreamerPolicy, Interface, ModelSize, get_size
from dreamer_racing.modules.few_kernels import cast_once, save_kernels
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.rssm import CONTEXT, LatentFormat, join_features
from dreamer_racing.settings import check_settings


class WorldModelLearner(ABC):
    """Trains an agent's networks by what ``compute_losses`` of an algorithm returns.

    Args:
        agent: The networks, on the device where updates run.
        losses: Numbers of the losses.
        config: Numbers of the update.

    Attributes:
        algorithm: Its name; a checkpoint is of one algorithm.
        loss_config: Numbers of the losses.
        world_model_loss: Of the agent's world model.
        behavior: Networks of the agent that the optimiser trains beside the world model.
        own_networks: That are no part of the agent, by their names: the world-model loss, with what its targets learn,
            and those of the algorithm.
        optimizer: Of both; its first group is the world model, its second the behaviour.
        latents: Belief and state of the last batch's records, ``[B, T]``, for the replay's context; on a CUDA device
            with ``cuda_graph`` the next update writes over them.
        averaged: A copy of the agent whose weights are averages, if they are kept.
        discount: γ, a scalar; ``adjust`` moves it.
        entropy_scale: Weight of the actor's entropy, a scalar; likewise.
        horizon: H, imagined actions from each start.
        updates: Made so far.

    Raises:
        ValueError: If a number is out of its range, or there is no loss of a name.
    """

    algorithm: ClassVar[str]
    behavior: ClassVar[Sequence[str]]
    Losses: ClassVar[type[LossConfig]]

    def __init__(self, agent: Agent, losses: LossConfig | None = None, config: LearnerConfig | None = None) -> None:
        self.loss_config = losses or self.Losses()
        self.config = config or LearnerConfig()
        check_settings(self.loss_config)
        check_settings(self.config)
        self.agent = agent
        self.device = next(agent.parameters()).device
        self.world_model_loss = WorldModelLoss(agent, self.loss_config).to(self.device)
        self.own_networks: dict[str, nn.Module] = {"world_model_loss": self.world_model_loss, **self.make_networks()}
        self.discount = torch.tensor(float(self.loss_config.discount), device=self.device)
        self.entropy_scale = torch.tensor(float(self.loss_config.entropy_scale), device=self.device)
        few = self.device.type == "cuda" if self.config.few_kernels is None else self.config.few_kernels
        self._casts_once = few and bool(self.config.mixed_precision)
        if few:
            save_kernels(nn.ModuleList([agent, *self.own_networks.values()]))
        self.averaged = None if self.config.average_rate is None else copy.deepcopy(agent).requires_grad_(False)
        self.latents: TensorDictBase | None = None
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
        """Make the networks of an agent, and their learner.

        Args:
            size: Of the networks, or its name.
            interface: What the agent sees and does; ``Interface.of(env)`` reads it off an environment.
            losses: Numbers of the losses.
            config: Numbers of the update.
            device: Where the networks live and updates run.
            seed: Of the initial weights; None takes them from the global generator. Later sampling always uses the
                global generator of the device, which a checkpoint of yours should save.

        Raises:
            ValueError: If a number is out of its range, or there is no loss of a name.
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
            batch: Batch size ``[B, T]``: what the encoder sees, ``previous_action``, ``reward``, ``is_init``,
                ``terminated``, ``truncated``; scalars ``(B, T, 1)``; and ``context``, from whose first record windows
                go on where it is there, and which ``drift_scale`` needs.
            timed: Context manager by activity (``world_model``, ``imagine``, of actor and critic whether they imagine
                or not, ``optimise``, ``improve``), to measure the time spent in each; tells them apart only on a CPU.

        Returns:
            Scalar tensors on the device: every loss and metric of those that were computed, ``gradient_norm/<network>``
            (before clipping) and ``loss``. Reading one waits for the device; do it seldom.

        Raises:
            KeyError: If the batch lacks what a loss reads.
            NonFiniteLossError: If loss, gradient or a reward is not finite. On a CPU no network has been changed by it;
                on a CUDA device this is noticed two updates late, because waiting for the device would stall it.
        """

    def collect(self, rollout: TensorDictBase) -> None:  # noqa: B027 - only on-policy learners need it
        """Take note of a collector's rollout ``[N, T]``, of `policy`, perhaps with older weights; here nothing."""

    @property
    def modules(self) -> nn.ModuleDict:
        """All that a gradient step reads and writes."""
        return nn.ModuleDict({"agent": self.agent, "world_model_loss": self.world_model_loss})

    def make_networks(self) -> dict[str, nn.Module]:
        """Make the networks of the algorithm that are no part of the agent, by their names; here none."""
        return {}

    @property
    def weights(self) -> list[Tensor]:
        """All that is learned: networks and averages."""
        averaged = [] if self.averaged is None else [self.averaged]
        return list(nn.ModuleList([self.agent, *self.own_networks.values(), *averaged]).parameters())

    @property
    def size(self) -> ModelSize:
        """Of the networks."""
        return self.agent.size

    @property
    def latent_format(self) -> LatentFormat:
        """How a replay keeps this learner's latents."""
        return self.agent.world_model.rssm.latent_format

    @property
    def flying_agent(self) -> Agent:
        """What is evaluated and exported: the averaged networks where they are kept, else those that are trained."""
        return self.agent if self.averaged is None else self.averaged

    def policy(self, deterministic: bool = False) -> DreamerPolicy:
        """Return the acting step of the networks that are trained, which shares their parameters."""
        return DreamerPolicy(self.agent.world_model, self.agent.actor, deterministic)

    def evaluation_policy(self) -> DreamerPolicy:
        """Return the acting step of `flying_agent`, which shares its parameters."""
        return DreamerPolicy(self.flying_agent.world_model, self.flying_agent.actor)

    def value_function(self) -> ValueFunction:
        """Return what the critic that teaches the actor makes of a state."""
        return self._value_of_latents

    @torch.no_grad()
    def _value_of_latents(self, acted: TensorDictBase) -> Tensor:
        """Return what the critic makes of the latents that `DreamerPolicy` has updated by what it saw, ``(N, 1)``."""
        after = acted["next"].select("belief", "state").to(self.device)
        return self.flying_agent.critic.value(join_features(after["belief"], after["state"]))

    def open_loop(self, batch: TensorDictBase, num_observed: int) -> tuple[Tensor, Tensor]:
        """Observe the first ``num_observed`` records of a batch ``[B, T]``, then predict the others from their actions.

        By the networks that are trained, also where averaged ones fly: a loss's own decoder has no average.

        Returns:
            Beliefs ``(B, T, D)`` and states ``(B, T, S)``.
        """
        batch = batch.to(self.device)
        return self.agent.world_model.open_loop(
            batch, batch.get("previous_action"), batch.get("is_init").squeeze(-1), num_observed
        )

    def drift_losses(self, latents: Latents, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return ``loss_drift`` and ``policy_drift`` at the records of a batch ``[B, T]`` whose latents are stored."""
        scale = self.loss_config.drift_scale
        if not scale:
            return {}
        if batch.get(CONTEXT, None) is None:
            raise KeyError(
                f"drift_scale={scale:g} holds the policy at the latents that records keep, and the batch has no "
                f"{CONTEXT!r}: replay with them (replay.context=true), or set drift_scale=0."
            )
        before, after, same = self.then_and_now(latents, batch)
        drift = policy_drift(self.agent.actor, before, after, same.float())
        return {"loss_drift": scale * drift, "policy_drift": drift.detach()}

    def then_and_now(self, latents: Latents, batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return features of records as they were stored and as the model makes them now.

        Args:
            latents: Of a batch's records now.
            batch: The records ``[B, T]``, with ``context``: each has the latents of the one before it.

        Returns:
            Both of all but the last record, ``(B, T - 1, F)``, and whether they are of the same one, bool
            ``(B, T - 1, 1)``: what the first record of an episode has stored is not of the one before it.
        """
        before = join_features(*self.latent_format.unpack(batch[CONTEXT][:, 1:]))
        after = join_features(latents.belief[:, :-1], latents.state[:, :-1])
        return before, after, ~batch["is_init"][:, 1:]

    def gradient_step(self, batch: TensorDictBase, timed: Timer) -> dict[str, Tensor]:
        """Make one gradient step on a batch ``[B, T]``; return what `update` does."""
        batch = batch.to(self.device, non_blocking=True)
        metrics = self._backward(batch, timed) if self._graph is None else self._graph(batch)
        if parallel.count() > 1:
            metrics = self._of_all_processes(metrics, timed)
        self._guard.check(metrics, batch)
        with timed("optimise"):
            self.optimizer.step()
            self.agent.critic.update_slow(self.config.slow_critic_rate)
            if not self.config.cuda_graph:
                self.optimizer.zero_grad(set_to_none=True)
        self.updates += 1
        return metrics

    def _backward(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Compute losses and gradients of a batch; return detached scalars."""
        with self.autocast(), self._weights():
            metrics = self.compute_losses(batch, timed)
        losses = {key: value for key, value in metrics.items() if key.startswith("loss_")}
        if shapes := {key: tuple(value.shape) for key, value in losses.items() if value.dim()}:
            raise ValueError(f"losses must be scalars, and these have shapes: {shapes}; take their means.")
        total = torch.stack(list(losses.values())).sum()
        with timed("optimise"):
            total.backward()
            norms = gradient_norms(self._trained)
        return {key: value.detach() for key, value in (metrics | norms | {"loss": total}).items()}

    def _of_all_processes(self, metrics: dict[str, Tensor], timed: Timer) -> dict[str, Tensor]:
        """Turn gradients and metrics of this process's share of the batch into those of the joint batch.

        One exchange of a flat tensor between backward and the optimiser's step, behind a captured graph, and not
        ``DistributedDataParallel``: gradients come from one backward through several losses, and a metric that is not
        finite reaches all processes with them, so that all stop at the same update.
        """
        with timed("exchange"):
            networks = (parameter for parameters in self._trained.values() for parameter in parameters)
            metrics = parallel.average_gradients(networks, metrics)
            return metrics | gradient_norms(self._trained)

    @torch.no_grad()
    def average_weights(self) -> None:
        """Move the averaged weights, if they are kept; while there are few updates they are the plain mean of all."""
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
        """Change what a run may have on a schedule, from the next update on; what is not named stays.

        These are settings, not state: call it again after `load_state_dict`.

        Args:
            rates: Share of the learning rates that the learner was made with, of all optimisers.
            world_model_rate: Share of that share, of the world model's alone; given together with ``rates``.
            discount: γ.
            entropy_scale: Weight of the actor's entropy.
            min_std: Smallest standard deviation of actions, of the networks' own.
            max_std: Largest.

            others: None that all learners have.

        Raises:
            TypeError: There are others.
            ValueError: ``world_model_rate`` is given alone.
        """
        if others:
            raise TypeError(
                f"adjust({', '.join(sorted(others))}=...): a learner of {self.algorithm} has no such number."
            )
        if rates is None and world_model_rate != 1.0:
            raise ValueError(f"adjust(world_model_rate={world_model_rate:g}) is a share of rates: give rates=, too.")
        if rates is not None:
            for group, rate, share in zip(
                self.optimizer.param_groups, self._rates, (world_model_rate, 1.0), strict=True
            ):
                group["lr"] = rate * rates * share
        for number, value in ((self.discount, discount), (self.entropy_scale, entropy_scale)):
            if value is not None:
                number.fill_(value)
        for name, bound in (("min_std", min_std), ("max_std", max_std)):
            if bound is not None:
                for agent in (self.agent, self.flying_agent):
                    agent.actor.get_buffer(name).fill_(bound)

    def check_finite(self) -> None:
        """Wait for the latest updates, so that nothing bad is saved.

        Raises:
            NonFiniteLossError: If one of them was not finite.
        """
        self._guard.settle()

    def autocast(self) -> torch.autocast:
        """Return the context in which the networks run: bfloat16 where it does not matter, if ``mixed_precision``."""
        return autocast(self.device, bool(self.config.mixed_precision))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, but for the global random generators."""
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
            ValueError: If it is that of another algorithm, of a model of another size, of other losses or of another
                environment; nothing is changed then.
        """
        check_saved(state_dict, self.algorithm, self.agent, self.own_networks)
        self.agent.load_state_dict(state_dict["agent"])
        for name, network in self.own_networks.items():
            network.load_state_dict(state_dict["own_networks"][name], strict=False)
        if self.averaged is not None:
            self.averaged.load_state_dict(state_dict.get("averaged", state_dict["agent"]))
        restore(self.optimizer, state_dict["optimizer"])
        self.updates = state_dict["updates"]

    def adopt(self, state_dict: dict[str, Any]) -> Unmatched:
        """Take over the weights of what another learner's ``state_dict`` returned, whatever its algorithm.

        They are those that flew, so the averaged ones where it kept them, and nothing else: no optimiser, no counters,
        no bounds of the actor's deviation, neither collected steps nor statistics. A network that is no part of the
        agent and that the other has not, as a critic of the state, begins anew.

        Returns:
            The own networks that begin anew, and those that are left behind.

        Raises:
            ValueError: If it is that of a model of another size or of another environment; nothing is changed then.
        """
        unmatched = check_weights(state_dict, self.agent, self.own_networks)
        flying = state_dict.get("averaged", state_dict["agent"])
        for agent in filter(None, (self.agent, self.averaged)):
            load_parameters(agent, flying)
        for name, network in self.own_networks.items():
            load_parameters(network, state_dict["own_networks"].get(name, {}))
        return unmatched

    def _parameters(self) -> dict[str, list[nn.Parameter]]:
        """Return what a gradient step trains, by the network's name; the world model with what its loss has."""
        networks: dict[str, list[nn.Module]] = {"world_model": [self.agent.world_model, self.world_model_loss]}
        networks |= {name: [self.agent.get_submodule(name)] for name in self.behavior}
        return {
            name: [p for p in nn.ModuleList(parts).parameters() if p.requires_grad] for name, parts in networks.items()
        }

    def _make_optimizer(self) -> torch.optim.Optimizer:
        rate, parameters = self.config.learning_rate, self._trained
        behavior = [parameter for name in self.behavior for parameter in parameters[name]]
        groups: list[dict[str, Any]] = [
            {"params": parameters["world_model"], "lr": rate},
            {"params": behavior, "lr": self.config.behavior_learning_rate or rate},
        ]
        return make_optimizer(groups, self.config.warmup_updates)

    def _make_graph(self) -> GraphedStep:
        """Return what replays ``_backward`` as one CUDA graph."""
        if self.device.type != "cuda":
            raise ValueError(f"cuda_graph=True needs a CUDA device, but the learner is on {str(self.device)!r}.")
        return GraphedStep(self._backward, self.modules)

    def _weights(self) -> AbstractContextManager:
        """Return the context in which layers have their weights in the type that autocast computes in."""
        return cast_once(self.modules, torch.bfloat16) if self._casts_once else nullcontext()

    def note_latents(self, latents: Latents) -> None:
        """Keep the latents of a batch's records for the replay."""
        shape = latents.belief.shape[:2]
        self.latents = TensorDict({"belief": latents.belief.detach(), "state": latents.state.detach()}, shape)
