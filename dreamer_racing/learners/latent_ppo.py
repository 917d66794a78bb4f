"""Recurrent PPO in a world model's latents: the world model is the memory, the policy learns from real rewards.

The world model learns from replayed records. The policy observes its latents, and learns by PPO from collected rollouts
once there are enough of them. So does a separate critic, of the latents or of the simulator's state. Nothing is
imagined: an actor that learns in imagination exploits the errors of the model, and the time is better spent on the
world model. The agent's own critic learns from replayed returns only; its loss also shapes the latents.

Shape legend: B batch, T time, S steps kept of each of N environments, F features, A action, M records of a minibatch.

PPO's update never waits for a CUDA device. Only the device knows whether a gradient step is to be applied, so every
step runs with a mask that may make it a no-op; after too large a KL divergence the mask disables the remaining steps.

Reference: Schulman et al. 2017, "Proximal policy optimization algorithms"; for the critic of the state, Pinto et al.
2018, "Asymmetric actor critic for image-based robot learning".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.experience.rollouts import RolloutStorage
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.gradient_step import check_scalars, restore
from dreamer_racing.learners.learner import Timer, untimed
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import LatentPPOLosses, Trajectory, find_objective, joined, normalized, rollout_return
from dreamer_racing.losses.config import KL_TOLERANCE, PPOUpdateConfig
from dreamer_racing.modules import Agent
from dreamer_racing.modules.heads import ActionDistribution, TwoHotHead, symlog
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.modules.rssm import join_features
from dreamer_racing.settings import check_choice

CRITICS = ("latent", "state")
"""Inputs that PPO's critic may have."""
CRITIC_LAYERS, CRITIC_UNITS = 3, 256
"""Number and width of the hidden layers of PPO's critic [choice]."""
RATE_CHANGE, SMALLEST_SCALE = 1.25, 0.01
"""Factor by which the KL control changes the learning-rate scale, and the smallest scale [choice]."""

MinibatchLoss = Callable[[Tensor], tuple[Tensor, dict[str, Tensor]]]
"""Function of record indices ``(M,)`` that returns a scalar loss and metrics; a policy's include ``ppo/kl``."""


