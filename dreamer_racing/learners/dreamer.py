"""The DreamerV3 learner: networks, losses, optimiser, and one update.

Shape legend: B batch, T time, A action.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from dreamer_racing.learners.cuda_graph import GraphedStep, Step
from dreamer_racing.learners.finite_guard import FiniteGuard
from dreamer_racing.learners.learner import Timer, untimed
from dreamer_racing.losses import (
    ACTOR_LOSSES,
    CRITIC_LOSSES,
    WORLD_MODEL_LOSSES,
    ActorLoss,
    ImaginedPPOConfig,
    LossClass,
    find_loss,
)
from dreamer_racing.losses.contract import require_keys
from dreamer_racing.modules import DreamerPolicy, Interface, ModelSize, get_size
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.stored_latents import LatentFormat


@dataclass(frozen=True)
class LearnerConfig:
    """Numbers of the learner, all but the networks' sizes.

    Attributes:
        batch_size: B, windows in a batch.
        batch_length: T, records in a window.
        imagination_horizon: H, imagined actions from each start.
        imagination_starts: Imagine from a random subset of so many records of the batch; None from all of them.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the actor's entropy.
        return_decay: Decay of the return percentiles.
        dynamics_scale: Weight of the dynamics loss.
        representation_scale: Weight of the representation loss.
        free_nats: KL below which there is no gradient, nats.
        kl_mode: Whether the free nats apply to the sum over latents (``separate``) or to each (``per_latent``).
        privileged_scale: Weight of decoding the privileged state, where the loss does.
        barlow_scale: Weight of the redundancy reduction, where the loss has it.
        continuation: Whether predicted ends of episodes cut imagined returns.
        slow_critic_scale: Weight of the regularisation towards the slow critic.
        slow_critic_rate: Fraction by which the slow critic moves at each update.
        replay_value_scale: Weight of the critic's loss on replayed returns.
        replay_value_gradient: Whether that loss also trains the world model's representation, as in the reference.
        compile: Compile the losses with ``torch.compile``; minutes at the first update.
        cuda_graph: On a CUDA device, replay forward and backward as one CUDA graph.
        mixed_precision: Compute the losses under bfloat16 autocast; parameters, logits and losses stay float32.
        optimizer: Key of ``OPTIMIZERS``.
        lr: Learning rate; the reference's 4e-5 suits large models, small ones learn faster at 1e-4 to 3e-4.
        behavior_lr: Learning rate of actor and critic; None for the same. A lower one lets the world model get ahead of
            the policy that exploits its mistakes; the 2023 code had 1e-4 and 3e-5.
        warmup_updates: Updates over which the learning rate rises from zero.
        imagine_recent: Imagine from the batch's newest windows only, as far as they go, so that the actor learns where
            it flies now; the batch must say which they are (``recent``), as the replay does.
        min_std: Smallest standard deviation of actions. The reference has 0.1; more keeps the actor exploring where a
            first way of doing something has made it sure of itself.
        average_rate: Fraction by which the averaged weights, which fly evaluations and exports, move at each update;
            None keeps none.
        ppo: Numbers of the actor loss of that name.
        world_model_loss, actor_loss, critic_loss: Keys of the registries in ``dreamer_racing.losses``.

    Reference: danijar/dreamerv3, ``configs.yaml``; horizon 16 from the paper, Section III.
    """

    batch_size: int = 16
    batch_length: int = 64
    imagination_horizon: int = 16
    imagination_starts: int | None = None
    discount: float = 0.997
    lambda_: float = 0.95
    entropy_scale: float = 3e-4
    return_decay: float = 0.99
    dynamics_scale: float = 1.0
    representation_scale: float = 0.1
    free_nats: float = 1.0
    kl_mode: str = "separate"
    privileged_scale: float = 1.0
    barlow_scale: float = 0.05
    continuation: bool = True
    slow_critic_scale: float = 1.0
    slow_critic_rate: float = 0.02
    replay_value_scale: float = 0.3
    replay_value_gradient: bool = True
    compile: bool = False
    cuda_graph: bool = False
    mixed_precision: bool = False
    optimizer: str = "laprop"
    lr: float = 4e-5
    behavior_lr: float | None = None
    warmup_updates: int = 1000
    imagine_recent: bool = False
    min_std: float = 0.1
    average_rate: float | None = None
    ppo: ImaginedPPOConfig = field(default_factory=ImaginedPPOConfig)
    world_model_loss: str = "reconstruction"
    actor_loss: str = "reinforce"
    critic_loss: str = "two_hot"


ParameterGroups = list[dict[str, Any]]
"""Parameters with their learning rates: ``[{"params": [...], "lr": ...}, ...]``."""


def _laprop(groups: ParameterGroups, config: LearnerConfig) -> torch.optim.Optimizer:
    """Make the 2025 reference's optimiser: LaProp with adaptive gradient clipping."""
    from torchrl.trainers.algorithms import DreamerV3Optimizer

    return DreamerV3Optimizer(groups, lr=config.lr, warmup_steps=config.warmup_updates)


