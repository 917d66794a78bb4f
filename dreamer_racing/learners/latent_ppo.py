"""Recurrent PPO in a world model's latents: the world model sees and remembers, the policy learns from real rewards.

The world model learns from replayed records. The policy, whose observations are its latents, learns by PPO from
collected rollouts, once there are enough of them; so does a critic of its own, of the latents or of the simulator's
state. Nothing is imagined: an actor that learns in imagination ends up where the model is wrong, and the time goes to
the world model. The agent's critic learns from replayed returns alone, which shape the latents, too.

Shape legend: B batch, T time, S steps kept of each of N environments, F features, A action, M records of a minibatch.

Reference: Schulman et al. 2017, "Proximal policy optimization algorithms"; of the critic of the state Pinto et al.
2018, "Asymmetric actor critic for image-based robot learning".
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.experience.rollout_storage import RolloutStorage
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.learner import Timer, ValueFunction, untimed
from dreamer_racing.learners.ppo_update import PPOUpdate
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import (
    LatentPPOLosses,
    Trajectory,
    find_objective,
    normalized,
    replay_critic_loss,
    rollout_return,
)
from dreamer_racing.modules import Agent
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.heads import TwoHotHead, symlog
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.modules.world_model import join_features
from dreamer_racing.settings import suggestion

CRITICS = ("latent", "state")
"""What the critic that teaches the actor may see."""
CRITIC_LAYERS, CRITIC_UNITS = 3, 256
"""Hidden layers of that critic [choice]."""


class LatentPPO(WorldModelLearner):
    """Trains the world model in each update, and the actor with its critic whenever enough was collected.

    `compute_losses` and `update_actor` are the algorithm.

    Args:
        agent: The networks, on the device where updates run.
        losses: Numbers of the losses; ``actor`` is the objective, ``critic`` what its critic sees.
        config: Numbers of the update.

    Attributes:
        critic: The one that teaches the actor.
        storage: Collected steps.
        actor_waits: Whether the actor stands still; settable.

    Raises:
        ValueError: If the critic is to see the simulator's state, which the environment does not give.

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
        """Make the critic that teaches the actor."""
        sees, interface, size = self.loss_config.critic, self.agent.interface, self.size
        if sees not in CRITICS:
            raise ValueError(f"Unknown critic {sees!r}{suggestion(sees, CRITICS)}. There are {', '.join(CRITICS)}.")
        if sees == "state" and interface.privileged_dim < 1:
            raise ValueError(
                "critic='state' needs the simulator's state, but the environment gives none under "
                f"{PRIVILEGED}: use an environment with privileged=True, or critic='latent'."
            )
        width = interface.privileged_dim if sees == "state" else size.features
        self.critic = TwoHotHead(width, CRITIC_LAYERS, CRITIC_UNITS, size.norm, size.bins).to(self.device)
        return {f"{sees}_critic": self.critic}

    def collect(self, rollout: TensorDictBase) -> None:
        """Keep a collector's rollout ``[N, T]``, of `policy`, perhaps with older weights."""
        self.storage.extend(rollout)

    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step of the world model, and update the actor if enough was collected.

        As `WorldModelLearner.update`; with ``ppo/loss``, ``ppo/kl``, ``ppo/clipped`` (share of steps), ``ppo/epochs``,
        ``ppo/learning_rate_scale``, ``ppo/critic_loss``, ``ppo/explained_variance`` (of the returns, by the values
        before), ``entropy`` (of the policy that acted, nats) and the norms of both gradients where the actor was
        updated. An error says if it is the actor's update that was not finite.
        """
        metrics = self.gradient_step(batch, timed)
        if self.storage.full and not self.actor_waits:
            with timed("improve"):
                updated = parallel.averaged(self.update_actor())
            assert self.storage.steps is not None
            kept = self.storage.steps.flatten()
            if self.device.type == "cuda":
                kept = kept.clone()  # the guard looks two entries later, and rollouts are written there meanwhile
            self._guard.check(updated, kept, of=" of the actor's update")
            metrics |= updated
        self.average_weights()
        return metrics

    def compute_losses(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Return the losses of the world model, and of the agent's critic, which shapes latents; and metrics.

        Args:
            batch: Replayed records ``[B, T]``.
            timed: Context manager by activity.
        """
        numbers = self.loss_config
        # World model: infer the latents of the records, predict from them rewards, ends and targets; leave the policy
        # where it was.
        with timed("world_model"):
            losses, latents = self.world_model_loss(batch)
            losses |= self.drift_losses(latents, batch)
        self.note_latents(latents)
        # What is worth much is seen well: the regression of replayed λ-returns trains the world model, too.
        with timed("imagine"):
            features = latents.features if numbers.replay_value_gradient else latents.features.detach()
            losses["loss_replay_critic"] = numbers.replay_value_scale * replay_critic_loss(
                self.agent.critic, features, batch, self.discount, numbers.lambda_, numbers.slow_critic_scale
            )
        return losses

    def update_actor(self) -> dict[str, Tensor]:
        """Update critic and actor on all collected steps, which begin anew; return metrics, scalars."""
        numbers, ppo, steps = self.loss_config, self.loss_config.ppo, self.storage.steps
        assert steps is not None, "called when the storage is full"
        self.storage.clear()
        # The policy acted in float32: at small deviations the rounding of bfloat16 would be a divergence of its own.
        with torch.autocast(self.device.type, enabled=False):
            # λ-returns of what was paid (S, N, 1), by what the critic expected before.
            seen = steps["privileged"] if numbers.critic == "state" else steps["features"]
            with torch.no_grad():
                value = self.critic.mean(seen)
                returns = rollout_return(
                    steps["reward"], value, steps["done"], steps["terminated"], self.discount, numbers.lambda_
                )
            taken = steps.flatten()  # [M]
            behavior = ActionDistribution(*taken["behavior"].chunk(2, -1))
            inputs, targets = seen.flatten(0, 1), returns.flatten(0, 1)

            # Critic: epochs of two-hot regression of the returns.
            def critic_loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
                log_probabilities = self.critic(inputs[chosen]).log_softmax(-1)
                return self.critic.two_hot.cross_entropy(log_probabilities, targets[chosen]).mean(), {}

            learned = self.critic_update.run(len(taken), critic_loss)

            # Actor: epochs of the objective, until the policy has moved too far from the one before the update. Not
            # from the one that acted: a bound of the deviation that has come down since would count as if the steps
            # had done it, and end them.
            weight = torch.ones_like(targets)
            advantage = normalized(targets - value.flatten(0, 1), weight).clamp(-ppo.advantage_clip, ppo.advantage_clip)
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
                    weight=weight[chosen],
                    scale=weight.new_ones(()),
                )
                loss, metrics = self.objective(
                    trajectory, entropy_scale=self.entropy_scale, clip_epsilon=ppo.clip_epsilon
                )
                with torch.no_grad():  # over all processes: it ends the epochs of all
                    diverged = ActionDistribution(*before[chosen].chunk(2, -1)).divergence(policy)
                    number = parallel.total(trajectory.weight.sum()).clamp_min(1e-8)
                    kl = parallel.total((trajectory.weight * diverged).sum()) / number
                return loss, {**metrics, "ppo/kl": kl}

            moved = self.actor_update.run(len(taken), actor_loss)
            moved |= {"ppo/loss": moved.pop("loss"), "gradient_norm/actor": moved.pop("gradient_norm")}
        return {
            "ppo/critic_loss": learned["loss"],
            "gradient_norm/own_critic": learned["gradient_norm"],
            "ppo/explained_variance": 1.0 - (returns - value).var() / returns.var().clamp_min(1e-8),
            "entropy": behavior.entropy().mean(),
            **moved,
        }

    def value_function(self) -> ValueFunction:
        """Return what the critic that teaches the actor makes of a state."""
        return self._value_of_step

    @torch.no_grad()
    def _value_of_step(self, acted: TensorDictBase) -> Tensor:
        """Return the value ``(N, 1)`` of records ``[N]`` that `DreamerPolicy` has acted on."""
        if self.loss_config.critic == "state":
            seen = symlog(acted[PRIVILEGED])
        else:  # latents that have seen the observation are under "next"
            seen = join_features(acted["next", "belief"], acted["next", "state"])
        return self.critic.mean(seen.to(self.device))

    def adjust(self, *, kl_target: float | None = None, **numbers: Any) -> None:
        """Change what a run may have on a schedule, from the next update on; as `WorldModelLearner.adjust`.

        Args:
            kl_target: Of `PPOUpdateConfig`.
            numbers: Others; ``rates`` is also of the actor's update and of its critic's.
        """
        super().adjust(**numbers)
        ppo = self.loss_config.ppo
        if (rates := numbers.get("rates")) is not None:
            self.actor_update.optimizer.param_groups[0]["lr"] = ppo.learning_rate * rates
            self.critic_update.optimizer.param_groups[0]["lr"] = ppo.critic_learning_rate * rates
        if kl_target is not None:
            self.actor_update.kl_target = kl_target

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, but for the global random generators."""
        return {
            **super().state_dict(),
            "actor_update": self.actor_update.state_dict(),
            "critic_update": self.critic_update.state_dict(),
            "storage": self.storage.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; as `WorldModelLearner.load_state_dict`."""
        super().load_state_dict(state_dict)
        for name in ("actor_update", "critic_update", "storage"):
            getattr(self, name).load_state_dict(state_dict[name])
