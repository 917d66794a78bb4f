"""Rollouts inside the world model and the returns along them.

Shape legend: N starts, H horizon, F features, A action. Time comes first here, so that a step is one block of memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dreamer_racing.modules.actor import Actor
from dreamer_racing.modules.rssm import RSSM
from dreamer_racing.modules.world_model import join_features


class Imagination(NamedTuple):
    """An imagined rollout.

    Attributes:
        features: Belief and state before each action and after the last, ``(H + 1, N, F)``.
        action: Unclipped samples of the policy, ``(H, N, A)``.
    """

    features: Tensor
    action: Tensor


def imagine(
    rssm: RSSM, actor: Actor, belief: Tensor, state: Tensor, horizon: int, noise_correlation: float | Tensor = 0.0
) -> Imagination:
    """Let the policy act in the world model.

    Call it under ``torch.no_grad()`` where nothing shall flow back through the rollout, as with REINFORCE.

    Args:
        rssm: Dynamics.
        actor: Policy.
        belief: Starts, ``(N, D)``.
        state: Starts, ``(N, S)``.
        horizon: H, number of actions.
        noise_correlation: ρ of the actions' noise from one step to the next. With ρ a rollout strays
            sqrt((1 + ρ) / (1 − ρ)) times as far for the same deviation, as a drone does that holds another course. By
            itself each action is a sample of the policy; given the state that earlier noise led to it is not, so
            gradients that take it for one are biased, and the returns are of what strays, not of what is flown.
            Reference: Eberhard et al. 2023, "Pink noise is all you need"; Hollenstein et al. 2024, "Colored noise in
            PPO", who find the bias worth it.

    Returns:
        The rollout.
    """
    features, actions = [join_features(belief, state)], []
    noise: Tensor | None = None
    for _ in range(horizon):
        policy = actor(features[-1])
        noise = next_noise(noise, policy.mean, noise_correlation)
        action = policy.sample(noise)
        belief, state = rssm.imagine_step(belief, state, action)
        actions.append(action)
        features.append(join_features(belief, state))
    return Imagination(torch.stack(features), torch.stack(actions))


def next_noise(noise: Tensor | None, like: Tensor, correlation: float | Tensor) -> Tensor:
    """Return standard normal noise of the shape of ``like``, correlated with that of the step before, if there is one.

    Args:
        noise: Of the step before; None at the first.
        like: For shape, type and device.
        correlation: ρ, from 0 to below 1, a number or a scalar.
    """
    fresh = torch.randn_like(like)
    if noise is None:
        return fresh
    return correlation * noise + (1.0 - correlation**2) ** 0.5 * fresh


def lambda_return(reward: Tensor, next_value: Tensor, discount: Tensor, lambda_: float | Tensor) -> Tensor:
    """Compute λ-returns, last step first.

    ``G_t = reward_t + discount_t · ((1 − λ_t) · next_value_t + λ_t · G_{t+1})``, and ``G_H = next_value_{H−1}``.

    Args:
        reward: Received on leaving step t, ``(H, ...)``.
        next_value: Value of where step t leads, ``(H, ...)``.
        discount: γ times the continuation of where step t leads, ``(H, ...)``.
        lambda_: λ, one number or ``(H, ...)``.

    Returns:
        Returns, ``(H, ...)``.

    Reference: DreamerV3, Eq. 7.
    """
    carried = discount * lambda_
    # reward + discount · (1 − λ) · next_value, of all steps at once
    intermediate = torch.addcmul(reward, discount - carried, next_value)
    current, returns = next_value[-1], []
    for step, factor in zip(reversed(intermediate.unbind(0)), reversed(carried.unbind(0)), strict=True):
        current = torch.addcmul(step, factor, current)
        returns.append(current)
    return torch.stack(returns[::-1])
