"""What a run with a world model measures of it beside its updates."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from composing.schema import WorldModelRunConfig
from dreamer_racing import parallel
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics, world_model_metrics
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.training.model_lag import ModelLag
from dreamer_racing.training.session import Session

WINDOWS, RECORDS = 32, 2_000
"""Windows of records held out that are measured at a time, from the newest records of a world."""


def measure(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, scheduled: Mapping[str, float]
) -> dict[str, Tensor | float]:
    """Return hyperparameters as they are now, and what the model makes of the newest records not trained on."""
    groups = zip(("world_model", "behavior"), learner.optimizer.param_groups, strict=True)
    numbers: dict[str, Any] = {f"schedule/{name}": value for name, value in scheduled.items()}
    numbers |= {f"learning_rate/{name}": group["lr"] for name, group in groups}
    windows = replay.held_out(WINDOWS, SEEN + learner.config.imagination_horizon, RECORDS)
    if windows is None or not session.counters["updates"]:
        return numbers
    with session.undisturbed():
        return numbers | held_out_metrics(learner, windows)


def measure_lag(
    session: Session, config: WorldModelRunConfig, learner: WorldModelLearner, replay: StreamReplay, lag: ModelLag
) -> dict[str, Tensor | float]:
    """Measure whether the model knows the records of the newest flights, before they are learned from."""
    length = config.model.batch_length
    if config.replay.context:  # begins warm: the newest rollout alone
        length = min(length, config.rollout_steps)
    if (windows := replay.newest(length)) is None:
        return {}
    with session.undisturbed():
        return lag.measured(parallel.averaged(world_model_metrics(learner, windows)))
