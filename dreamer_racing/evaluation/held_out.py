"""How good the world model is where it was not trained, and whether its dreams pay what the world pays.

Shapes: W windows of T records, C context records, H horizon, F features.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import imagine
from dreamer_racing.modules.rssm import join_features

SEEN = 16
"""Records that the model sees before it has to predict."""


@torch.no_grad()
def world_model_metrics(learner: WorldModelLearner, batch: TensorDictBase) -> dict[str, Tensor]:
    """Measure the world model on records as an update would, and change nothing: neither networks nor random state.

    Args:
        learner: Whose world model is measured.
        batch: Records ``[W, T]`` as ``WorldModelLearner.update`` takes them.

    Returns:
        Losses and metrics of the world-model loss, scalars on the learner's device.
    """
    with _untouched(learner):
        losses, _ = learner.world_model_loss(batch.to(learner.device))
    return losses


@torch.no_grad()
def held_out_metrics(learner: WorldModelLearner, batch: TensorDictBase) -> dict[str, Tensor]:
    """Measure world model and imagination on records that were never trained on.

    The random state is left as it was, so that measuring does not change a run.

    Args:
        learner: Whose networks are measured; they are not changed.
        batch: Records ``[W, T]`` as ``WorldModelLearner.update`` takes them, T ≥ ``SEEN`` + horizon.

    Returns:
        Scalars on the learner's device.

        - ``held_out/<name>``: losses and metrics of the world-model loss, for example ``held_out/image_error`` and
            ``held_out/reward_error``;
        - ``held_out/open_loop_reward_error``: mean absolute error of the reward sum over the horizon, predicted from
            the context and the actions taken;
        - ``held_out/open_loop_correlation``: of those sums with the real ones;
        - ``imagination/return_correlation`` and ``imagination/return_bias`` (imagined minus real): the return over the
            horizon plus the discounted value after it, imagined by the present policy, against the one that the world
            paid. The actions of newest records are those of nearly the same policy. Windows that begin at an episode's
            last record, or in which time ran out, are left out. Not measured where updates do not imagine.

    Raises:
        ValueError: If the windows are too short.
    """
    horizon = learner.config.imagination_horizon  # the same over a run, whatever is scheduled
    if batch.shape[1] < SEEN + horizon:
        raise ValueError(f"Windows of {batch.shape[1]} records: {SEEN} + horizon {horizon} are needed.")
    with _untouched(learner):
        return _measure(learner, batch.to(learner.device)[:, : SEEN + horizon], horizon)


@contextmanager
def _untouched(learner: WorldModelLearner) -> Iterator[None]:
    """Run the learner's networks as updates do, and leave the random state as it was."""
    devices = [learner.device] if learner.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices), learner.autocast():
        yield


def _measure(learner: WorldModelLearner, batch: TensorDictBase, horizon: int) -> dict[str, Tensor]:
    model, critic = learner.agent.world_model, learner.agent.critic
    losses, (belief, state) = learner.world_model_loss(batch)  # (W, T, ·)
    metrics = {f"held_out/{name}": value for name, value in losses.items()}
    start = (belief[:, SEEN - 1], state[:, SEEN - 1])
    alive = (~batch["is_init"].squeeze(-1)[:, SEEN:]).cumprod(1).float()  # (W, H) of the start's episode
    alive = alive * (1 - batch["terminated"].squeeze(-1)[:, SEEN - 1 : SEEN].float())
    reward = batch["reward"].squeeze(-1)[:, SEEN:] * alive

    open_loop = join_features(*model.predict(*start, batch["previous_action"][:, SEEN:]))  # (W, H, F)
    predicted = (model.reward_head.mean(open_loop).squeeze(-1) * alive).sum(1)
    goes_on_at_first = ~(batch["terminated"] | batch["truncated"])[:, SEEN - 1, 0]  # (W,)
    if goes_on_at_first.any():
        predicted, paid = predicted[goes_on_at_first], reward.sum(1)[goes_on_at_first]
        metrics["held_out/open_loop_reward_error"] = (predicted - paid).abs().mean()
        metrics["held_out/open_loop_correlation"] = correlation(predicted, paid)

    if not isinstance(learner, DreamerV3):
        return metrics
    discount = float(learner.discount) ** torch.arange(horizon + 1, device=reward.device)
    value = critic.value(join_features(belief[:, -1], state[:, -1])).squeeze(-1)
    goes_on = alive[:, -1] * (1 - batch["terminated"].squeeze(-1)[:, -1].float())
    real = (reward * discount[:-1]).sum(1) + discount[-1] * goes_on * value
    imagined = _imagined_return(learner, start, horizon, discount)
    comparable = _comparable(batch, alive, goes_on_at_first)
    if comparable.any():
        imagined, real = imagined[comparable], real[comparable]
        metrics["imagination/return_correlation"] = correlation(imagined, real)
        metrics["imagination/return_bias"] = (imagined - real).mean()
    return metrics


def _comparable(batch: TensorDictBase, alive: Tensor, goes_on_at_first: Tensor) -> Tensor:
    """Which windows ``(W,)`` an imagined return can be held against: not begun or cut off where an episode ended.

    A crash inside the horizon stays; a time limit there hides what the world would have paid.
    """
    cut_off = (batch["truncated"].squeeze(-1)[:, SEEN:] & alive.bool()).any(1)
    return goes_on_at_first & ~cut_off


def _imagined_return(learner: DreamerV3, start: tuple[Tensor, Tensor], horizon: int, discount: Tensor) -> Tensor:
    """Let the policy act in the model; return discounted rewards plus the value after them, ``(W,)``."""
    model = learner.agent.world_model
    features = imagine(model.rssm, learner.agent.actor, *start, horizon).features[1:]  # (H, W, F)
    continuation = model.continue_head.probability(features).squeeze(-1)  # (H, W)
    if not learner.loss_config.continuation:
        continuation = torch.ones_like(continuation)
    reached = torch.cat((torch.ones_like(continuation[:1]), continuation[:-1])).cumprod(0)
    reward = model.reward_head.mean(features).squeeze(-1) * reached
    value = learner.agent.critic.value(features[-1]).squeeze(-1) * reached[-1] * continuation[-1]
    return (discount[:-1, None] * reward).sum(0) + discount[-1] * value


def correlation(first: Tensor, second: Tensor) -> Tensor:
    """Return the correlation of two vectors ``(W,)``, a scalar; 0 where one does not vary."""
    first, second = first - first.mean(), second - second.mean()
    return (first * second).sum() / (first.norm() * second.norm()).clamp_min(1e-8)
