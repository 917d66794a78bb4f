"""Imagined rollouts of the policy in the world model, and the choice of their starts.

Shape legend: B batch, T time, N starts, H horizon, D belief, S state, F = D + S features, A action. Rollouts have time
first, so that a step is one block of memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dreamer_racing.modules.heads import Actor
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
    """Records from which imagination starts, without gradient.

    Attributes:
        belief: ``(N, D)``.
        state: ``(N, S)``.
        terminated: Whether the episode ended there, bool ``(N, 1)``.
        previous_action: Action that led there, ``(N, A)``.
    """

    belief: Tensor
    state: Tensor
    terminated: Tensor
    previous_action: Tensor


def choose_starts(
    belief: Tensor, state: Tensor, terminated: Tensor, previous_action: Tensor, number: int | None = None
) -> Starts:
    """Choose so many random records of a batch ``(B, T, ...)`` to start imagination from; None for all, in order."""
    starts = Starts(*(value.detach().flatten(0, 1) for value in (belief, state, terminated, previous_action)))
    if number is None:
        return starts
    # Not randperm, which a CUDA graph cannot capture.
    order = torch.rand(len(starts.belief), device=belief.device).topk(min(number, len(starts.belief))).indices
    return Starts(*(value[order] for value in starts))


def imagine(rssm: RSSM, actor: Actor, belief: Tensor, state: Tensor, horizon: int) -> Imagination:
    """Let the policy act H times in the world model, starting from beliefs ``(N, D)`` and states ``(N, S)``.

    Call it under ``torch.no_grad()`` if no gradient shall flow through the rollout, as with REINFORCE.
    """
    if rssm.few_kernels and not torch.is_grad_enabled():
        return _imagine_few_kernels(rssm, actor, belief, state, horizon)
    features, actions = [join_features(belief, state)], []
    for _ in range(horizon):
        action = actor(features[-1]).sample()
        belief, state = rssm.imagine_step(belief, state, action)
        actions.append(action)
        features.append(join_features(belief, state))
    return Imagination(torch.stack(features), torch.stack(actions))


def _imagine_few_kernels(rssm: RSSM, actor: Actor, belief: Tensor, state: Tensor, horizon: int) -> Imagination:
    """Do the same as ``imagine`` without gradient, with fewer kernels.

    Noise is drawn in advance. Features have autocast's type, to which every head would cast them anyway.
    """
    shape = (horizon + 1, len(belief), belief.shape[-1] + state.shape[-1])
    features = belief.new_zeros(shape, dtype=autocast_type(belief.device.type) or belief.dtype)
    features[0].copy_(join_features(belief, state))
    actions = []
    noises = torch.randn(horizon, len(belief), actor.action_dim, device=belief.device)
    draws = zip(noises, rssm.draw_noise(horizon, len(belief)), features[:-1], features[1:], strict=True)
    for of_action, of_state, here, following in draws:
        action = actor(here).sample(of_action)
        belief = rssm.imagine_few_kernels(belief, here, action, of_state, following)
        actions.append(action)
    return Imagination(features, torch.stack(actions))
