"""Metrics of a world model on held-out records, and of imagined returns against real ones.

Shapes: W windows of T records, C context records, H horizon, F features.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing import parallel
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import imagine
from dreamer_racing.modules.rssm import join_features
from dreamer_racing.training.schedule import ModelLag
from dreamer_racing.training.session import Session

SEEN = 16
"""Context records that the model observes before it predicts."""
WINDOWS, RECORDS = 32, 2_000
"""Held-out windows per measurement, and the newest records of a world that they are drawn from."""


def measure(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, scheduled: Mapping[str, float]
) -> dict[str, Tensor | float]:
    """Return a run's current hyperparameters, and `held_out_metrics` on the newest held-out records."""
    numbers: dict[str, Any] = {f"schedule/{name}": value for name, value in scheduled.items()}
    numbers |= {f"learning_rate/{name}": rate for name, rate in learner.learning_rates.items()}
    windows = replay.held_out(WINDOWS, SEEN + learner.config.imagination_horizon, RECORDS)
    if windows is None or not session.counters["updates"]:
        return numbers
    with session.timed("measure"):
        return numbers | held_out_metrics(learner, windows)


def measure_lag(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, lag: ModelLag, length: int
) -> dict[str, Tensor | float]:
    """Measure the world model's error on the newest ``length`` records of each world, before it trains on them."""
    if (windows := replay.newest(length)) is None:
        return {}
    with session.timed("measure"):
        return lag.add_fresh_error(parallel.averaged(world_model_metrics(learner, windows)))


@torch.no_grad()
def world_model_metrics(learner: WorldModelLearner, batch: TensorDictBase) -> dict[str, Tensor]:
    """Compute losses and metrics of the world-model loss without changing networks or random state.

    The batch ``[W, T]`` has the format of ``WorldModelLearner.update``; results are scalars on the learner's device.
    """
    with _preserved_random_state(learner):
        losses, _ = learner.world_model_loss(batch.to(learner.device))
    return losses


@torch.no_grad()
def held_out_metrics(learner: WorldModelLearner, batch: TensorDictBase) -> dict[str, Tensor]:
    """Measure the world model and imagination on held-out records.

    The random state is restored, so that measuring does not change a run.

    Args:
        learner: The learner; its networks are not changed.
        batch: Records ``[W, T]`` in the format of ``WorldModelLearner.update``, T ≥ ``SEEN`` + horizon.

    Returns:
        Scalars on the learner's device.

        - ``held_out/<name>``: losses and metrics of the world-model loss, for example ``held_out/image_error`` and
            ``held_out/reward_error``;
        - ``held_out/open_loop_reward_error``: mean absolute error of the reward sum over the horizon, predicted from
            the context and the actions taken;
        - ``held_out/open_loop_correlation``: correlation of those sums with the real ones;
        - ``imagination/return_correlation`` and ``imagination/return_bias`` (imagined minus real): imagined returns of
            the current policy against real ones, both over the horizon plus the discounted value after it. Use the
            newest records, whose policy is nearly the current one. Windows that begin at an episode's last record or
            contain a timeout are left out. Missing for learners without imagination.

    Raises:
        ValueError: If the windows are too short.
    """
    horizon = learner.config.imagination_horizon  # constant over a run, even if the horizon is scheduled
    if batch.shape[1] < SEEN + horizon:
        raise ValueError(f"Windows of {batch.shape[1]} records: {SEEN} + horizon {horizon} are needed.")
    with _preserved_random_state(learner):
        return _measure(learner, batch.to(learner.device)[:, : SEEN + horizon], horizon)


@contextmanager
def _preserved_random_state(learner: WorldModelLearner) -> Iterator[None]:
    """Enter the autocast of updates, and restore the random state on exit."""
    devices = [learner.device] if learner.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices), learner.autocast():
        yield


def _measure(learner: WorldModelLearner, batch: TensorDictBase, horizon: int) -> dict[str, Tensor]:
    model, critic = learner.agent.world_model, learner.agent.critic
    losses, (belief, state) = learner.world_model_loss(batch)  # (W, T, ·)
    metrics = {f"held_out/{name}": value for name, value in losses.items()}
    start = (belief[:, SEEN - 1], state[:, SEEN - 1])
    alive = (~batch["is_init"].squeeze(-1)[:, SEEN:]).cumprod(1).float()  # (W, H) same episode as the start
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
    # A crash inside the horizon is comparable; a timeout is not, because the real return after it is unknown.
    cut_off = (batch["truncated"].squeeze(-1)[:, SEEN:] & alive.bool()).any(1)
    comparable = goes_on_at_first & ~cut_off
    if comparable.any():
        imagined, real = imagined[comparable], real[comparable]
        metrics["imagination/return_correlation"] = correlation(imagined, real)
        metrics["imagination/return_bias"] = (imagined - real).mean()
    return metrics


def _imagined_return(learner: DreamerV3, start: tuple[Tensor, Tensor], horizon: int, discount: Tensor) -> Tensor:
    """Imagine with the policy; return the discounted rewards plus the value after the horizon, ``(W,)``."""
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
    """Return the correlation of two vectors ``(W,)``, a scalar; 0 if one is constant."""
    first, second = first - first.mean(), second - second.mean()
    return (first * second).sum() / (first.norm() * second.norm()).clamp_min(1e-8)
