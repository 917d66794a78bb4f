"""When a run logs, evaluates and saves, and what it has noted for its next row of metrics; saved with it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dreamer_racing.settings import COUNT, NOT_NEGATIVE, setting
from dreamer_racing.training.metrics import PendingMetrics


@dataclass
class EvaluationConfig:
    """Evaluation during training."""

    every: int = setting(25_000, NOT_NEGATIVE)  # env_steps; 0 never
    first: int = setting(0, NOT_NEGATIVE)  # env_steps at which there is one before that, to look at; 0 none
    episodes: int = setting(8, COUNT)
    stochastic: bool = False  # also fly the sampling policy
    # of starts, as a multiple of the noise of training; 0: all begin at the start pose
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    video_steps: int = setting(500, COUNT)  # control steps in the video


@dataclass
class CheckpointConfig:
    """Checkpoints during training."""

    every: int = setting(50_000, NOT_NEGATIVE)  # env_steps
    # of wall clock between two, for machines that are taken away; 0: by env_steps alone
    minutes: float = setting(0.0, NOT_NEGATIVE)
    keep: int = setting(2, COUNT)


class Periods:
    """Says when something that happens every so many env_steps is due.

    Args:
        first: env_steps at which a kind is due once more, before or between its periods, by its name.
        every: env_steps between two of a kind, by its name; 0: never.

    Attributes:
        latest: env_steps at the latest of each kind; saved with the run.

    Example:
        >>> periods = Periods(log=100)
        >>> [env_steps for env_steps in (90, 110, 190, 210) if periods.due("log", env_steps)]
        [110, 210]
    """

    def __init__(self, first: Mapping[str, int] | None = None, **every: int) -> None:
        self._every, self._first = every, dict(first or {})
        self.latest = dict.fromkeys(every, 0)

    def due(self, name: str, env_steps: int, last: bool = False) -> bool:
        """Whether another period has passed, or anything has since the latest; asking takes note of it.

        Args:
            name: what may be due.
            env_steps: made by now.
            last: whether the run ends here, so that no period comes to its end.
        """
        period, latest, first = self._every[name], self.latest[name], self._first.get(name, 0)
        early = latest < first <= env_steps
        if not period or not (early or env_steps // period > latest // period or (last and env_steps > latest)):
            return False
        self.latest[name] = env_steps
        return True


class Interval:
    """Says when something that happens every so many minutes of wall clock is due; never if they are 0.

    Args:
        minutes: between two times.
        first: minutes until the first time, if that is sooner; 0: as between two.
    """

    def __init__(self, minutes: float, first: float = 0.0) -> None:
        self._seconds = 60.0 * minutes
        self._next = 60.0 * (min(first, minutes or first) or minutes)
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether the interval has passed; if so it begins anew."""
        if not self._next or time.monotonic() - self._last < self._next:
            return False
        self._last, self._next = time.monotonic(), self._seconds
        return True


class Journal:
    """Periods and the metrics under way, as one part of a checkpoint: with it a resumed run writes the same rows.

    Args:
        periods: of the run.
        pending: metrics that are in no row yet.
    """

    def __init__(self, periods: Periods, pending: PendingMetrics) -> None:
        self.periods, self.pending = periods, pending

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"latest": dict(self.periods.latest), **self.pending.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.periods.latest |= state_dict["latest"]
        self.pending.load_state_dict(state_dict)
