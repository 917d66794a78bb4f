"""Clocks of a run: time by activity, time left, and when to log, evaluate and save."""

from __future__ import annotations

import os
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from dreamer_racing.settings import COUNT, NOT_NEGATIVE, setting
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.metrics import PendingMetrics

WALL_CLOCK, CPU_CLOCK = "wall_clock", "cpu_clock"
SETTLING, MEASURED, REMEMBERED = 5.0, 30.0, 600.0
"""Seconds of learning that `TimeLeft` skips, needs for an estimate, and remembers before it halves them [choice].

The first updates are slower than all others; later the load of the machine may change.
"""


class RunClock:
    """Measures shares of wall-clock time by activity and rates of counters since the last reading, and total times.

    CPU time is that of all threads of this process and of its finished child processes, so that runs can be compared
    even if they shared their cores with other work.

    Args:
        counters: Growing counters, which are only read here.
        alone: Whether this process is the whole run; otherwise its CPU time is not that of the run, and is not read.

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
        """`wall_clock` and `cpu_clock` since the run began, s, as far as known; set them to resume a run.

        A clock that is missing in the set value stays unknown. Setting also starts a new interval of `read`.
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
        """Add the time spent inside the context to that activity."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[activity] += time.perf_counter() - start

    def read(self) -> dict[str, float]:
        """Return shares `time/<activity>`, rates `rate/<counter>` in 1/s, and `total`; start the next interval."""
        elapsed = time.perf_counter() - self._since
        readings = {f"time/{activity}": seconds / elapsed for activity, seconds in self._seconds.items()}
        for name, value in self._counters.items():
            readings[f"rate/{name}"] = (value - self._start.get(name, 0)) / elapsed
        self._restart()
        return readings | self.total


def _now() -> dict[str, float]:
    return {WALL_CLOCK: time.perf_counter(), CPU_CLOCK: sum(os.times()[:4])}


class TimeLeft:
    """Estimates the remaining time of a run from at least half a minute of learning.

    The prefill of the replay is not counted, nor are evaluations during that half minute, because they would weigh too
    much. Once there is an estimate, evaluations count as they do in the rest of the run.

    ``env_steps`` and ``updates`` are those at the start of the run, ``total`` the env_steps at its end.

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
        """Whether there is an estimate."""
        return self._seconds >= MEASURED

    def advance(self, env_steps: int, updates: int) -> None:
        """Report the env_steps and updates so far."""
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
        """Report an evaluation."""
        self._disturbed = True

    def __str__(self) -> str:
        """Return hours, minutes and seconds to go, or that they are being measured."""
        if not self.measured or not self._steps:
            return "measuring how long it takes"
        remaining = max(0, self._total - self._env_steps)  # the last rollout may go past the end
        return f"{timedelta(seconds=round(remaining * self._seconds / self._steps))} to go"


@dataclass
class EvaluationConfig:
    """Evaluation during training."""

    every: int = setting(25_000, NOT_NEGATIVE)  # env_steps between evaluations; 0 turns them off
    first: int = setting(0, NOT_NEGATIVE)  # env_steps of an additional early evaluation; 0 for none
    episodes: int = setting(8, COUNT)
    stochastic: bool = False  # also evaluate the stochastic policy
    # randomisation of starts, as a multiple of that in training; 0: all episodes begin at the start pose
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    video_steps: int = setting(500, COUNT)  # control steps in the video


@dataclass
class CheckpointConfig:
    """Checkpoints during training."""

    every: int = setting(50_000, NOT_NEGATIVE)  # env_steps between checkpoints
    # minutes of wall-clock time between checkpoints, for preemptible machines; 0: by env_steps alone
    minutes: float = setting(0.0, NOT_NEGATIVE)
    keep: int = setting(2, COUNT)  # number of newest checkpoints kept

    def disk_needed(self, replay: int, directory: RunDirectory) -> str:
        """Return a line on the peak disk use of checkpoints with a replay of so many bytes, and on the free space."""
        there = sum(file.stat().st_size for file in directory.checkpoints.rglob("*") if file.is_file())
        peak, free = (self.keep + 1) * replay, shutil.disk_usage(directory.path).free + there
        line = (
            f"disk: at most {peak / 1e9:.1f} GB for the replay in checkpoint.keep={self.keep} checkpoints and the one "
            f"being written, about a seventh of that for images of races; {free / 1e9:.1f} GB free"
        )
        advice = "lower checkpoint.keep= or replay.capacity=, or choose another run_dir=; else saving may fail"
        return f"{line}: MAY NOT BE ENOUGH, {advice}" if peak > free else line


class Periods:
    """Tells when periodic actions are due, by env_steps.

    Args:
        first: env_steps at which an action is due once in addition to its periods, by its name.
        every: env_steps between two actions, by name; 0 for never.

    Attributes:
        latest: env_steps at which each action was last due; saved with the run.

    Example:
        >>> periods = Periods(log=100)
        >>> [env_steps for env_steps in (90, 110, 190, 210) if periods.due("log", env_steps)]
        [110, 210]
    """

    def __init__(self, first: Mapping[str, int] | None = None, **every: int) -> None:
        self._every, self._first = every, dict(first or {})
        self.latest = dict.fromkeys(every, 0)

    def due(self, name: str, env_steps: int, last: bool = False) -> bool:
        """Return whether an action is due, at the ``last`` env_steps of a run within a period too; count it as done."""
        period, latest, first = self._every[name], self.latest[name], self._first.get(name, 0)
        early = latest < first <= env_steps
        if not period or not (early or env_steps // period > latest // period or (last and env_steps > latest)):
            return False
        self.latest[name] = env_steps
        return True


class Interval:
    """Tells when a periodic action is due by wall-clock time; never if both arguments are 0.

    Args:
        minutes: Minutes between two actions.
        first: Minutes until the first action, if that is sooner; 0 for ``minutes``.
    """

    def __init__(self, minutes: float, first: float = 0.0) -> None:
        self._seconds = 60.0 * minutes
        self._next = 60.0 * (min(first, minutes or first) or minutes)
        self._last = time.monotonic()

    def due(self) -> bool:
        """Return whether the interval has passed; if so, start the next one."""
        if not self._next or time.monotonic() - self._last < self._next:
            return False
        self._last, self._next = time.monotonic(), self._seconds
        return True


class Journal:
    """State of periods and pending metrics as one part of a checkpoint, so that a resumed run writes the same rows."""

    def __init__(self, periods: Periods, pending: PendingMetrics) -> None:
        self.periods, self.pending = periods, pending

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"latest": dict(self.periods.latest), **self.pending.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.periods.latest |= state_dict["latest"]
        self.pending.load_state_dict(state_dict)
