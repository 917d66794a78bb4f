"""Progress of a run: its clocks, when something is due, the time left, and what a terminal or a log shows of it."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from typing import Any, NamedTuple, TextIO, cast

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dreamer_racing.training.metrics import CPU_CLOCK, WALL_CLOCK
from dreamer_racing.training.signals import say_at_once, write_at_once


class Shown(NamedTuple):
    """Metrics of a column, of training and of evaluations, and the format of their numbers."""

    training: str | None
    evaluation: str | None
    form: str = ".2f"


COLUMNS = {
    "return": Shown("episode/return", "evaluation/return_mean"),
    "gates": Shown("episode/gates_passed", "evaluation/gates_per_episode"),
    "success": Shown(None, "evaluation/success_rate", ".0%"),
    "lap (s)": Shown(None, "evaluation/lap_time_mean"),
    "loss": Shown("loss", None),
    "updates/s": Shown("rate/updates", None),
}
"""Columns of the terminal's table and of log lines, by their titles."""
ROWS = ("training", "evaluation")
NOTHING = "–"
EVALUATING = "  evaluating   {bar:24} {n_fmt} of {total_fmt} episodes"
BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}, {rate_fmt}{postfix}]"
TEXT: dict[str, Any] = {"total": 0, "bar_format": "{desc}"}
CLEAR_BELOW, UP = "\r\x1b[J", "\x1b[A"  # ECMA-48 control sequences
SETTLING, MEASURED, REMEMBERED = 5.0, 30.0, 600.0
"""Seconds of learning that `TimeLeft` skips, needs for an estimate, and remembers before it halves them [choice].

The first updates are slower than all others; later the load of the machine may change.
"""


class RunClock:
    """Measures shares of wall-clock time by activity and rates of counters since the last reading, and total times.

    CPU time is that of all threads of this process and of its finished child processes: runs can be compared even if
    they shared their cores with other work. Unless this process is the whole run (``alone``), it is not read. The
    ``counters`` are only read here.

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
        now = _now()
        return {name: now[name] - born for name, born in self._born.items()}

    @total.setter
    def total(self, seconds: Mapping[str, float]) -> None:
        now = _now()
        self._born = {name: now[name] - seconds[name] for name in self._born if name in seconds}
        self._restart()

    def _restart(self) -> None:
        self._since = time.perf_counter()
        self._start = dict(self._counters)
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextlib.contextmanager
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


class Periods:
    """Tells when actions are due, by env_steps: ``every`` so many by name, 0 for never, and once more at ``first``.

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
    """Tells when an action is due: every so many ``minutes``, and sooner once after the ``first``; 0 for never."""

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


