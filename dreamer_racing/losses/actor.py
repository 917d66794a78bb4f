"""Actor loss: REINFORCE on imagined λ-returns.

Shape legend: N starts, H horizon, D belief, S state, F = D + S features.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import PercentileValueNorm
from torchrl.objectives import LossModule

from dreamer_racing.losses.imagination import imagine, lambda_return
from dreamer_racing.modules.actor import Actor
from dreamer_racing.modules.critic import Critic
from dreamer_racing.modules.world_model import WorldModel

if TYPE_CHECKING:
    from dreamer_racing.learner import Agent, LearnerConfig


class ActorLoss(LossModule):
    """Imagine from given latents and reinforce the actions that did better than the critic expected.

    ``−weight · (log π(a) · advantage / scale + entropy_scale · H[π])``, where scale is the moving range from the 5th to
    the 95th percentile of returns, but at least 1. The weight of a step is the probability that the episode got that
    far, discounted: it begins with the *true* continuation of the start (0 at a terminal record) and goes on with the
    predicted ones.

    Args:
        world_model: Dynamics, reward and continue heads; receives no gradient.
        actor: The module to train.
        critic: Baseline and bootstrap; receives no gradient.
        horizon: H, number of imagined actions.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the entropy.
        return_decay: Decay of the moving percentiles.

    Reads ``belief``, ``state`` and ``terminated`` of the starts, batch ``[N]`` (or any, which is flattened). Writes the
    scalars ``loss_actor``, ``entropy``, ``return_mean``, ``return_scale``, ``imagined_reward``, ``continuation`` (mean
    prediction), and ``imagination``, batch ``[H, N]``: ``features``, ``lambda_return`` and ``weight``, without
    gradient.

    Reference: DreamerV3, Eq. 11-12.
    """

    in_keys = ["belief", "state", "terminated"]
    out_keys = [
        "loss_actor",
        "entropy",
        "return_mean",
        "return_scale",
        "imagined_reward",
        "continuation",
        "imagination",
    ]

    def __init__(
        self,
        world_model: WorldModel,
        actor: Actor,
        critic: Critic,
        *,
        horizon: int = 16,
        discount: float = 0.997,
        lambda_: float = 0.95,
        entropy_scale: float = 3e-4,
        return_decay: float = 0.99,
    ) -> None:
        super().__init__()
        self.world_model = world_model
        self.actor = actor
        self.critic = critic
        self.horizon = horizon
        self.discount = discount
        self.lambda_ = lambda_
        self.entropy_scale = entropy_scale
        self.return_normalizer = PercentileValueNorm(quantiles=(0.05, 0.95), rate=1 - return_decay, min_scale=1.0)

    @classmethod
    def from_config(cls, agent: Agent, config: LearnerConfig) -> ActorLoss:
        """Make the loss of an agent with a learner's numbers."""
        return cls(
            agent.world_model,
            agent.actor,
            agent.critic,
            horizon=config.imagination_horizon,
            discount=config.discount,
            lambda_=config.lambda_,
            entropy_scale=config.entropy_scale,
            return_decay=config.return_decay,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of imagining from a batch of starts; keys in the class's docstring."""
        belief, state, terminated = (tensordict.get(key).detach().flatten(0, -2) for key in self.in_keys)
        features, action = imagine(self.world_model.rssm, self.actor, belief, state, self.horizon)
        judged = self._judge(features, terminated)
        policy = self.actor(features[:-1])
        entropy = policy.entropy()
        objective = policy.log_prob(action) * judged["advantage"] + self.entropy_scale * entropy
        imagination = TensorDict(
            {
                "features": features[:-1],
                "lambda_return": judged["lambda_return"],
                "weight": judged["weight"],
            },
            [self.horizon, len(belief)],
        )
        return TensorDict(
            {
                "loss_actor": -(judged["weight"] * objective).mean(),
                "entropy": entropy.detach().mean(),
                "return_mean": judged["lambda_return"].mean(),
                "return_scale": judged["return_scale"],
                "imagined_reward": judged["reward"].mean(),
                "continuation": judged["continuation"].mean(),
                "imagination": imagination,
            },
            [],
        )

    @torch.no_grad()
    def _judge(self, features: Tensor, terminated: Tensor) -> dict[str, Tensor]:
        """Compute returns, advantages and weights of a rollout.

        Args:
            features: ``(H + 1, N, F)``.
            terminated: Whether each start is a terminal record, bool ``(N, 1)``.

        Returns:
            ``reward``, ``continuation``, ``lambda_return``, ``advantage`` (over the return scale) and ``weight``, each
            ``(H, N, 1)``, and ``return_scale``, a scalar.
        """
        value = self.critic.value(features)
        reward = self.world_model.reward_head.mean(features[1:])
        continuation = self.world_model.continue_head.probability(features[1:])
        discount = self.discount * continuation
        returns = lambda_return(reward, value[1:], discount, self.lambda_)
        start = 1.0 - terminated.to(discount.dtype).unsqueeze(0)
        if self.training:
            self.return_normalizer.update(returns)
        scale = self.return_normalizer.scale()
        return {
            "reward": reward,
            "continuation": continuation,
            "lambda_return": returns,
            "advantage": (returns - value[:-1]) / scale,
            "weight": torch.cat((start, discount[:-1])).cumprod(0),
            "return_scale": scale.squeeze(-1),
        }
