"""Where the wall-clock time of a run goes."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class RunClock:
    """Shares of wall-clock time by activity, and rates of counters, since the last reading.

    Args:
        counters: growing numbers, read and never written here.

    Example:
        >>> counters = {"updates": 0}
        >>> clock = RunClock(counters)
        >>> with clock.timed("update"):
        ...     counters["updates"] += 1
        >>> sorted(clock.read())
        ['rate/updates', 'time/update', 'wall_clock']
    """

    def __init__(self, counters: Mapping[str, int]) -> None:
        self._counters = counters
        self._born = time.perf_counter()
        self._restart()

    @property
    def total(self) -> float:
        """Seconds since this clock was made, and those that a continued run had taken before; settable."""
        return time.perf_counter() - self._born

    @total.setter
    def total(self, seconds: float) -> None:
        self._born = time.perf_counter() - seconds

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
        """Shares `time/<activity>`, rates `rate/<counter>` in 1/s and `wall_clock` in s; starts the next interval."""
        elapsed = time.perf_counter() - self._since
        readings = {f"time/{activity}": seconds / elapsed for activity, seconds in self._seconds.items()}
        for name, value in self._counters.items():
            readings[f"rate/{name}"] = (value - self._start.get(name, 0)) / elapsed
        self._restart()
        return {**readings, "wall_clock": self.total}
