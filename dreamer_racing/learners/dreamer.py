"""The DreamerV3 learner: one update of networks by losses and an optimiser.

Shape legend: B batch, T time, A action.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, fields
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from dreamer_racing import parallel
from dreamer_racing.learners.cuda_graph import GraphedStep
from dreamer_racing.learners.dreamer_config import LearnerConfig
from dreamer_racing.learners.dreamer_optimizer import gradient_norms, make_optimizer, restore, trained_parameters
from dreamer_racing.learners.finite_guard import FiniteGuard
from dreamer_racing.learners.learner import Timer, ValueFunction, seeded, untimed
from dreamer_racing.learners.saved_dreamer import (
    Unmatched,
    check_optimizers,
    check_saved,
    check_weights,
    load_parameters,
    own_state,
)
from dreamer_racing.losses import ActorLoss, LossConfig, WorldModelLoss, find_loss, make_losses
from dreamer_racing.losses.config import HORIZON
from dreamer_racing.losses.contract import require_keys, set_number
from dreamer_racing.losses.imagination import choose_starts
from dreamer_racing.modules import DreamerPolicy, Interface, ModelSize, get_size
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.cast_weights import cast_once
from dreamer_racing.modules.few_kernels import save_kernels
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.stored_latents import CONTEXT, LatentFormat
from dreamer_racing.modules.world_model import join_features
from dreamer_racing.settings import check_settings


class DreamerLearner:
    """One update of world model, actor and critic by their losses and an optimiser; all of them are given.

    Args:
        agent: The networks, on the device where updates run.
        losses: ``world_model``, ``actor`` and ``critic``, as ``make_losses`` makes them of the agent.
        optimizer: As ``make_optimizer`` makes it: a group of the world model, and one of actor and critic. It must clip
            gradients itself.
        config: Numbers of the update.

    Attributes:
        latents: Belief and state of the last batch's records, ``[B, T]``, for the replay's context; on a CUDA device
            with ``cuda_graph`` the next update writes over them.
        actor_waits: Whether an actor with an optimiser of its own stands still; settable.

    Example:
        >>> agent = Agent(get_size("debug"), Interface())
        >>> losses = make_losses(agent, LossConfig(), horizon=3)
        >>> learner = DreamerLearner(agent, losses, make_optimizer(agent, losses, LearnerConfig()))
        >>> learner.policy().in_keys
        ['pixels', 'is_init', 'belief', 'state', 'previous_action']
    """

    def __init__(
        self,
        agent: Agent,
        losses: Mapping[str, LossModule],
        optimizer: torch.optim.Optimizer,
        config: LearnerConfig | None = None,
    ) -> None:
        if not isinstance(losses["actor"], ActorLoss):
            raise ValueError(f"{type(losses['actor']).__name__} is no ActorLoss: subclass that.")
        self.config = config or LearnerConfig()
        self.agent = agent
        self.losses = nn.ModuleDict(losses)
        self.optimizer = optimizer
        self.device = next(agent.parameters()).device
        few = self.device.type == "cuda" if self.config.few_kernels is None else self.config.few_kernels
        self._casts_once = few and bool(self.config.mixed_precision)
        if few:
            save_kernels(nn.ModuleList([agent, self.losses]))
        self.averaged = None if self.config.average_rate is None else copy.deepcopy(agent).requires_grad_(False)
        self.latents: TensorDictBase | None = None
        self.actor_waits = False
        self.updates = 0
        self._networks = trained_parameters(agent, losses)
        self._actor_optimizer = losses["actor"].optimizer
        self._rates = [group["lr"] for group in self._groups]
        self._guard = FiniteGuard(lag=2 if self.device.type == "cuda" else 0)
        if self.config.compile:
            agent.world_model.rssm.compile_steps()
        self._graph = self._make_graph() if self.config.cuda_graph else None

    @property
    def weights(self) -> list[Tensor]:
        """All that is learned: networks, those of losses' own, averages."""
        kept = [self.agent, self.losses] if self.averaged is None else [self.agent, self.losses, self.averaged]
        return list(nn.ModuleList(kept).parameters())

    @property
    def actor_loss(self) -> ActorLoss:
        """The actor's."""
        return cast(ActorLoss, self.losses["actor"])

    @property
    def discount(self) -> float:
        """γ of the actor's loss, as it is now; reading it waits for the device."""
        return float(self.actor_loss.discount)

    @property
    def imagines(self) -> bool:
        """Whether updates imagine."""
        return self.actor_loss.imagines

    @property
    def horizon(self) -> int:
        """H, imagined actions from each start."""
        return self.actor_loss.horizon

    @property
    def size(self) -> ModelSize:
        """Of the networks."""
        return self.agent.size

    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step of everything.

        Args:
            batch: Replay records, batch size ``[B, T]``: what the encoder sees, ``previous_action``, ``reward``,
                ``is_init``, ``terminated``, ``truncated``; scalars ``(B, T, 1)``; and ``context``, from whose first
                record windows go on where it is there, and which ``drift_scale`` needs.
            timed: Context manager by activity (``world_model``, ``imagine``, of actor and critic whether they imagine
                or not, ``optimise``), to measure the time spent in each; tells them apart only on a CPU.

        Returns:
            Scalar tensors on the device: every loss and metric of those that were computed, ``gradient_norm/<network>``
            (before clipping) and ``loss``. Reading one waits for the device; do it seldom.

        Raises:
            KeyError: If the batch lacks what a loss reads.
            NonFiniteLossError: If loss, gradient or a reward is not finite, also of an actor's improvement, which the
                error says. On a CPU no network has been changed by it; on a CUDA device this is noticed two updates
                late, because waiting for the device would stall it.
        """
        batch = batch.to(self.device, non_blocking=True)
        if self._actor_optimizer is not None:
            self.actor_loss.prepare(self._number_of_starts(batch))
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
        if self._actor_optimizer is not None and not self.actor_waits:
            with timed("improve"), self.autocast():
                improved = self.actor_loss.improve(self.updates)
            improved = parallel.averaged(improved)
            if improved:
                kept = TensorDict(dict(self.actor_loss.named_buffers(recurse=False)))
                if self.device.type == "cuda":
                    kept = kept.clone()  # the guard looks two entries later, and rollouts are written there meanwhile
                self._guard.check(improved, kept, of=" of the actor's improvement")
            metrics |= improved
        self._average()
        return metrics

    def watch(self, rollout: TensorDictBase) -> None:
        """Show the actor's loss a collector's rollout ``[N, T]``, flown by `policy`, perhaps with older weights."""
        self.actor_loss.watch(rollout)

    @torch.no_grad()
    def _average(self) -> None:
        """Move the averaged weights; while there are few updates they are the plain mean of all."""
        if self.averaged is not None and self.config.average_rate is not None:
            rate = max(self.config.average_rate, 1.0 / self.updates)
            torch._foreach_lerp_(list(self.averaged.parameters()), list(self.agent.parameters()), rate)

    def adjust(
        self,
        *,
        rates: float | None = None,
        world_model_rate: float = 1.0,
        kl_target: float | None = None,
        min_std: float | None = None,
        max_std: float | None = None,
        **numbers: float,
    ) -> None:
        """Change what a run may have on a schedule, from the next update on; what is not named stays.

        These are settings, not state: call it again after `load_state_dict`.

        Args:
            rates: Share of the learning rates that the learner was made with, of all optimisers.
            world_model_rate: Share of that share, of the world model's alone; given together with ``rates``.
            kl_target: Of `ActorPPOConfig`.
            min_std: Smallest standard deviation of actions, of the networks' own.
            max_std: Largest.
            numbers: Others of `LossConfig`, set in all losses that have an attribute of the name.

        Raises:
            TypeError: If `LossConfig` has no number of such a name.
            ValueError: If none of the losses has it as an attribute, a CUDA graph would not read it again, or
                ``world_model_rate`` is given alone.
        """
        if rates is None and world_model_rate != 1.0:
            raise ValueError(f"adjust(world_model_rate={world_model_rate:g}) is a share of rates: give rates=, too.")
        if unknown := numbers.keys() - {field.name for field in fields(LossConfig)}:
            raise TypeError(f"adjust({', '.join(sorted(unknown))}=...): LossConfig has no such number.")
        if rates is not None:
            for group, rate in zip(self._groups, self._rates, strict=True):
                group["lr"] = rate * rates
            self._groups[0]["lr"] *= world_model_rate
        if kl_target is not None:  # read between updates, where no graph is
            set_number(self.losses.values(), "kl_target", kl_target)
        for name, value in numbers.items():
            set_number(self.losses.values(), name, value, captured=self._graph is not None)
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

    def _make_graph(self) -> GraphedStep:
        """Return what replays ``_backward`` as one CUDA graph."""
        if self.device.type != "cuda":
            raise ValueError(f"cuda_graph=True needs a CUDA device, but the learner is on {str(self.device)!r}.")
        return GraphedStep(self._backward, nn.ModuleList([self.agent, self.losses]))

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
            norms = gradient_norms(self._networks)
        return {key: value.detach() for key, value in (metrics | norms | {"loss": total}).items()}

    def _weights(self) -> AbstractContextManager:
        """Return the context in which the losses' layers have their weights in the type that autocast computes in."""
        return (
            cast_once(nn.ModuleList([self.agent, self.losses]), torch.bfloat16) if self._casts_once else nullcontext()
        )

    def _of_all_processes(self, metrics: dict[str, Tensor], timed: Timer) -> dict[str, Tensor]:
        """Turn gradients and metrics of this process's share of the batch into those of the joint batch.

        One exchange of a flat tensor between backward and the optimiser's step, behind a captured graph, and not
        ``DistributedDataParallel``: gradients come from one backward through several losses, and a metric that is not
        finite reaches all processes with them, so that all stop at the same update.
        """
        with timed("exchange"):
            networks = (parameter for parameters in self._networks.values() for parameter in parameters)
            metrics = parallel.average_gradients(networks, metrics)
            return metrics | gradient_norms(self._networks)

    def compute_losses(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Compute all losses and metrics of a batch ``[B, T]`` without a step; losses carry gradient."""
        with timed("world_model"):
            model: TensorDict = self.losses["world_model"](batch)
            latents: TensorDict = model.pop("replay_context")
            drift = self._drift(latents, batch) if self.actor_loss.drift_scale else {}
        with timed("imagine"):
            behavior = self._behavior_losses(latents, batch)
        return {key: value for part in (model, drift, behavior) for key, value in part.items()}

    def _drift(self, latents: TensorDictBase, batch: TensorDictBase) -> dict[str, Tensor]:
        """Hold the policy at the records of a batch ``[B, T]`` whose latents the next record has stored."""
        if batch.get(CONTEXT, None) is None:
            raise KeyError(
                f"drift_scale={self.actor_loss.drift_scale:g} holds the policy at the latents that records keep, and "
                f"the batch has no {CONTEXT!r}: replay with them (replay.context=true), or set drift_scale=0."
            )
        before, after, same = self.then_and_now(latents, batch)
        return self.actor_loss.hold(before, after, same.float())

    def then_and_now(self, latents: TensorDictBase, batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return features of records as they were stored and as the model makes them now.

        Args:
            latents: Belief and state of a batch's records now, ``[B, T]``.
            batch: The records ``[B, T]``, with ``context``: each has the latents of the one before it.

        Returns:
            Both of all but the last record, ``(B, T - 1, F)``, and whether they are of the same one, bool
            ``(B, T - 1, 1)``: what the first record of an episode has stored is not of the one before it.
        """
        before = join_features(*self.latent_format.unpack(batch[CONTEXT][:, 1:]))
        after = join_features(latents["belief"][:, :-1], latents["state"][:, :-1])
        return before, after, ~batch["is_init"][:, 1:]

    def _behavior_losses(self, context: TensorDictBase, batch: TensorDictBase) -> dict[str, Tensor]:
        """Imagine from the latents of a batch, if the actor's loss does, and judge; losses and metrics of both."""
        self.latents = context.detach()
        replay = batch.select("reward", "is_init", "terminated", "truncated")
        replay.update(context)
        if not self.imagines:
            return dict(self.losses["critic"](replay).items())
        imagined: TensorDict = self.losses["actor"](self.starts(context, batch))
        imagination = imagined.pop("imagination")
        if self.config.imagination_starts is None:
            # Every record was a start: its first imagined return is a better value than the critic's.
            replay.set("bootstrap", imagination.get("lambda_return")[0].reshape(*batch.batch_size, 1))
        critic: TensorDict = self.losses["critic"](TensorDict({**replay, "imagination": imagination}, []))
        return {**imagined, **critic}

    def policy(self, deterministic: bool = False) -> DreamerPolicy:
        """Return the acting step of the networks that are trained, which shares their parameters."""
        return DreamerPolicy(self.agent.world_model, self.agent.actor, deterministic)

    def evaluation_policy(self) -> DreamerPolicy:
        """Return the acting step of `flying_agent`, which shares its parameters."""
        return DreamerPolicy(self.flying_agent.world_model, self.flying_agent.actor)

    def value_function(self) -> ValueFunction:
        """Return what the critic that teaches the actor makes of a state: the actor's loss may have one of its own."""
        return self.actor_loss.value_function() or self._value_of_latents

    @torch.no_grad()
    def _value_of_latents(self, acted: TensorDictBase) -> Tensor:
        """Return what the critic makes of the latents that `DreamerPolicy` has updated by what it saw, ``(N, 1)``."""
        after = acted["next"].select("belief", "state").to(self.device)
        return self.flying_agent.critic.value(join_features(after["belief"], after["state"]))

    @property
    def latent_format(self) -> LatentFormat:
        """How a replay keeps this learner's latents."""
        return self.agent.world_model.rssm.latent_format

    @property
    def flying_agent(self) -> Agent:
        """What is evaluated and exported: the averaged networks where they are kept, else those that are trained."""
        return self.agent if self.averaged is None else self.averaged

    def open_loop(self, batch: TensorDictBase, context: int) -> tuple[Tensor, Tensor]:
        """Observe the first ``context`` records of a batch ``[B, T]``, then predict the others from their actions.

        By the networks that are trained, also where averaged ones fly: a loss's own decoder has no average.

        Returns:
            Beliefs ``(B, T, D)`` and states ``(B, T, S)``.
        """
        batch = batch.to(self.device)
        return self.agent.world_model.open_loop(
            batch, batch.get("previous_action"), batch.get("is_init").squeeze(-1), context
        )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, but for the global random generators."""
        return {
            "size": asdict(self.size),
            "image_size": self.agent.interface.image_size,
            "agent": self.agent.state_dict(),
            "losses": {name: own_state(loss, self.agent) for name, loss in self.losses.items()},
            "optimizer": self.optimizer.state_dict(),
            "updates": self.updates,
            **({} if self.averaged is None else {"averaged": self.averaged.state_dict()}),
            **({} if self._actor_optimizer is None else {"actor_optimizer": self._actor_optimizer.state_dict()}),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned.

        Raises:
            ValueError: If it is that of a model of another size, of other losses or of another environment; nothing is
                changed then.
        """
        check_optimizers(state_dict, self._actor_optimizer is not None)
        check_saved(state_dict, self.agent, self.losses)
        self.agent.load_state_dict(state_dict["agent"])
        for name, loss in self.losses.items():
            loss.load_state_dict(state_dict["losses"][name], strict=False)
        if self.averaged is not None:
            self.averaged.load_state_dict(state_dict.get("averaged", state_dict["agent"]))
        restore(self.optimizer, state_dict["optimizer"])
        if self._actor_optimizer is not None:
            restore(self._actor_optimizer, state_dict["actor_optimizer"])
        self.updates = state_dict["updates"]

    def adopt(self, state_dict: dict[str, Any]) -> Unmatched:
        """Take over the weights of what another learner's ``state_dict`` returned, whatever its actor's loss.

        They are those that flew, so the averaged ones where it kept them, and nothing else: no optimiser, no counters,
        no bounds of the actor's deviation, and nothing that losses keep from update to update: neither flown steps nor
        statistics. A network of a loss's own that it has not, as the critic of the state, begins anew.

        Returns:
            The losses' own networks that begin anew, and those that are left behind.

        Raises:
            ValueError: If it is that of a model of another size or of another environment; nothing is changed then.
        """
        unmatched = check_weights(state_dict, self.agent, self.losses)
        flying = state_dict.get("averaged", state_dict["agent"])
        for agent in filter(None, (self.agent, self.averaged)):
            load_parameters(agent, flying)
        for name, loss in self.losses.items():
            load_parameters(loss, state_dict["losses"][name])
        return unmatched

    @property
    def _groups(self) -> list[dict[str, Any]]:
        """Parameters with their learning rates, of all optimisers."""
        own = [] if self._actor_optimizer is None else self._actor_optimizer.param_groups
        return [*self.optimizer.param_groups, *own]

    def starts(self, context: TensorDictBase, batch: TensorDictBase) -> TensorDict:
        """Return the latents ``[N]`` that imagination begins from, of those of a batch, with their ``terminated``."""
        if self.config.imagine_recent:
            require_keys(self, batch, ["recent"])
        recent = batch["recent"] if self.config.imagine_recent else None
        return choose_starts(context, batch["terminated"], self.config.imagination_starts, recent)

    def _number_of_starts(self, batch: TensorDictBase) -> int:
        """Return how many records of a batch ``[B, T]`` imagination begins from."""
        return min(self.config.imagination_starts or batch.numel(), batch.numel())


def make_dreamer(
    size: ModelSize | str,
    interface: Interface | None = None,
    losses: LossConfig | None = None,
    config: LearnerConfig | None = None,
    *,
    horizon: int = HORIZON,
    device: torch.device | str = "cpu",
    seed: int | None = None,
) -> DreamerLearner:
    """Compose a learner by the names of its parts: networks, losses, optimiser.

    Args:
        size: Of the networks, or its name.
        interface: What the agent sees and does; ``Interface.of(env)`` reads it off an environment.
        losses: Which they are, and their numbers.
        config: Numbers of the update.
        horizon: H, imagined actions from each start.
        device: Where the networks live and updates run.
        seed: Of the initial weights; None takes them from the global generator. Later sampling always uses the
            global generator of the device, which a checkpoint of yours should save.

    Raises:
        ValueError: If a number is out of its range, or there is no loss of a name.
    """
    losses, config = losses or LossConfig(), config or LearnerConfig()
    check_settings(losses)
    check_settings(config)
    decodes = find_loss(WorldModelLoss, losses.world_model).decodes
    with seeded(seed):
        agent = Agent(get_size(size), interface or Interface(), decodes, losses.min_std, losses.max_std).to(device)
        modules = make_losses(agent, losses, horizon)
    return DreamerLearner(agent, modules, make_optimizer(agent, modules, config), config)
