"""DreamerV3: the world model learns from replayed records, and the policy learns from rollouts imagined in it.

Shape legend: B batch, T time, N starts, H horizon, F features, A action. Imagined steps have time first.

Reference: Hafner et al. 2025, "Mastering diverse control tasks through world models".
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import PercentileValueNorm

from dreamer_racing import parallel
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.gradient_step import GraphedStep
from dreamer_racing.learners.learner import Timer, untimed
from dreamer_racing.learners.update import WorldModelLearner, fill_given
from dreamer_racing.losses import (
    DreamerV3Losses,
    Trajectory,
    choose_starts,
    critic_loss,
    find_objective,
    gradient_of_actions,
    imagine,
    joined,
    lambda_return,
    open_loop_loss,
)
from dreamer_racing.modules import Agent
from dreamer_racing.modules.heads import ActionDistribution


class DreamerV3(WorldModelLearner):
    """Trains world model, actor and critic in one gradient step; `compute_losses` is the algorithm.

    Args:
        agent: The networks, on the device where updates run.
        losses: Settings of the losses; ``actor`` names the objective.
        config: Settings of the update.

    Example:
        >>> learner = DreamerV3.make("debug", seed=0)
        >>> learner.policy().in_keys
        ['pixels', 'is_init', 'belief', 'state', 'previous_action']
    """

    algorithm = "dreamer_v3"
    behavior = ("actor", "critic")
    Losses = DreamerV3Losses
    loss_config: DreamerV3Losses

    def __init__(
        self, agent: Agent, losses: DreamerV3Losses | None = None, config: LearnerConfig | None = None
    ) -> None:
        losses = losses or DreamerV3Losses()
        self.objective = find_objective(losses.actor, collected=False)
        device = next(agent.parameters()).device
        self.return_range = PercentileValueNorm(quantiles=(0.05, 0.95), rate=1 - losses.return_decay, min_scale=1.0).to(
            device
        )
        self.action_change_scale = torch.tensor(float(losses.action_change_scale), device=device)
        self.averaged_kl_scale = torch.tensor(float(losses.averaged_kl_scale), device=device)
        self._stays_near_average = losses.averaged_kl_scale > 0
        self.crash_weight = torch.tensor(float(losses.crash_weight), device=device)
        super().__init__(agent, losses, config)

    def update(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step for all networks; see `WorldModelLearner.update`."""
        waits = self.updates < self.loss_config.actor_begin
        before = [parameter.detach().clone() for parameter in self._trained["actor"]] if waits else []
        metrics = self.gradient_step(batch, timed)
        if waits:  # undone rather than left out: the optimiser must know the gradient's scale when the actor begins
            torch._foreach_copy_([parameter.detach() for parameter in self._trained["actor"]], before)
        self.average_weights()
        return metrics

    def compute_losses(self, batch: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Return the losses of world model, actor and critic, which carry gradient, and metrics.

        Args:
            batch: Replayed records ``[B, T]``.
            timed: Context manager by activity.
        """
        numbers, agent = self.loss_config, self.agent
        model, actor, critic = agent.world_model, agent.actor, agent.critic

        # World model: infer the records' latents, and predict rewards, episode ends and targets (Eq. 4, 5).
        with timed("world_model"):
            losses, latents = self.world_model_loss(batch)
            losses = joined(losses, self.drift_losses(latents, batch))
            if numbers.open_loop_steps:
                ahead = open_loop_loss(model, latents, batch, numbers.open_loop_steps)
                losses = joined(losses, {"loss_open_loop": ahead})
        self.store_latents(latents)

        # Imagination takes much of an update's time, so it may be left out of some.
        if self.updates % self.config.imagination_every:
            with timed("imagine"):
                return joined(losses, self.replay_critic_losses(latents, batch))

        with timed("imagine"):
            # Imagination: starting from latents of the records, the policy acts H times in the world model.
            num_starts = self.config.imagination_starts
            starts = choose_starts(
                latents.belief, latents.state, batch["terminated"], batch["previous_action"], num_starts
            )
            with gradient_of_actions(self.objective, model, critic):
                imagined, action = imagine(model.rssm, actor, starts.belief, starts.state, self.horizon)

                # Rewards, probabilities that the episode continues, and λ-returns of the rollout, (H, N, 1) (Eq. 7).
                value = critic.value(imagined)  # (H + 1, N, 1)
                after = imagined[1:]
                reward = model.reward_head.mean(after)
                goes_on = model.continue_head.probability(after) if numbers.continuation else torch.ones_like(reward)
                discount = self.discount * goes_on.pow(self.crash_weight)
                returns = lambda_return(reward, value[1:], discount, numbers.lambda_)

            # A step's weight is the discounted probability of reaching it: 0 if the start had ended its episode.
            start = 1.0 - starts.terminated.to(discount.dtype).unsqueeze(0)
            weight = torch.cat((start, discount[:-1].detach())).cumprod(0)
            self.return_range.update(parallel.all_gather(returns.detach(), dim=1))
            scale = self.return_range.scale().squeeze(-1)

            # Actor: the objective on the imagined steps, with detached features (Eq. 11).
            features = imagined[:-1].detach()  # (H, N, F)
            policy = actor(features)
            trajectory = Trajectory(
                policy=policy,
                features=features,
                action=action,
                previous_action=torch.cat((starts.previous_action.unsqueeze(0), action[:-1].clamp(-1.0, 1.0))),
                behavior=ActionDistribution(policy.mean.detach(), policy.std.detach()),
                lambda_return=returns,
                value=value[:-1],
                advantage=((returns - value[:-1]) / scale).detach(),
                weight=weight,
                scale=scale,
            )
            objective, metrics = self.objective(trajectory, entropy_scale=self.entropy_scale)
            if wrong := [name for name in metrics if name.startswith("loss")]:
                raise ValueError(f"loss.actor: the metric {wrong[0]!r} would be added to the losses: rename it.")
            penalty, measured = self.policy_penalty(trajectory)
            losses = joined(losses, metrics, measured, {"loss_actor": objective + penalty})

            # Critic: two-hot regression on the λ-returns of replayed and of imagined steps (Eq. 10). If every record
            # was a start, replayed returns bootstrap from its imagined return, which is better than the critic's value.
            bootstrap = None if num_starts else returns[0].detach().reshape(batch["terminated"].shape)
            losses = joined(losses, self.replay_critic_losses(latents, batch, bootstrap))
            regression, logits = critic_loss(critic, features, returns.detach(), numbers.slow_critic_scale)
            losses = joined(losses, {"loss_critic": (weight * regression).mean()})

        with torch.no_grad():
            expected = critic.two_hot.decode(logits)
            measured = {
                "return_mean": returns.mean(),
                "return_scale": scale,
                "imagined_reward": reward.mean(),
                "continuation": goes_on.mean(),
                "value_mean": expected.mean(),
                "value_error": (expected - returns).abs().mean(),
            }
            return joined(losses, measured)

    def policy_penalty(self, trajectory: Trajectory) -> tuple[Tensor, dict[str, Tensor]]:
        """Return what is added to any objective, a scalar, and metrics.

        It is the weighted sum of the policy's change from step to step and, if turned on, of KL(averaged ‖ current),
        nats: the divergence from the averaged actor, at the same latents of the current world model.

        Raises:
            ValueError: If the divergence from the averaged policy is turned on, and no averaged weights are kept.
        """
        change = trajectory.action_change()
        penalty, metrics = self.action_change_scale * change, {"action_change": change.detach()}
        if not self._stays_near_average:
            return penalty, metrics
        if self.averaged is None:
            raise ValueError("loss.averaged_kl_scale needs averaged weights: set model.average_rate, such as to 0.005.")
        with torch.no_grad():
            averaged = self.averaged.actor(trajectory.features)
        divergence = trajectory.mean(averaged.divergence(trajectory.policy))
        return penalty + self.averaged_kl_scale * divergence, metrics | {"averaged_kl": divergence.detach()}

    def adjust(
        self,
        *,
        imagination_horizon: float | None = None,
        action_change_scale: float | None = None,
        averaged_kl_scale: float | None = None,
        crash_weight: float | None = None,
        **numbers: Any,
    ) -> None:
        """Set scheduled hyperparameters, from the next update on; see `WorldModelLearner.adjust`.

        Args:
            imagination_horizon: H, rounded; if it changes, the CUDA graph is captured again.
            action_change_scale: Weight of the changes of the policy's mean from step to step.
            averaged_kl_scale: Weight of the policy's divergence from that of the averaged weights; the first time it is
                given, the graph is captured again, too.
            crash_weight: Power of the predicted probability that an imagined episode continues.
            numbers: Arguments of `WorldModelLearner.adjust`.
        """
        super().adjust(**numbers)
        fill_given((self.action_change_scale, action_change_scale), (self.crash_weight, crash_weight))
        fill_given((self.averaged_kl_scale, averaged_kl_scale))
        horizon = self.horizon if imagination_horizon is None else round(imagination_horizon)
        near = self._stays_near_average or averaged_kl_scale is not None
        changed = (horizon, near) != (self.horizon, self._stays_near_average)
        self.horizon, self._stays_near_average = horizon, near
        if changed and self._graph is not None:
            self._graph = self._make_graph()

    @property
    def modules(self) -> nn.ModuleDict:
        """Modules that a gradient step reads and writes."""
        return nn.ModuleDict({**super().modules, "return_range": self.return_range})

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, except the global random generators."""
        return {**super().state_dict(), "return_range": self.return_range.state_dict()}

    def _make_graph(self) -> GraphedStep:
        """Return ``_backward`` as a step that is replayed as one CUDA graph; see `WorldModelLearner`."""
        if self.config.imagination_every != 1:
            raise ValueError(
                f"imagination_every={self.config.imagination_every} with cuda_graph=True: a graph does the same in "
                "every update. Use imagination_every=1, or cuda_graph=False."
            )
        return super()._make_graph()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; see `WorldModelLearner.load_state_dict`."""
        super().load_state_dict(state_dict)
        self.return_range.load_state_dict(state_dict["return_range"])
