"""Where the time of a run goes."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class RunClock:
    """Shares of wall-clock time by activity, and rates of counters, since the last reading; and what the run has taken.

    CPU time is that of all threads of this process, so that runs which shared their cores with other work can be
    compared by it.

    Args:
        counters: growing numbers, read and never written here.

    Example:
        >>> counters = {"updates": 0}
        >>> clock = RunClock(counters)
        >>> with clock.timed("update"):
        ...     counters["updates"] += 1
        >>> sorted(clock.read())
        ['cpu_clock', 'rate/updates', 'time/update', 'wall_clock']
    """

    def __init__(self, counters: Mapping[str, int]) -> None:
        self._counters = counters
        self._born = _now()
        self._restart()

    @property
    def total(self) -> dict[str, float]:
        """`wall_clock` and `cpu_clock`, s, since the run began; settable, to go on where a continued run was."""
        return {name: now - self._born[name] for name, now in _now().items()}

    @total.setter
    def total(self, seconds: Mapping[str, float]) -> None:
        self._born = {name: now - seconds.get(name, 0.0) for name, now in _now().items()}

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
    return {"wall_clock": time.perf_counter(), "cpu_clock": time.process_time()}
