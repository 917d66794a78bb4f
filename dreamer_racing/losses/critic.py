"""Critic loss: λ-returns of imagined rollouts and of the replayed sequences themselves.

Shape legend: B batch, T time, N starts, H horizon, F features.
"""

from __future__ import annotations

from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.losses.contract import require_keys, scheduled
from dreamer_racing.losses.imagination import lambda_return
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.critic import Critic
from dreamer_racing.modules.world_model import join_features


@torch.no_grad()
def replay_return(
    reward: Tensor,
    bootstrap: Tensor,
    is_init: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    discount: float | Tensor,
    lambda_: float,
) -> tuple[Tensor, Tensor]:
    """Compute λ-returns along windows that may hold several episodes.

    The return at record t uses the reward received on arriving at t + 1. Nothing crosses an episode's end: the return
    at a terminated record is 0, and that at any other last record is its bootstrap, as at the window's end.

    Args:
        reward: Received on arriving at each record, ``(B, T, 1)``.
        bootstrap: Value of each record, ``(B, T, 1)``.
        is_init: Whether each record is its episode's first, bool ``(B, T, 1)``.
        terminated: bool ``(B, T, 1)``.
        truncated: bool ``(B, T, 1)``.
        discount: γ, a number or a scalar.
        lambda_: λ.

    Returns:
        Returns ``(B, T, 1)``, and weights ``(B, T, 1)``: 0 at records whose return is only their bootstrap, else 1.
    """
    followed_by_init = torch.cat((is_init[:, 1:], torch.ones_like(is_init[:, :1])), 1)
    last = followed_by_init | terminated | truncated
    value = bootstrap.masked_fill(terminated, 0.0)
    # With λ = 0 on arriving at a last record, the return stops there; the discount stays γ, as its value is 0 if it
    # was terminated. Time first: (T - 1, B, 1).
    kept = lambda_ * (~last[:, 1:]).float()
    steps = lambda_return(
        reward[:, 1:].transpose(0, 1),
        value[:, 1:].transpose(0, 1),
        (discount * torch.ones_like(kept)).transpose(0, 1),
        kept.transpose(0, 1),
    )
    returns = torch.cat((steps.transpose(0, 1), value[:, -1:]), 1)
    return torch.where(last, value, returns), (~last | terminated).float()


class CriticLoss(LossModule):
    """Two-hot regression of the critic on imagined and replayed λ-returns, kept near its slow copy.

    Args:
        critic: The module to train.
        discount: γ.
        lambda_: λ of the replayed returns.
        slow_critic_scale: Weight of the regression on the slow copy's mean.
        replay_value_scale: Weight of the replayed returns.
        replay_value_gradient: Whether the replayed returns' loss reaches whatever graph ``belief`` and ``state`` carry,
            and so trains the world model too.

    Reads ``imagination`` as ``ActorLoss`` writes it, or goes without, and a batch ``[B, T]`` of ``belief``, ``state``,
    ``reward``, ``is_init``, ``terminated``, ``truncated``, with an optional ``bootstrap`` ``(B, T, 1)``: values of the
    records, default the critic's own. Writes the scalar ``loss_replay_critic``, and of what was imagined
    ``loss_critic``, ``value_mean`` and ``value_error`` (mean absolute).

    Reference: DreamerV3, Eq. 10 and "Critic learning".
    """

    in_keys = ["belief", "state", "reward", "is_init", "terminated", "truncated"]
    out_keys = ["loss_critic", "loss_replay_critic", "value_mean", "value_error"]

    def __init__(
        self,
        critic: Critic,
        *,
        discount: float = LossConfig.discount,
        lambda_: float = LossConfig.lambda_,
        slow_critic_scale: float = LossConfig.slow_critic_scale,
        replay_value_scale: float = LossConfig.replay_value_scale,
        replay_value_gradient: bool = LossConfig.replay_value_gradient,
    ) -> None:
        super().__init__()
        self.critic = critic
        self.discount = scheduled(discount)
        self.lambda_ = lambda_
        self.slow_critic_scale = slow_critic_scale
        self.replay_value_scale = replay_value_scale
        self.replay_value_gradient = replay_value_gradient

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return cls(
            agent.critic,
            discount=config.discount,
            lambda_=config.lambda_,
            slow_critic_scale=config.slow_critic_scale,
            replay_value_scale=config.replay_value_scale,
            replay_value_gradient=config.replay_value_gradient,
            **own,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the losses; keys in the class's docstring."""
        require_keys(self, tensordict, self.in_keys)
        losses = TensorDict({"loss_replay_critic": self.replay_value_scale * self._replay(tensordict)}, [])
        if (imagination := tensordict.get("imagination", None)) is not None:
            losses.update(self._imagined(imagination))
        return losses

    def _imagined(self, imagination: TensorDictBase) -> dict[str, Tensor]:
        """Return the losses on imagined returns ``[H, N]``."""
        returns = imagination.get("lambda_return")
        features = imagination.get("features")
        logits = self.critic(features)
        imagined = self._regression(features, logits, returns)
        with torch.no_grad():
            value = self.critic.two_hot.decode(logits)
        return {
            "loss_critic": (imagination.get("weight") * imagined).mean(),
            "value_mean": value.mean(),
            "value_error": (value - returns).abs().mean(),
        }

    def _replay(self, tensordict: TensorDictBase) -> Tensor:
        """Return the unscaled loss on the replayed records, a scalar."""
        features = join_features(tensordict.get("belief"), tensordict.get("state"))
        features = features if self.replay_value_gradient else features.detach()
        logits = self.critic(features)
        bootstrap = tensordict.get("bootstrap", None)
        if bootstrap is None:
            bootstrap = self.critic.two_hot.decode(logits.detach())
        returns, weight = replay_return(
            tensordict.get("reward"),
            bootstrap,
            tensordict.get("is_init"),
            tensordict.get("terminated"),
            tensordict.get("truncated"),
            self.discount,
            self.lambda_,
        )
        return (weight * self._regression(features, logits, returns)).mean()

    def _regression(self, features: Tensor, logits: Tensor, returns: Tensor) -> Tensor:
        """Return the loss of logits ``(..., K)`` on returns and on the slow value, ``(..., 1)``."""
        two_hot, log_probabilities = self.critic.two_hot, logits.log_softmax(-1)
        slow_value = self.critic.slow_value(features)
        loss = two_hot.cross_entropy(log_probabilities, returns)
        return loss + self.slow_critic_scale * two_hot.cross_entropy(log_probabilities, slow_value)