OPTIMIZERS: dict[str, Callable[[ParameterGroups, LearnerConfig], torch.optim.Optimizer]] = {"laprop": _laprop}
"""Optimiser factories by the name in ``LearnerConfig``; those of your own must clip gradients themselves."""


def check_size(checkpoint: dict[str, Any], size: ModelSize) -> None:
    """Refuse the state of a model of another size.

    Args:
        checkpoint: ``state_dict()["size"]`` of a learner.
        size: The size of the learner that loads it.

    Raises:
        ValueError: If they differ in anything but the name; the message says in what, and what to do.
    """
    wanted = asdict(size)
    checkpoint = {"sampled": ModelSize.sampled, **checkpoint}  # older ones do not say
    differences = [
        f"{field.name} {checkpoint.get(field.name)} there, {wanted[field.name]} here"
        for field in fields(size)
        if field.name != "name" and _plain(checkpoint.get(field.name)) != _plain(wanted[field.name])
    ]
    if differences:
        raise ValueError(
            f"The checkpoint holds a model of size {checkpoint.get('name')!r}, but this learner was made with size "
            f"{size.name!r} ({'; '.join(differences)}). Weights cannot be converted between sizes: start with "
            f"model={checkpoint.get('name')} to use this checkpoint, or train size {size.name!r} from the beginning."
        )


def _plain(value: Any) -> Any:
    """Return tuples as lists, as files keep them."""
    return list(value) if isinstance(value, tuple) else value


