"""Rollouts inside the world model, λ-returns of rollouts and of replayed windows, and what a critic learns of them.

Shape legend: B batch, T time, N starts, H horizon or steps of a rollout, D belief, S state, F = D + S features, A
action. Of imagined rollouts time comes first, so that a step is one block of memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.modules.heads import Actor, Critic
from dreamer_racing.modules.layers import autocast_type
from dreamer_racing.modules.rssm import RSSM, join_features


class Imagination(NamedTuple):
    """An imagined rollout.

    Attributes:
        features: Belief and state before each action and after the last, ``(H + 1, N, F)``.
        action: Unclipped samples of the policy, ``(H, N, A)``.
    """

    features: Tensor
    action: Tensor


class Starts(NamedTuple):
    """Where imagination begins, without gradient.

    Attributes:
        belief: ``(N, D)``.
        state: ``(N, S)``.
        terminated: Whether the episode ended there, bool ``(N, 1)``.
        previous_action: That led there, ``(N, A)``.
    """

    belief: Tensor
    state: Tensor
    terminated: Tensor
    previous_action: Tensor


def choose_starts(
    belief: Tensor, state: Tensor, terminated: Tensor, previous_action: Tensor, number: int | None = None
) -> Starts:
    """Choose among the latents of a batch those that imagination begins from.

    Args:
        belief: Of its records, ``(B, T, D)``.
        state: ``(B, T, S)``.
        terminated: ``(B, T, 1)``.
        previous_action: ``(B, T, A)``.
        number: Of random ones; None for all, in order.
    """
    starts = Starts(*(value.detach().flatten(0, 1) for value in (belief, state, terminated, previous_action)))
    if number is None:
        return starts
    # Not randperm, which a CUDA graph cannot capture.
    order = torch.rand(len(starts.belief), device=belief.device).topk(min(number, len(starts.belief))).indices
    return Starts(*(value[order] for value in starts))


def imagine(rssm: RSSM, actor: Actor, belief: Tensor, state: Tensor, horizon: int) -> Imagination:
    """Let the policy act in the world model.

    Call it under ``torch.no_grad()`` where nothing shall flow back through the rollout, as with REINFORCE.

    Args:
        rssm: Dynamics.
        actor: Policy.
        belief: Starts, ``(N, D)``.
        state: Starts, ``(N, S)``.
        horizon: H, number of actions.

    Returns:
        The rollout.
    """
    if rssm.few_kernels and not torch.is_grad_enabled():
        return _imagine_low(rssm, actor, belief, state, horizon)
    features, actions = [join_features(belief, state)], []
    for _ in range(horizon):
        action = actor(features[-1]).sample()
        belief, state = rssm.imagine_step(belief, state, action)
        actions.append(action)
        features.append(join_features(belief, state))
    return Imagination(torch.stack(features), torch.stack(actions))


def _imagine_low(rssm: RSSM, actor: Actor, belief: Tensor, state: Tensor, horizon: int) -> Imagination:
    """Let the policy act in the world model, with fewer kernels.

    Noise is drawn ahead. Features are in the type in which autocast computes, to which every head casts them first.
    """
    shape = (horizon + 1, len(belief), belief.shape[-1] + state.shape[-1])
    features = belief.new_zeros(shape, dtype=autocast_type(belief.device.type) or belief.dtype)
    features[0].copy_(join_features(belief, state))
    actions = []
    noises = torch.randn(horizon, len(belief), actor.action_dim, device=belief.device)
    draws = zip(noises, rssm.draw_noise(horizon, len(belief)), features[:-1], features[1:], strict=True)
    for of_action, of_state, here, following in draws:
        action = actor(here).sample(of_action)
        belief = rssm.imagine_low(belief, here, action, of_state, following)
        actions.append(action)
    return Imagination(features, torch.stack(actions))


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


@torch.no_grad()
def rollout_return(
    reward: Tensor, value: Tensor, done: Tensor, terminated: Tensor, discount: Tensor, lambda_: float
) -> Tensor:
    """Compute λ-returns along rollouts of an environment that may hold several episodes, time first.

    What comes after a step at which time ran out, or after the last step, was not seen: the value of the step itself
    stands for it.

    Args:
        reward: Received on leaving each step, ``(T, N, 1)``.
        value: Of each step, ``(T, N, 1)``.
        done: Whether the episode ended there, bool ``(T, N, 1)``.
        terminated: Whether nothing follows, bool ``(T, N, 1)``.
        discount: γ, a scalar.
        lambda_: λ.

    Returns:
        Returns ``(T, N, 1)``.
    """
    following = torch.where(done, value, torch.cat((value[1:], value[-1:])))
    return lambda_return(reward, following, discount * (~terminated).float(), lambda_ * (~done).float())


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
