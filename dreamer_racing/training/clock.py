"""Where the time of a run goes."""

import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

WALL_CLOCK, CPU_CLOCK = "wall_clock", "cpu_clock"


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