class DreamerLearner:
    """World model, actor and critic with their losses and optimiser.

    Args:
        size: A ``ModelSize`` or its name.
        interface: What the agent sees and does; ``Interface.of(env)`` reads it off an environment.
        config: Numbers of the learner.
        device: Where the networks live and updates run.
        seed: Seed of the initial weights; None takes them from the global generator. Later sampling always uses the
            global generator of the device, which a checkpoint of yours should save.

    Attributes:
        latents: Belief and state of the last batch's records, ``[B, T]``, for the replay's context; on a CUDA device
            with ``cuda_graph`` the next update writes over them.
        discount: γ as it is now, see ``adjust``.
        actor_waits: Whether an actor with an optimiser of its own stands still; settable.

    Example:
        >>> learner = DreamerLearner("debug", config=LearnerConfig(imagination_horizon=3), seed=0)
        >>> policy = learner.policy()
        >>> policy.in_keys
        ['pixels', 'is_init', 'belief', 'state', 'previous_action']
    """

    def __init__(
        self,
        size: ModelSize | str,
        interface: Interface | None = None,
        config: LearnerConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        self.size = get_size(size)
        self.config = config or LearnerConfig()
        self.device = torch.device(device)
        with torch.random.fork_rng(devices=[], enabled=seed is not None):
            if seed is not None:
                torch.manual_seed(seed)
            world_model_loss = find_loss(WORLD_MODEL_LOSSES, self.config.world_model_loss)
            losses: dict[str, LossClass] = {
                "world_model": world_model_loss,
                "actor": find_loss(ACTOR_LOSSES, self.config.actor_loss),
                "critic": find_loss(CRITIC_LOSSES, self.config.critic_loss),
            }
            self.agent = Agent(self.size, interface or Interface(), world_model_loss.decodes).to(self.device)
            self.agent.actor.min_std.fill_(self.config.min_std)
            self.losses = nn.ModuleDict(
                {name: loss.from_config(self.agent, self.config) for name, loss in losses.items()}
            ).to(self.device)
        self.averaged = None if self.config.average_rate is None else copy.deepcopy(self.agent).requires_grad_(False)
        self.latents: TensorDictBase | None = None
        self.discount = self.config.discount
        self.actor_waits = False
        self._networks = self._trained_parameters()
        self._actor_optimizer: torch.optim.Optimizer | None = getattr(self.losses["actor"], "optimizer", None)
        self.optimizer = OPTIMIZERS[self.config.optimizer](self._parameter_groups(), self.config)
        self._rates = [group["lr"] for group in self._groups]
        self.updates = 0
        self._timed: Timer = untimed
        self._compute = self.compute_losses
        self._guard = FiniteGuard(lag=2 if self.device.type == "cuda" else 0)
        self._step = self._make_step()

    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step of everything.

        Args:
            batch: Replay records, batch size ``[B, T]``: what the encoder sees, ``previous_action``, ``reward``,
                ``is_init``, ``terminated``, ``truncated``; scalars ``(B, T, 1)``.
            timed: Context manager by activity (``world_model``, ``imagine``, ``optimise``), to measure the time spent
                in each; tells them apart only on a CPU and without ``compile``.

        Returns:
            Scalar tensors on the device: every loss and metric of the three losses, ``gradient_norm/<network>`` (before
            clipping) and ``loss``. Reading one waits for the device; do it seldom.

        Raises:
            KeyError: If the batch lacks what a loss reads.
            NonFiniteLossError: If loss, gradient or a reward is not finite. On a CPU no network has been changed by
                this batch; on a CUDA device this is noticed two updates late, because waiting for the device would
                stall it.
        """
        self._timed = untimed if self.config.compile else timed  # a clock would break the compiled graph in pieces
        batch = batch.to(self.device, non_blocking=True)
        if self._actor_optimizer is not None:
            cast(ActorLoss, self.losses["actor"]).prepare(self._number_of_starts(batch))
        metrics = self._step(batch)
        self._guard.check(metrics, batch)
        with timed("optimise"):
            self.optimizer.step()
            self.agent.critic.update_slow(self.config.slow_critic_rate)
            if not self.config.cuda_graph:
                self.optimizer.zero_grad(set_to_none=True)
        self.updates += 1
        if self._actor_optimizer is not None and not self.actor_waits:
            with timed("improve"), self.autocast():
                improved = cast(ActorLoss, self.losses["actor"]).improve(self.updates)
            if improved:
                self._guard.check(improved, batch)
            metrics |= improved
        self._average()
        return metrics

    def _average(self) -> None:
        """Move the averaged weights; while there are few updates they are the plain mean of all."""
        if self.averaged is not None and self.config.average_rate is not None:
            rate = max(self.config.average_rate, 1.0 / self.updates)
            torch._foreach_lerp_(list(self.averaged.parameters()), list(self.agent.parameters()), rate)

    def adjust(
        self,
        *,
        rates: float = 1.0,
        discount: float | None = None,
        entropy_scale: float | None = None,
        min_std: float | None = None,
    ) -> None:
        """Change what a run may have on a schedule, from the next update on; what is not named is as configured.

        Args:
            rates: Share of the configured learning rates, of all optimisers.
            discount: γ.
            entropy_scale: Weight of the actor's entropy.
            min_std: Smallest standard deviation of actions.
        """
        self._set_min_std(self.config.min_std if min_std is None else min_std)
        for group, rate in zip(self._groups, self._rates, strict=True):
            group["lr"] = rate * rates
        self.discount = self.config.discount if discount is None else discount
        self._set_in_losses("discount", self.discount)
        self._set_in_losses("entropy_scale", self.config.entropy_scale if entropy_scale is None else entropy_scale)

    def _set_min_std(self, value: float) -> None:
        for agent in (self.agent, self.averaged):
            if agent is not None:
                agent.actor.min_std.fill_(value)

    def _set_in_losses(self, name: str, value: float) -> None:
        """Set a number of all losses that have it, as a scalar in place or, in losses of a user's own, as a number."""
        for loss in self.losses.values():
            setting = getattr(loss, name, None)
            if isinstance(setting, Tensor):
                setting.fill_(value)
            elif setting is not None:
                setattr(loss, name, value)

    def check_finite(self) -> None:
        """Wait for the latest updates, so that nothing bad is saved.

        Raises:
            NonFiniteLossError: If one of them was not finite.
        """
        self._guard.settle()

    def autocast(self) -> torch.autocast:
        """Return the context in which the networks run: bfloat16 where it does not matter, if ``mixed_precision``."""
        return autocast(self.device, self.config.mixed_precision)

    def _make_step(self) -> Step:
        """Return the function that computes gradients, as fast as the configuration allows."""
        config, step = self.config, self._backward
        if config.compile:
            self._compute = torch.compile(self.compute_losses, dynamic=False)
        if not config.cuda_graph:
            return step
        if self.device.type != "cuda":
            raise ValueError(f"cuda_graph=True needs a CUDA device, but the learner is on {str(self.device)!r}.")
        return GraphedStep(step, nn.ModuleList([self.agent, self.losses]))

    def _backward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Compute losses and gradients of a batch; return detached scalars."""
        with self.autocast():
            metrics = self._compute(batch)
        total = torch.stack([value for key, value in metrics.items() if key.startswith("loss_")]).sum()
        with self._timed("optimise"):
            total.backward()
            norms = {
                f"gradient_norm/{name}": _gradient_norm(parameters)
                for name, parameters in self._networks.items()
                if any(parameter.grad is not None for parameter in parameters)  # none, where the actor steps alone
            }
        return {key: value.detach() for key, value in (metrics | norms | {"loss": total}).items()}

    def compute_losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Compute all losses and metrics of a batch ``[B, T]`` without a step; losses carry gradient."""
        with self._timed("world_model"):
            model: TensorDict = self.losses["world_model"](batch)
        with self._timed("imagine"):
            behavior = self._behavior_losses(model.pop("replay_context"), batch)
        return {key: value for part in (model, behavior) for key, value in part.items()}

    def _behavior_losses(self, context: TensorDictBase, batch: TensorDictBase) -> dict[str, Tensor]:
        """Imagine from the latents of a batch and judge; losses and metrics of actor and critic."""
        self.latents = context.detach()
        imagined: TensorDict = self.losses["actor"](self._choose_starts(context, batch))
        imagination = imagined.pop("imagination")
        replay = batch.select("reward", "is_init", "terminated", "truncated")
        replay.update(context if self.config.replay_value_gradient else context.detach())
        if self.config.imagination_starts is None:
            # Every record was a start: its first imagined return is a better value than the critic's.
            replay.set("bootstrap", imagination.get("lambda_return")[0].reshape(*batch.batch_size, 1))
        critic: TensorDict = self.losses["critic"](TensorDict({**replay, "imagination": imagination}, []))
        return {**imagined, **critic}

    def policy(self, deterministic: bool = False) -> DreamerPolicy:
        """Return the acting step of the networks that are trained, which shares their parameters."""
        return DreamerPolicy(self.agent.world_model, self.agent.actor, deterministic)

    def evaluation_policy(self, deterministic: bool = False) -> DreamerPolicy:
        """Return the acting step of `flying_agent`, which shares its parameters."""
        return DreamerPolicy(self.flying_agent.world_model, self.flying_agent.actor, deterministic)

    @property
    def latent_format(self) -> LatentFormat:
        """How a replay keeps this learner's latents."""
        return self.agent.world_model.rssm.latent_format

    @property
    def flying_agent(self) -> Agent:
        """What is evaluated and exported: the averaged networks where they are kept, else those that are trained."""
        return self.agent if self.averaged is None else self.averaged

    def open_loop(self, batch: TensorDictBase, context: int) -> Tensor:
        """Reconstruct the first ``context`` records of a batch ``[B, T]``, then predict the others from their actions.

        Returns:
            Images uint8 ``(B, T, height, width, 3)``.

        Raises:
            ValueError: If the world model has no image decoder.
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
            "losses": {name: _own_state(loss) for name, loss in self.losses.items()},
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
        check_size(state_dict["size"], self.size)
        self._check_parts(state_dict)
        self.agent.load_state_dict(state_dict["agent"])
        for name, loss in self.losses.items():
            loss.load_state_dict(state_dict["losses"][name], strict=False)
        # Rates are settings of this learner, not state: a run may be continued with others.
        names = {"lr", "warmup_steps"}
        own = [{name: value for name, value in group.items() if name in names} for group in self._groups]
        self.optimizer.load_state_dict(state_dict["optimizer"])
        if self._actor_optimizer is not None:
            self._actor_optimizer.load_state_dict(state_dict["actor_optimizer"])
        if self.averaged is not None:
            self.averaged.load_state_dict(state_dict.get("averaged", state_dict["agent"]))
        for group, settings in zip(self._groups, own, strict=True):
            group.update(settings)
        self.updates = state_dict["updates"]

    @property
    def _groups(self) -> ParameterGroups:
        own = [] if self._actor_optimizer is None else self._actor_optimizer.param_groups
        return [*self.optimizer.param_groups, *own]

    def _check_parts(self, saved: dict[str, Any]) -> None:
        """Refuse networks or losses of other parameters than these."""
        # Older checkpoints do not say: their images were of the default size.
        there, here = saved.get("image_size", Interface.image_size), self.agent.interface.image_size
        where = (
            "in an environment of other observations or actions"
            if there == here
            else f"on images of {there} × {there} pixels, not {here} × {here}: choose env.image_size={there}"
        )
        older = {"actor.min_std": self.agent.actor.min_std}  # they do not say
        parts = {"networks": (self.agent.state_dict(), older | saved["agent"])}
        for name, loss in self.losses.items():
            # What a loss keeps from update to update it may do without; older versions keep less.
            kept = {key for key, _ in loss.named_buffers()}
            own, there = (
                {key: value for key, value in state.items() if key not in kept}
                for state in (_own_state(loss), saved["losses"][name])
            )
            parts[f"{name} loss"] = (own, there)
        for part, (wanted, found) in parts.items():
            lacking, surplus = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
            if lacking or surplus:
                raise ValueError(
                    f"The checkpoint's {part} has {', '.join(surplus[:2]) or 'nothing'} beyond this learner's, and "
                    f"lacks {', '.join(lacking[:2]) or 'nothing'}: it was trained with another loss, or in an "
                    "environment of other observations. Choose those it was trained with."
                )
            for key, value in wanted.items():
                if value.shape != found[key].shape:
                    raise ValueError(
                        f"The checkpoint's {part} has {key} of shape {list(found[key].shape)}, this learner's of "
                        f"{list(value.shape)}: it was trained {where}."
                    )

    def _trained_parameters(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters of each network, with those that its loss has of its own."""
        networks = dict(self.agent.named_children())
        shared = set(self.agent.parameters())
        own = {name: [p for p in loss.parameters() if p not in shared] for name, loss in self.losses.items()}
        return {
            name: [p for p in (*network.parameters(), *own[name]) if p.requires_grad]
            for name, network in networks.items()
        }

    def _parameter_groups(self) -> ParameterGroups:
        """Return the world model's parameters, and actor's and critic's, with their learning rates."""
        networks, config = self._networks, self.config
        behavior_lr = config.lr if config.behavior_lr is None else config.behavior_lr
        actor = networks["actor"] if self._actor_optimizer is None else []  # else the loss steps it
        return [
            {"params": networks["world_model"], "lr": config.lr},
            {"params": actor + networks["critic"], "lr": behavior_lr},
        ]

    def _choose_starts(self, context: TensorDictBase, batch: TensorDictBase) -> TensorDict:
        """Return the latents ``[N]`` to imagine from, with their ``terminated``."""
        starts = TensorDict(
            {"belief": context.get("belief"), "state": context.get("state"), "terminated": batch.get("terminated")},
            batch.batch_size,
        )
        starts = starts.detach().flatten()
        if self.config.imagination_starts is None:
            return starts
        order = torch.rand(len(starts), device=self.device)
        if self.config.imagine_recent:
            require_keys(self, batch, ["recent"])
            order = order + batch.get("recent").flatten()
        # Not randperm, which a CUDA graph cannot capture.
        return starts[order.topk(self._number_of_starts(batch)).indices]

    def _number_of_starts(self, batch: TensorDictBase) -> int:
        """Return how many records of a batch ``[B, T]`` imagination begins from."""
        return min(self.config.imagination_starts or batch.numel(), batch.numel())


def _gradient_norm(parameters: list[nn.Parameter]) -> Tensor:
    """Return the global norm of the gradients, a scalar."""
    return nn.utils.get_total_norm([parameter.grad for parameter in parameters if parameter.grad is not None])


def _own_state(loss: LossModule) -> dict[str, Tensor]:
    """Return a loss's state without that of the agent's networks, which it holds under their names."""
    networks = ("world_model.", "actor.", "critic.")
    return {key: value for key, value in loss.state_dict().items() if not key.startswith(networks)}