class TimeLeft:
    """Estimates the remaining time of a run of ``total`` env_steps from at least half a minute of learning.

    The prefill of the replay is not counted, nor are evaluations during that half minute, because they would weigh too
    much. Once there is an estimate, evaluations count as they do in the rest of the run.

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

    def advance(self, env_steps: int, updates: int) -> None:
        """Report the env_steps and updates so far."""
        now = self._clock()
        seconds, steps = now - self._since, env_steps - self._env_steps
        if self._learns and (self._seconds >= MEASURED or not self._disturbed):
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
        if self._seconds < MEASURED or not self._steps:
            return "measuring how long it takes"
        remaining = max(0, self._total - self._env_steps)  # the last rollout may go past the end
        return f"{timedelta(seconds=round(remaining * self._seconds / self._steps))} to go"


class Progress:
    """Shows a bar and a table in a terminal, or writes a line now and then to a log.

    Args:
        total: env_steps at the end of the run.
        env_steps: env_steps at its start, and ``updates``.
        seconds: Seconds between two lines of a log.
        shown: Whether to show anything; of several processes only rank 0 does.

    Example:
        >>> with Progress(total=1000) as progress:
        ...     progress.advance(500, updates=10)
    """

    def __init__(
        self, total: int, env_steps: int = 0, updates: int = 0, seconds: float = 30.0, shown: bool = True
    ) -> None:
        self._total, self._seconds, self._shown = total, seconds, shown
        self._env_steps = env_steps
        self._left = TimeLeft(total, env_steps, updates)
        self._evaluated = ""  # text of the latest evaluation, repeated in every line until the next
        self._since, self._from = time.monotonic(), env_steps  # time and env_steps of the latest line
        self._table = LiveTable(total, env_steps) if shown and sys.stderr.isatty() else None

    def advance(self, env_steps: int, updates: int) -> None:
        """Report the env_steps and updates so far."""
        self._env_steps = env_steps
        self._left.advance(env_steps, updates)
        if self._table is not None:
            self._table.advance(env_steps, str(self._left))

    def show(self, metrics: Mapping[str, float], unsaved: Mapping[str, int] | None = None) -> None:
        """Show the latest metrics, and the env_steps since which named writes fail."""
        failing = "; ".join(f"{what} since {env_steps:,}" for what, env_steps in (unsaved or {}).items())
        if self._table is not None:
            self._table.show(metrics, failing)
            return
        if evaluated := _listed(numbers_of("evaluation", metrics)):
            self._evaluated = f"evaluation: {evaluated}"
        if self._shown and time.monotonic() - self._since >= self._seconds:
            trained = _listed(numbers_of("training", metrics))
            parts = (f"NOT SAVED {failing}" if failing else "", trained, self._evaluated)
            self._write_line("; ".join(part for part in parts if part))

    def evaluating(self, episodes: int, total: int) -> None:
        """Show the progress of an evaluation in a terminal."""
        self._left.disturb()
        if self._table is not None:
            self._table.evaluating(episodes, total)

    def write_line(self, text: str) -> None:
        """Write a message on its own line."""
        if self._table is not None:
            self._table.write(text)
        elif self._shown:
            _write(text, sys.stdout)

    def write_from_handler(self, text: str) -> None:
        """Write a message on its own line from within a signal handler."""
        if self._table is not None:
            self._table.write_from_handler(text)
        else:
            say_at_once(text)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        """Stop updating bar and table, and leave them in the terminal."""
        if self._table is not None:
            self._table.close()
            self._table = None

    def _write_line(self, numbers: str) -> None:
        now = time.monotonic()
        speed = (self._env_steps - self._from) / (now - self._since)
        done = f"{self._env_steps:,} of {self._total:,} env_steps, {speed:.0f}/s, {self._left}"
        _write(f"{done}: {numbers}", sys.stderr)
        self._since, self._from = now, self._env_steps


def _listed(numbers: Mapping[str, str]) -> str:
    return ", ".join(f"{word} {number}" for word, number in numbers.items())


def _write(text: str, stream: TextIO) -> None:
    """Write a line with the time of day, and flush it."""
    with contextlib.suppress(OSError):  # a full disk or a closed pipe
        stream.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        stream.flush()


class LiveTable:
    """Progress bar, table and a bar during evaluations, in a terminal; log messages are written above them."""

    def __init__(self, total: int, env_steps: int = 0) -> None:
        self._draws = False
        self._answers: list[str] = []  # answers that arrived during drawing
        # With miniters=1, tqdm's monitor thread does not draw as well.
        self._bar = tqdm(total=total, initial=env_steps, unit="step", dynamic_ncols=True, position=0, miniters=1,
                         bar_format=BAR)  # fmt: skip
        self._left, self._failing = "", ""
        self._lines = [tqdm(position=number, **TEXT) for number in (1, 2, 3)]
        self._evaluating: tqdm[Any] | None = None
        self._write("", ["env_steps", *COLUMNS], 0)
        for number, row in enumerate(ROWS, start=1):
            self._write(row, [NOTHING] * (1 + len(COLUMNS)), number)
        self._logging = logging_redirect_tqdm(tqdm_class=cast(Any, self))  # it calls `write`
        self._logging.__enter__()

    def advance(self, env_steps: int, left: str) -> None:
        """Show env_steps, which may exceed the total after the last rollout, and the time left as text."""
        with self._drawing():
            self._bar.total = max(self._bar.total, env_steps)
            self._left = left
            self._note(refresh=False)
            self._bar.update(env_steps - self._bar.n)

    def show(self, metrics: Mapping[str, float], failing: str = "") -> None:
        """Update the rows that have new metrics, with the current env_steps, and show which writes fail."""
        with self._drawing():
            for number, row in enumerate(ROWS, start=1):
                if new := numbers_of(row, metrics):
                    self._write(row, [f"{self._bar.n:,}", *(new.get(word, NOTHING) for word in COLUMNS)], number)
            self._end_evaluation()
            self._failing = f"NOT SAVED: {failing}" if failing else ""
            self._note()

    def evaluating(self, episodes: int, total: int) -> None:
        """Show the progress of an evaluation."""
        with self._drawing():
            if self._evaluating is None or self._evaluating.total != total:
                self._end_evaluation()
                self._evaluating = tqdm(total=total, bar_format=EVALUATING, position=4, leave=False)
            self._evaluating.update(episodes - self._evaluating.n)
            self._evaluating.refresh()

    def write(self, text: str, file: TextIO | None = None) -> None:
        """Write a line above the bar, to stdout by default."""
        with self._drawing():
            self._bar.write(text, file=file)

    def write_from_handler(self, text: str) -> None:
        """Write a line above the bar from within a signal handler; during drawing, write it afterwards."""
        if self._draws:
            self._answers.append(text)
            return
        lines = [self._bar, *self._lines, *([self._evaluating] if self._evaluating is not None else [])]
        drawn = "\n".join(map(str, lines))
        write_at_once(f"{CLEAR_BELOW}{text}\n{drawn}\r{UP * (len(lines) - 1)}")

    def close(self) -> None:
        """Stop updating bar and table, and leave them in the terminal."""
        with self._drawing():
            self._logging.__exit__(None, None, None)
            self._end_evaluation()
        for line in (self._bar, *self._lines):
            line.close()

    @contextlib.contextmanager
    def _drawing(self) -> Iterator[None]:
        """Context of everything that moves the cursor, which otherwise stays in the line of the bar."""
        self._draws = True
        try:
            yield
        finally:
            self._draws = False
            while self._answers:
                self.write_from_handler(self._answers.pop())

    def _note(self, refresh: bool = True) -> None:
        """Show the time left and the failing writes beside the bar."""
        self._bar.set_postfix_str(", ".join(filter(None, (self._left, self._failing))), refresh)

    def _end_evaluation(self) -> None:
        if self._evaluating is not None:
            self._evaluating.close()
            self._evaluating = None

    def _write(self, row: str, cells: list[str], number: int) -> None:
        """Write a line of the table, cut to the width of the terminal."""
        text = f"  {row:<11}" + "".join(f"{cell:>11}" for cell in cells)
        self._lines[number].set_description_str(text[: shutil.get_terminal_size().columns - 1])


def numbers_of(row: str, metrics: Mapping[str, float]) -> dict[str, str]:
    """Return the formatted numbers of a row (one of `ROWS`) that these metrics contain, by column."""
    names = {word: getattr(shown, row) for word, shown in COLUMNS.items()}
    return {word: f"{metrics[name]:{COLUMNS[word].form}}" for word, name in names.items() if name in metrics}
