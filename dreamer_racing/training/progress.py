"""Progress display of a run: a bar and a table in a terminal, lines in a log."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TextIO, cast

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dreamer_racing.training.clock import TimeLeft
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


class Progress:
    """Shows a bar and a table in a terminal, or writes a line now and then to a log.

    Args:
        total: env_steps at the end of the run.
        env_steps: env_steps at its start, if it is resumed.
        updates: Updates at its start.
        seconds: Seconds between two lines of a log.
        shown: Whether to show anything; of several processes only rank 0 does.

    Example:
        >>> progress = Progress(total=1000)
        >>> progress.advance(500, updates=10)
        >>> progress.close()
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

    def close(self) -> None:
        """Stop updating bar and table, and leave them in the terminal."""
        if self._table is not None:
            self._table.close()
            self._table = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_line(self, numbers: str) -> None:
        now = time.monotonic()
        speed = (self._env_steps - self._from) / (now - self._since)
        done = f"{self._env_steps:,} of {self._total:,} env_steps, {speed:.0f}/s, {self._left}"
        _write(f"{done}: {numbers}", sys.stderr)
        self._since, self._from = now, self._env_steps


def _listed(numbers: Mapping[str, str]) -> str:
    return ", ".join(f"{word} {number}" for word, number in numbers.items())


def _write(text: str, stream: TextIO) -> None:
    """Write a line with the time of day, and flush it.

    A write that fails, for example on a full disk or a closed pipe, is ignored.
    """
    with contextlib.suppress(OSError):
        stream.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        stream.flush()


class LiveTable:
    """Progress bar, a table with the rows training and evaluation, and a bar during evaluations, in a terminal.

    Log messages are written above it.
    """

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
