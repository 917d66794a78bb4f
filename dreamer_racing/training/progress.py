"""What a run says of itself while it goes."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Mapping
from typing import TextIO

from dreamer_racing.training.live_table import LiveTable, numbers_of
from dreamer_racing.training.signals import say_at_once
from dreamer_racing.training.time_left import TimeLeft


class Progress:
    """A bar and a table in a terminal; elsewhere, where carriage returns would pile up in a log, a line now and then.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning, of a run that is continued.
        updates: those at the beginning.
        seconds: between two lines of a log.
        shown: whether anything is; where several processes train together, one alone speaks.

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
        self._evaluated = ""  # the latest evaluation, in every line until the next
        self._since, self._from = time.monotonic(), env_steps  # of the latest line
        self._table = LiveTable(total, env_steps) if shown and sys.stderr.isatty() else None

    def advance(self, env_steps: int, updates: int) -> None:
        """Take note of how far the run is, and how many updates it has made."""
        self._env_steps = env_steps
        self._left.advance(env_steps, updates)
        if self._table is not None:
            self._table.advance(env_steps, str(self._left))

    def show(self, metrics: Mapping[str, float], unsaved: Mapping[str, int] | None = None) -> None:
        """Show the latest numbers, and what cannot be written since which env_steps."""
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
        """Show how far an evaluation is, until there are numbers to show; a log has no use for it."""
        self._left.disturb()
        if self._table is not None:
            self._table.evaluating(episodes, total)

    def say(self, text: str) -> None:
        """Say something in a line of its own."""
        if self._table is not None:
            self._table.write(text)
        elif self._shown:
            _write(text, sys.stdout)

    def answer(self, text: str) -> None:
        """Say something at once, from within a signal's handler, in a line of its own."""
        if self._table is not None:
            self._table.answer(text)
        else:
            say_at_once(text)

    def close(self) -> None:
        """Leave bar and table as they stand."""
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
    """Write a line with the time of day, at once: what follows a log sees it as it comes.

    A log that takes no more, on a full disk or where nobody reads it, is no reason to end a run.
    """
    with contextlib.suppress(OSError):
        stream.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        stream.flush()