class LatentPPO(WorldModelLearner):
    """Trains the world model in each update, and actor and critic by PPO whenever the rollout storage is full.

    `compute_losses` and `update_actor` are the algorithm.

    Args:
        agent: The networks, on the device where updates run.
        losses: Settings of the losses; ``actor`` names the objective, ``critic`` the input of PPO's critic.
        config: Settings of the update.

    Attributes:
        critic: PPO's critic, from which the advantages are computed; not the agent's critic.
        storage: Collected steps.
        actor_waits: Whether updates of actor and PPO's critic are suspended; settable.

    Raises:
        ValueError: If the critic needs the simulator's state, and the environment does not give it.

    Example:
        >>> learner = LatentPPO.make("debug", seed=0)
        >>> learner.storage.full
        False
    """

    algorithm = "latent_ppo"
    behavior = ("critic",)
    Losses = LatentPPOLosses
    loss_config: LatentPPOLosses

    def __init__(
        self, agent: Agent, losses: LatentPPOLosses | None = None, config: LearnerConfig | None = None
    ) -> None:
        super().__init__(agent, losses, config)
        ppo = self.loss_config.ppo
        self.objective = find_objective(self.loss_config.actor, collected=True)
        self.storage = RolloutStorage(ppo.steps, self.device, privileged=self.loss_config.critic == "state")
        self.actor_update = PPOUpdate(agent.actor, ppo.learning_rate, ppo, ppo.kl_target)
        self.critic_update = PPOUpdate(self.critic, ppo.critic_learning_rate, ppo)
        self.actor_waits = False

    def make_networks(self) -> dict[str, nn.Module]:
        """Make PPO's critic."""
        sees, interface, size = self.loss_config.critic, self.agent.interface, self.size
        check_choice("loss.critic", sees, CRITICS)
        if sees == "state" and interface.privileged_dim < 1:
            raise ValueError(
                "critic='state' needs the simulator's state, but the environment gives none under "
                f"{PRIVILEGED}: use an environment with privileged=True, or critic='latent'."
            )
        width = interface.privileged_dim if sees == "state" else size.features
        self.critic = TwoHotHead(width, CRITIC_LAYERS, CRITIC_UNITS, size.norm, size.bins).to(self.device)
        return {f"{sees}_critic": self.critic}

    def collect(self, rollout: TensorDictBase) -> None:
        """Store a collector's rollout ``[N, T]``, flown by `policy`, perhaps with older weights."""
        self.storage.extend(rollout)

    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step of the world model, and update the actor if the rollout storage is full.

        See `WorldModelLearner.update`. If the actor was updated, the metrics also have ``ppo/loss``, ``ppo/kl``,
        ``ppo/clipped`` (share of steps), ``ppo/epochs``, ``ppo/learning_rate_scale``, ``ppo/critic_loss``,
        ``ppo/explained_variance`` (of the returns, by the values before the update), ``entropy`` (of the policy that
        acted, nats) and both gradient norms. ``NonFiniteLossError`` says if it was raised by the actor's update.
        """
        metrics = self.gradient_step(batch, timed)
        if self.storage.full and not self.actor_waits:
            with timed("improve"):
                updated = parallel.averaged(self.update_actor())
            assert self.storage.steps is not None
            kept = self.storage.steps.flatten()
            if self.device.type == "cuda":
                kept = kept.clone()  # the guard reads it two checks later; new rollouts overwrite the storage
            self._guard.check(updated, kept, of=" of the actor's update")
            metrics = joined(metrics, updated)
        self.average_weights()
        return metrics

    def compute_losses(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Return the losses of the world model and of the agent's critic, which carry gradient, and metrics.

        Args:
            batch: Replayed records ``[B, T]``.
            timed: Context manager by activity.
        """
        # World model: infer the records' latents, predict rewards, episode ends and targets, and penalise changes of
        # the policy by changed latents.
        with timed("world_model"):
            losses, latents = self.world_model_loss(batch)
            losses = joined(losses, self.drift_losses(latents, batch))
        self.store_latents(latents)
        # Agent's critic: its regression on replayed λ-returns also trains the latents to tell what returns depend on.
        with timed("imagine"):
            losses = joined(losses, self.replay_critic_losses(latents, batch))
        return losses

    def update_actor(self) -> dict[str, Tensor]:
        """Update critic and actor on all collected steps, and empty the storage; return metrics, scalars."""
        numbers, ppo, steps = self.loss_config, self.loss_config.ppo, self.storage.steps
        assert steps is not None, "called when the storage is full"
        self.storage.clear()
        # In float32, as the policy acted: at small standard deviations bfloat16's rounding would add to the divergence.
        with torch.autocast(self.device.type, enabled=False):
            # λ-returns (S, N, 1) of the collected rewards, with the critic's values before this update.
            seen = steps["privileged"] if numbers.critic == "state" else steps["features"]
            with torch.no_grad():
                value = self.critic.mean(seen)
                returns = rollout_return(
                    steps["reward"], value, steps["done"], steps["terminated"], self.discount, numbers.lambda_
                )
            taken = steps.flatten()  # [M]
            behavior = ActionDistribution(*taken["behavior"].chunk(2, -1))
            inputs, targets = seen.flatten(0, 1), returns.flatten(0, 1)

            # Critic: epochs of two-hot regression on the returns.
            def critic_loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
                log_probabilities = self.critic(inputs[chosen]).log_softmax(-1)
                return self.critic.two_hot.cross_entropy(log_probabilities, targets[chosen]).mean(), {}

            learned = self.critic_update.run(len(taken), critic_loss)

            # Actor: epochs of the objective, until the divergence from the policy before this update is too large. It
            # is not measured from the policy that acted, because a bound on the standard deviation that was lowered
            # since then would count as divergence and end the epochs.
            advantage = normalized(targets - value.flatten(0, 1)).clamp(-ppo.advantage_clip, ppo.advantage_clip)
            with torch.no_grad():
                before = torch.cat(self.agent.actor(taken["features"]), -1)  # (M, 2·A)

            def actor_loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
                policy = self.agent.actor(taken["features"][chosen])
                trajectory = Trajectory(
                    policy=policy,
                    features=taken["features"][chosen],
                    action=taken["action"][chosen],
                    previous_action=taken["previous_action"][chosen],
                    behavior=ActionDistribution(*(part[chosen] for part in behavior)),
                    lambda_return=targets[chosen],
                    value=value.flatten(0, 1)[chosen],
                    advantage=advantage[chosen],
                    weight=targets.new_ones(len(chosen), 1),
                    scale=targets.new_ones(()),
                )
                loss, metrics = self.objective(
                    trajectory, entropy_scale=self.entropy_scale, clip_epsilon=ppo.clip_epsilon
                )
                with torch.no_grad():  # over all processes, which must end their epochs together
                    diverged = ActionDistribution(*before[chosen].chunk(2, -1)).divergence(policy)
                    kl = parallel.total(diverged.sum()) / parallel.total(trajectory.weight.sum())
                return loss, {**metrics, "ppo/kl": kl}

            moved = self.actor_update.run(len(taken), actor_loss)
            moved |= {"ppo/loss": moved.pop("loss"), "gradient_norm/actor": moved.pop("gradient_norm")}
        measured = {
            "ppo/critic_loss": learned["loss"],
            "gradient_norm/own_critic": learned["gradient_norm"],
            "ppo/explained_variance": 1.0 - (returns - value).var() / returns.var().clamp_min(1e-8),
            "entropy": behavior.entropy().mean(),
        }
        return joined(measured, moved)

    @torch.no_grad()
    def _value(self, acted: TensorDictBase) -> Tensor:
        """Return the values ``(N, 1)`` by PPO's critic of records ``[N]`` that `DreamerPolicy` has acted on."""
        if self.loss_config.critic == "state":
            seen = symlog(acted[PRIVILEGED])
        else:  # the latents after the observation are under "next"
            seen = join_features(acted["next", "belief"], acted["next", "state"])
        return self.critic.mean(seen.to(self.device))

    def adjust(self, *, kl_target: float | None = None, **numbers: Any) -> None:
        """Set scheduled hyperparameters, from the next update on; see `WorldModelLearner.adjust`.

        Args:
            kl_target: See `PPOUpdateConfig`.
            numbers: Arguments of `WorldModelLearner.adjust`; ``rates`` also scales PPO's learning rates.
        """
        super().adjust(**numbers)
        ppo = self.loss_config.ppo
        if (rates := numbers.get("rates")) is not None:
            self.actor_update.optimizer.param_groups[0]["lr"] = ppo.learning_rate * rates
            self.critic_update.optimizer.param_groups[0]["lr"] = ppo.critic_learning_rate * rates
        if kl_target is not None:
            self.actor_update.kl_target = kl_target

    @property
    def learning_rates(self) -> dict[str, float]:
        """Current learning rates by what they train; the actor's without the factor that ``kl_target`` sets."""
        world_model, latent_critic = super().learning_rates.values()
        updates = {"actor": self.actor_update, "critic": self.critic_update}
        own = {name: update.optimizer.param_groups[0]["lr"] for name, update in updates.items()}
        return {"world_model": world_model, "latent_critic": latent_critic, **own}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, except the global random generators."""
        return {
            **super().state_dict(),
            "actor_update": self.actor_update.state_dict(),
            "critic_update": self.critic_update.state_dict(),
            "storage": self.storage.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; see `WorldModelLearner.load_state_dict`."""
        super().load_state_dict(state_dict)
        for name in ("actor_update", "critic_update", "storage"):
            getattr(self, name).load_state_dict(state_dict[name])


