"""Rollouts inside the world model: where they begin, how they go, and the returns along them.

Shape legend: N starts, H horizon, F features, A action. Time comes first here, so that a step is one block of memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from dreamer_racing.modules.actor import Actor
from dreamer_racing.modules.deferred import autocast_type
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


def choose_starts(
    context: TensorDictBase, terminated: Tensor, number: int | None = None, recent: Tensor | None = None
) -> TensorDict:
    """Choose among the latents of a batch ``[B, T]`` those that imagination begins from.

    Args:
        context: ``belief``, ``state`` of its records.
        terminated: Of its records, ``(B, T, 1)``.
        number: Of random ones; None for all, in order.
        recent: Records that are chosen before others, ``(B, T, 1)``; None for none.

    Returns:
        ``belief``, ``state``, ``terminated``, batch size ``[N]``, detached.
    """
    latents = {"belief": context.get("belief"), "state": context.get("state"), "terminated": terminated}
    starts = TensorDict(latents, context.batch_size).detach().flatten()
    if number is None:
        return starts
    order = torch.rand(len(starts), device=terminated.device)
    if recent is not None:
        order = order + recent.flatten()
    # Not randperm, which a CUDA graph cannot capture.
    return starts[order.topk(min(number, len(starts))).indices]


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
