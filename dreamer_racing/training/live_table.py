"""What a run shows in a terminal: a bar of its env_steps, and below it a table that is written over."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

COLUMNS = {
    "return": ("episode/return", "evaluation/return_mean"),
    "gates": ("episode/gates_passed", "evaluation/gates_per_episode"),
    "success": (None, "evaluation/success_rate"),
    "lap (s)": (None, "evaluation/lap_time_mean"),
    "loss": ("loss", None),
    "updates/s": ("rate/updates", None),
}
"""Metrics of training episodes and updates, and of evaluations, by the word they are shown under."""
ROWS = ("training", "evaluation")
NOTHING = "–"
EVALUATING = "  evaluating   {bar:24} {n_fmt} of {total_fmt} episodes"
TEXT: dict[str, Any] = {"total": 0, "bar_format": "{desc}"}


class LiveTable:
    """A bar, a table of two rows, training and evaluation, and how far an evaluation is while there is one.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning, of a run that is continued.
    """

    def __init__(self, total: int, env_steps: int = 0) -> None:
        self._bar = tqdm(total=total, initial=env_steps, unit="step", dynamic_ncols=True, position=0)
        self._lines = [tqdm(position=number, **TEXT) for number in (1, 2, 3)]
        self._evaluating: tqdm[Any] | None = None
        self._write("", ["env_steps", *COLUMNS], 0)
        for number, row in enumerate(ROWS, start=1):
            self._write(row, [NOTHING] * (1 + len(COLUMNS)), number)

    def advance(self, env_steps: int) -> None:
        """Take note of how far the run is; the last rollout may go past the end."""
        self._bar.total = max(self._bar.total, env_steps)
        self._bar.update(env_steps - self._bar.n)

    def show(self, metrics: Mapping[str, float], failing: str = "") -> None:
        """Show what is new in these metrics, beside the env_steps of now, and what cannot be written."""
        for number, row in enumerate(ROWS):
            names = [both[number] for both in COLUMNS.values()]
            new = [_in_words(word, metrics.get(name or "")) for word, name in zip(COLUMNS, names, strict=True)]
            if any(cell != NOTHING for cell in new):
                self._write(row, [f"{self._bar.n:,}", *new], 1 + number)
        self._end_evaluation()
        self._bar.set_postfix_str(f"NOT SAVED: {failing}" if failing else "")

    def evaluating(self, episodes: int, total: int) -> None:
        """Show how far an evaluation is."""
        if self._evaluating is None or self._evaluating.total != total:
            self._end_evaluation()
            self._evaluating = tqdm(total=total, bar_format=EVALUATING, position=4, leave=False)
        self._evaluating.update(episodes - self._evaluating.n)
        self._evaluating.refresh()

    def say(self, text: str) -> None:
        """Say something in a line above."""
        self._bar.write(text)

    def close(self) -> None:
        """Leave bar and table as they stand."""
        self._end_evaluation()
        for line in (self._bar, *self._lines):
            line.close()

    def _end_evaluation(self) -> None:
        if self._evaluating is not None:
            self._evaluating.close()
            self._evaluating = None

    def _write(self, row: str, cells: list[str], number: int) -> None:
        """Write a line of the table, no longer than the terminal is wide."""
        text = f"  {row:<11}" + "".join(f"{cell:>11}" for cell in cells)
        self._lines[number].set_description_str(text[: shutil.get_terminal_size().columns - 1])


def _in_words(word: str, value: float | None) -> str:
    if value is None:
        return NOTHING
    return f"{value:.0%}" if word == "success" else f"{value:.2f}"
