"""Critic losses: two-hot regression of λ-returns, kept near the critic's slow copy.

Shape legend: B batch, T time, F features.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.returns import replay_return
from dreamer_racing.modules.critic import Critic


def critic_loss(critic: Critic, features: Tensor, returns: Tensor, slow_scale: float) -> tuple[Tensor, Tensor]:
    """Compute the regression of the critic on returns, and on the slow copy's mean.

    Args:
        critic: The module to train.
        features: ``(..., F)``.
        returns: ``(..., 1)``.
        slow_scale: Weight of the slow copy.

    Returns:
        The loss ``(..., 1)``, and the critic's logits ``(..., K)``.

    Reference: DreamerV3, Eq. 10 and "Critic learning".
    """
    logits = critic(features)
    return _regression(critic, features, logits, returns, slow_scale), logits


def replay_critic_loss(
    critic: Critic,
    features: Tensor,
    batch: TensorDictBase,
    discount: Tensor,
    lambda_: float,
    slow_scale: float,
    bootstrap: Tensor | None = None,
) -> Tensor:
    """Compute the regression of the critic on λ-returns of replayed windows, a scalar.

    Args:
        critic: The module to train.
        features: Of the records, ``(B, T, F)``; if they carry a graph, the loss trains the world model, too.
        batch: Records ``[B, T]``: ``reward``, ``is_init``, ``terminated``, ``truncated``.
        discount: γ, a scalar.
        lambda_: λ.
        slow_scale: Weight of the slow copy.
        bootstrap: Values of the records, ``(B, T, 1)``; None for the critic's own.
    """
    logits = critic(features)
    if bootstrap is None:
        bootstrap = critic.two_hot.decode(logits.detach())
    is_init, terminated, truncated = (batch.get(name) for name in ("is_init", "terminated", "truncated"))
    returns, weight = replay_return(batch.get("reward"), bootstrap, is_init, terminated, truncated, discount, lambda_)
    return (weight * _regression(critic, features, logits, returns, slow_scale)).mean()


def _regression(critic: Critic, features: Tensor, logits: Tensor, returns: Tensor, slow_scale: float) -> Tensor:
    """Return the loss of logits ``(..., K)`` on returns and on the slow value, ``(..., 1)``."""
    two_hot, log_probabilities = critic.two_hot, logits.log_softmax(-1)
    slow_value = critic.slow_value(features)
    loss = two_hot.cross_entropy(log_probabilities, returns)
    return loss + slow_scale * two_hot.cross_entropy(log_probabilities, slow_value)
