"""λ-returns of rollouts and of replayed windows, and the critic's losses on them.

Shape legend: B batch, T time, N starts, H horizon or steps of a rollout, F features, K bins. Rollouts have time first.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.modules.heads import Critic


def lambda_return(reward: Tensor, next_value: Tensor, discount: Tensor, lambda_: float | Tensor) -> Tensor:
    """Compute λ-returns, last step first.

    ``G_t = reward_t + discount_t · ((1 − λ_t) · next_value_t + λ_t · G_{t+1})``, and ``G_H = next_value_{H−1}``.

    Args:
        reward: Reward for the action of step t, ``(H, ...)``.
        next_value: Value of the state that step t leads to, ``(H, ...)``.
        discount: γ times the probability that the episode continues there, ``(H, ...)``.
        lambda_: λ, one number or ``(H, ...)``.

    Reference: DreamerV3, Eq. 7.
    """
    carried = discount * lambda_
    # reward + discount · (1 − λ) · next_value, for all steps at once
    intermediate = torch.addcmul(reward, discount - carried, next_value)
    current, returns = next_value[-1], []
    for step, factor in zip(reversed(intermediate.unbind(0)), reversed(carried.unbind(0)), strict=True):
        current = torch.addcmul(step, factor, current)
        returns.append(current)
    return torch.stack(returns[::-1])


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
    """Compute λ-returns along windows that may contain several episodes.

    The return at record t starts with the reward received on arriving at t + 1. It never crosses an episode's end: the
    return at a terminated record is 0; at any other last record of an episode or window it is the bootstrap value.

    Args:
        reward: Received on arriving at each record, ``(B, T, 1)``.
        bootstrap: Value of each record, ``(B, T, 1)``.
        is_init: Whether each record is its episode's first, bool ``(B, T, 1)``, like the next two.
        terminated: Whether the episode ended there.
        truncated: Whether it was cut there.
        discount: γ, a number or a scalar.
        lambda_: λ.

    Returns:
        Returns, and weights ``(B, T, 1)``: 0 for records whose return is only their bootstrap, else 1.
    """
    followed_by_init = torch.cat((is_init[:, 1:], torch.ones_like(is_init[:, :1])), 1)
    last = followed_by_init | terminated | truncated
    value = bootstrap.masked_fill(terminated, 0.0)
    # λ = 0 on arriving at a last record ends the return there; the discount can stay γ, because the value of a
    # terminated record is 0. Time first: (T - 1, B, 1).
    kept = lambda_ * (~last[:, 1:]).float()
    steps = lambda_return(
        reward[:, 1:].transpose(0, 1),
        value[:, 1:].transpose(0, 1),
        (discount * torch.ones_like(kept)).transpose(0, 1),
        kept.transpose(0, 1),
    )
    returns = torch.cat((steps.transpose(0, 1), value[:, -1:]), 1)
    return torch.where(last, value, returns), (~last | terminated).float()


@torch.no_grad()
def rollout_return(
    reward: Tensor, value: Tensor, done: Tensor, terminated: Tensor, discount: Tensor, lambda_: float
) -> Tensor:
    """Compute λ-returns along rollouts of an environment that may contain several episodes, time first.

    The observation after a truncated step or after the rollout's last step has no value: the step's own value is used
    in its place.

    Args:
        reward: Reward for the action of each step, ``(T, N, 1)``.
        value: Value of each step, ``(T, N, 1)``.
        done: Whether the episode ended there, bool ``(T, N, 1)``.
        terminated: Whether it ended by termination, not by truncation, bool ``(T, N, 1)``.
        discount: γ, a scalar.
        lambda_: λ.
    """
    following = torch.where(done, value, torch.cat((value[1:], value[-1:])))
    return lambda_return(reward, following, discount * (~terminated).float(), lambda_ * (~done).float())


def critic_loss(critic: Critic, features: Tensor, returns: Tensor, slow_scale: float) -> tuple[Tensor, Tensor]:
    """Compute the critic's two-hot regression loss on returns and, times ``slow_scale``, on the value of its slow copy.

    Returns:
        The loss ``(..., 1)``, and the critic's logits ``(..., K)``, for features ``(..., F)`` and returns ``(..., 1)``.

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
    """Compute the critic's regression loss on λ-returns of replayed windows, a scalar.

    Args:
        critic: The module to train.
        features: Features of the records, ``(B, T, F)``; if they carry gradient, the loss also trains the world model.
        batch: Records ``[B, T]``: ``reward``, ``is_init``, ``terminated``, ``truncated``.
        discount: γ, a scalar.
        lambda_: λ.
        slow_scale: Weight of the regression on the slow copy.
        bootstrap: Values of the records, ``(B, T, 1)``; None for the critic's own.
    """
    logits = critic(features)
    if bootstrap is None:
        bootstrap = critic.two_hot.decode(logits.detach())
    is_init, terminated, truncated = (batch[name] for name in ("is_init", "terminated", "truncated"))
    returns, weight = replay_return(batch["reward"], bootstrap, is_init, terminated, truncated, discount, lambda_)
    return (weight * _regression(critic, features, logits, returns, slow_scale)).mean()


def _regression(critic: Critic, features: Tensor, logits: Tensor, returns: Tensor, slow_scale: float) -> Tensor:
    """Return the loss of logits ``(..., K)`` on returns and on the slow copy's value, ``(..., 1)``."""
    two_hot, log_probabilities = critic.two_hot, logits.log_softmax(-1)
    slow_value = critic.slow_value(features)
    loss = two_hot.cross_entropy(log_probabilities, returns)
    return loss + slow_scale * two_hot.cross_entropy(log_probabilities, slow_value)
