"""The clocks of a run: where its time goes, how long it still takes, and when it logs, evaluates and saves."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from dreamer_racing.settings import COUNT, NOT_NEGATIVE, setting
from dreamer_racing.training.metrics import PendingMetrics

WALL_CLOCK, CPU_CLOCK = "wall_clock", "cpu_clock"
SETTLING, MEASURED, REMEMBERED = 5.0, 30.0, 600.0
"""Seconds of learning that are left out, that are measured before there is an answer, and that count [choice].

The first updates are slower than all others; after a while a machine may be busier or less so.
"""


class RunClock:
    """Shares of wall-clock time by activity, and rates of counters, since the last reading; and what the run has taken.

    CPU time is that of all threads of this process and of children that have ended, so that runs which shared their
    cores with other work can be compared by it.

    Args:
        counters: growing numbers, read and never written here.
        alone: whether this process is all of the run; else its CPU time is not the run's, and is not read.

    Example:
        >>> counters = {"updates": 0}
        >>> clock = RunClock(counters)
        >>> with clock.timed("update"):
        ...     counters["updates"] += 1
        >>> sorted(clock.read())
        ['cpu_clock', 'rate/updates', 'time/update', 'wall_clock']
    """

    def __init__(self, counters: Mapping[str, int], alone: bool = True) -> None:
        self._counters = counters
        self._born = {name: now for name, now in _now().items() if alone or name != CPU_CLOCK}
        self._restart()

    @property
    def total(self) -> dict[str, float]:
        """`wall_clock` and `cpu_clock`, s, since the run began, as far as known; settable, to go on with a run's.

        Of a run that was continued from before there was a clock, that clock stays unknown. Once set, the next reading
        is of what comes from now on, not of what was counted before.
        """
        return {name: now - self._born[name] for name, now in _now().items() if name in self._born}

    @total.setter
    def total(self, seconds: Mapping[str, float]) -> None:
        self._born = {
            name: now - seconds[name] for name, now in _now().items() if name in self._born and name in seconds
        }
        self._restart()

    def _restart(self) -> None:
        self._since = time.perf_counter()
        self._start = dict(self._counters)
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def timed(self, activity: str) -> Iterator[None]:
        """Count the time spent inside as that activity's."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[activity] += time.perf_counter() - start

    def read(self) -> dict[str, float]:
        """Shares `time/<activity>`, rates `rate/<counter>` in 1/s, and `total`; starts the next interval."""
        elapsed = time.perf_counter() - self._since
        readings = {f"time/{activity}": seconds / elapsed for activity, seconds in self._seconds.items()}
        for name, value in self._counters.items():
            readings[f"rate/{name}"] = (value - self._start.get(name, 0)) / elapsed
        self._restart()
        return readings | self.total


def _now() -> dict[str, float]:
    return {WALL_CLOCK: time.perf_counter(), CPU_CLOCK: sum(os.times()[:4])}


class TimeLeft:
    """Tells how long a run still takes, from half a minute in which it learned.

    Filling a replay is no learning, and an evaluation in that half minute would count for too much: both are left out.
    Once there is an answer, evaluations count, as they do in the rest of the run.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning.
        updates: those at the beginning.
        clock: in seconds.

    Example:
        >>> left = TimeLeft(1000, clock=iter([0.0, 1.0, 10.0, 20.0, 60.0]).__next__)
        >>> for env_steps, updates in ((100, 0), (200, 1), (300, 2)):
        ...     left.advance(env_steps, updates)
        >>> str(left)
        'measuring how long it takes'
        >>> left.advance(700, updates=10)
        >>> str(left)
        '0:00:30 to go'
    """

    def __init__(
        self, total: int, env_steps: int = 0, updates: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._total, self._clock = total, clock
        self._env_steps, self._updates, self._since = env_steps, updates, clock()
        self._learns, self._disturbed = False, False
        self._settled = 0.0  # seconds
        self._seconds, self._steps = 0.0, 0.0  # measured

    @property
    def measured(self) -> bool:
        """Whether there is an answer."""
        return self._seconds >= MEASURED

    def advance(self, env_steps: int, updates: int) -> None:
        """Take note of how far the run is, and how many updates it has made."""
        now = self._clock()
        seconds, steps = now - self._since, env_steps - self._env_steps
        if self._learns and (self.measured or not self._disturbed):
            if self._settled < SETTLING:
                self._settled += seconds
            else:
                self._seconds += seconds
                self._steps += steps
        self._learns = self._learns or updates > self._updates
        if self._seconds > REMEMBERED:
            self._seconds, self._steps = self._seconds / 2, self._steps / 2
        self._env_steps, self._since, self._disturbed = env_steps, now, False

    def disturb(self) -> None:
        """Take note of an evaluation."""
        self._disturbed = True

    def __str__(self) -> str:
        """Hours, minutes and seconds, or that they are being measured."""
        if not self.measured or not self._steps:
            return "measuring how long it takes"
        remaining = max(0, self._total - self._env_steps)  # the last rollout may go past the end
        return f"{timedelta(seconds=round(remaining * self._seconds / self._steps))} to go"


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