def masks_steps(device: torch.device) -> bool:
    """Return whether disabled steps are masked on a device; to skip them, the CPU would have to wait for the device."""
    return device.type == "cuda"


class PPOUpdate:
    """Trains one network on collected steps, with its own optimiser.

    Args:
        network: Actor or critic.
        learning_rate: Learning rate of Adam; with a ``kl_target``, its maximum.
        config: Epochs, minibatches, clipping and the divergence that ends an update.
        kl_target: Target of the KL divergence before an update's last gradient step, nats, towards which the learning
            rate is adapted; None keeps the rate constant. May be set between updates.

    Attributes:
        learning_rate_scale: Factor on the learning rate in the next update, ``(1,)``.
    """

    def __init__(
        self, network: nn.Module, learning_rate: float, config: PPOUpdateConfig, kl_target: float | None = None
    ) -> None:
        self.network = network
        self.config = config
        self.kl_target = kl_target
        self.device = next(network.parameters()).device
        self.learning_rate_scale = torch.ones(1, device=self.device)
        self._masked = masks_steps(self.device)
        # Only fused Adam accepts a mask and a learning rate that is a tensor.
        self.optimizer = torch.optim.Adam(
            network.parameters(), lr=learning_rate, eps=1e-5, fused=True if self._masked else None
        )

    def run(self, number: int, loss: MinibatchLoss) -> dict[str, Tensor]:
        """Make epochs of gradient steps on so many records; stop early if the KL divergence exceeds ``kl_stop``.

        Steps with a non-finite gradient are skipped.

        Returns:
            Scalars, averaged over the gradient steps: ``loss``, ``gradient_norm`` before clipping, and the metrics of
            ``loss``. If these have ``ppo/kl``: its value before the last step, ``ppo/epochs``, and this update's
            ``ppo/learning_rate_scale``.
        """
        if self.kl_target is None:
            self.learning_rate_scale.fill_(1.0)
        scale, group = self.learning_rate_scale.clone(), self.optimizer.param_groups[0]
        rate = group["lr"]
        group["lr"] = rate * (scale if self._masked else float(scale))
        try:
            metrics = self._make_epochs(number, loss)
        finally:
            group["lr"] = rate
        if "ppo/kl" in metrics:
            metrics["ppo/learning_rate_scale"] = scale.squeeze()
            self._control(metrics["ppo/kl"])
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the optimiser and of the learning-rate scale."""
        return {"optimizer": self.optimizer.state_dict(), "learning_rate_scale": self.learning_rate_scale.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; learning rates are settings and stay as they are."""
        restore(self.optimizer, state_dict["optimizer"])
        self.learning_rate_scale.copy_(state_dict["learning_rate_scale"])

    def _make_epochs(self, number: int, loss: MinibatchLoss) -> dict[str, Tensor]:
        """Make the gradient steps; average metrics over those that were applied, but keep the last ``ppo/kl``."""
        minibatches = math.ceil(number / self.config.minibatch)
        active = torch.ones((), dtype=torch.bool, device=self.device)
        done, applied = list[dict[str, Tensor]](), list[Tensor]()
        orders = (torch.randperm(number, device=self.device) for _ in range(self.config.epochs))
        # The sizes of minibatches differ by at most one.
        for chosen in (part for order in orders for part in order.tensor_split(minibatches)):
            metrics = self._step(*loss(chosen), active)
            done.append(metrics)
            applied.append(active)
            if "ppo/kl" in metrics:
                active = active & (metrics["ppo/kl"] <= self.config.kl_stop)
                if not self._masked and not active:
                    break
        mask = torch.stack(applied)
        steps = mask.sum()
        values = {name: torch.stack([metrics[name] for metrics in done]) for name in done[0]}
        means = {name: value.where(mask, 0.0).sum() / steps for name, value in values.items()}
        if "ppo/kl" in values:
            means["ppo/kl"] = values["ppo/kl"].gather(0, steps.unsqueeze(0) - 1).squeeze(0)
            means["ppo/epochs"] = steps.to(means["ppo/kl"].dtype) / minibatches
        return means

    def _step(self, loss: Tensor, metrics: dict[str, Tensor], active: Tensor) -> dict[str, Tensor]:
        """Make one gradient step if ``active`` (a bool scalar) and if the gradient is finite."""
        check_scalars({"loss": loss, **metrics})
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if parallel.num_processes() > 1:
            parallel.average_gradients(self.network.parameters())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        good = norm.isfinite() & active
        if self._masked:
            self.optimizer.found_inf = (~good).float()  # type: ignore[attr-defined]  # what a `GradScaler` tells it
            self.optimizer.step()
        elif good:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return joined({"loss": loss.detach(), "gradient_norm": norm}, metrics)

    def _control(self, kl: Tensor) -> None:
        """Lower the learning rate if the divergence is well above its target; raise it, at most to 1, if well below.

        Reference: Schulman et al. 2017, Section 4, who adapt the weight of a KL penalty this way.
        """
        target, scale = self.kl_target, self.learning_rate_scale
        if target is None:
            return
        lower, higher = (scale / RATE_CHANGE).clamp(min=SMALLEST_SCALE), (scale * RATE_CHANGE).clamp(max=1.0)
        changed = torch.where(kl < target / KL_TOLERANCE, higher, scale)
        scale.copy_(torch.where(kl <= KL_TOLERANCE * target, changed, lower))  # lower also if kl is NaN
