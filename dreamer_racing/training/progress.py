"""What a run says of itself while it goes."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from typing import TextIO

from dreamer_racing.training.live_table import LiveTable

SHOWN = {"return": "episode/return", "gates": "episode/gates_passed", "loss": "loss", "updates/s": "rate/updates"}
"""Metrics of a line, by the word they are shown under."""
KEPT = {"success": "evaluation/success_rate"}
"""Those that are shown until there are newer ones."""


class Progress:
    """A bar and a table in a terminal; elsewhere, where carriage returns would pile up in a log, a line now and then.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning, of a run that is continued.
        seconds: between two lines of a log.
        shown: whether anything is; where several processes train together, one alone speaks.

    Example:
        >>> progress = Progress(total=1000)
        >>> progress.advance(500)
        >>> progress.close()
    """

    def __init__(self, total: int, env_steps: int = 0, seconds: float = 30.0, shown: bool = True) -> None:
        self._total, self._seconds, self._shown = total, seconds, shown
        self._env_steps = env_steps
        self._kept: dict[str, str] = {}
        self._since, self._from = time.monotonic(), env_steps  # of the latest line
        self._table = LiveTable(total, env_steps) if shown and sys.stderr.isatty() else None

    def advance(self, env_steps: int) -> None:
        """Take note of how far the run is."""
        self._env_steps = env_steps
        if self._table is not None:
            self._table.advance(env_steps)

    def show(self, metrics: Mapping[str, float], unsaved: Mapping[str, int] | None = None) -> None:
        """Show the latest numbers, and what cannot be written since which env_steps."""
        failing = "; ".join(f"{what} since {env_steps:,}" for what, env_steps in (unsaved or {}).items())
        if self._table is not None:
            self._table.show(metrics, failing)
            return
        self._kept |= {word: f"{metrics[name]:.0%}" for word, name in KEPT.items() if name in metrics}
        numbers = {word: f"{metrics[name]:.2f}" for word, name in SHOWN.items() if name in metrics}
        if self._shown and time.monotonic() - self._since >= self._seconds:
            numbers = ({"NOT SAVED": failing} if failing else {}) | numbers | self._kept
            self._write_line(", ".join(f"{word} {number}" for word, number in numbers.items()))

    def evaluating(self, episodes: int, total: int) -> None:
        """Show how far an evaluation is, until there are numbers to show; a log has no use for it."""
        if self._table is not None:
            self._table.evaluating(episodes, total)

    def say(self, text: str) -> None:
        """Say something in a line of its own."""
        if self._table is not None:
            self._table.say(text)
        elif self._shown:
            _write(text, sys.stdout)

    def close(self) -> None:
        """Leave bar and table as they stand."""
        if self._table is not None:
            self._table.close()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_line(self, numbers: str) -> None:
        now = time.monotonic()
        speed = (self._env_steps - self._from) / (now - self._since)
        remaining = max(0, self._total - self._env_steps)  # the last rollout may go past the end
        left = timedelta(seconds=round(remaining / speed)) if speed else "unknown time"
        done = f"{self._env_steps:,} of {self._total:,} env_steps, {speed:.0f}/s, {left} to go"
        _write(f"{done}: {numbers}", sys.stderr)
        self._since, self._from = now, self._env_steps


def _write(text: str, stream: TextIO) -> None:
    """Write a line with the time of day, at once: what follows a log sees it as it comes.

    A log that takes no more, on a full disk or where nobody reads it, is no reason to end a run.
    """
    with contextlib.suppress(OSError):
        stream.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        stream.flush()
