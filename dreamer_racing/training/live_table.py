"""What a run shows in a terminal: a bar of its env_steps, and below it a table that is written over."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TextIO, cast

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from dreamer_racing.training.signals import write_at_once


class Shown(NamedTuple):
    """What is shown under a word.

    Attributes:
        training: the metric, of training episodes or of updates, if there is one.
        evaluation: that of evaluations.
        form: how its number is written.
    """

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
"""What a terminal and a log show, by the word that it is shown under."""
ROWS = ("training", "evaluation")
NOTHING = "–"
EVALUATING = "  evaluating   {bar:24} {n_fmt} of {total_fmt} episodes"
BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}, {rate_fmt}{postfix}]"
TEXT: dict[str, Any] = {"total": 0, "bar_format": "{desc}"}
CLEAR_BELOW, UP = "\r\x1b[J", "\x1b[A"  # of ECMA-48, as terminals know them


class LiveTable:
    """A bar, a table of two rows, training and evaluation, and how far an evaluation is while there is one.

    While it stands, what is logged to the terminal is written above it.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning, of a run that is continued.
    """

    def __init__(self, total: int, env_steps: int = 0) -> None:
        self._draws = False
        self._answers: list[str] = []  # that came while something was drawn
        # One update a time at least: otherwise a thread of tqdm's draws, too.
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
        """Take note of how far the run is, where the last rollout may go past the end, and what is left in words."""
        with self._drawing():
            self._bar.total = max(self._bar.total, env_steps)
            self._left = left
            self._note(refresh=False)
            self._bar.update(env_steps - self._bar.n)

    def show(self, metrics: Mapping[str, float], failing: str = "") -> None:
        """Show what is new in these metrics, beside the env_steps of now, and what cannot be written."""
        with self._drawing():
            for number, row in enumerate(ROWS, start=1):
                if new := numbers_of(row, metrics):
                    self._write(row, [f"{self._bar.n:,}", *(new.get(word, NOTHING) for word in COLUMNS)], number)
            self._end_evaluation()
            self._failing = f"NOT SAVED: {failing}" if failing else ""
            self._note()

    def evaluating(self, episodes: int, total: int) -> None:
        """Show how far an evaluation is."""
        with self._drawing():
            if self._evaluating is None or self._evaluating.total != total:
                self._end_evaluation()
                self._evaluating = tqdm(total=total, bar_format=EVALUATING, position=4, leave=False)
            self._evaluating.update(episodes - self._evaluating.n)
            self._evaluating.refresh()

    def write(self, text: str, file: TextIO | None = None) -> None:
        """Write a line above, to stdout if to nothing else."""
        with self._drawing():
            self._bar.write(text, file=file)

    def answer(self, text: str) -> None:
        """Write a line above from within a signal's handler: at once, or after what is being drawn."""
        if self._draws:
            self._answers.append(text)
            return
        lines = [self._bar, *self._lines, *([self._evaluating] if self._evaluating is not None else [])]
        drawn = "\n".join(map(str, lines))
        write_at_once(f"{CLEAR_BELOW}{text}\n{drawn}\r{UP * (len(lines) - 1)}")

    def close(self) -> None:
        """Leave bar and table as they stand."""
        with self._drawing():
            self._logging.__exit__(None, None, None)
            self._end_evaluation()
        for line in (self._bar, *self._lines):
            line.close()

    @contextlib.contextmanager
    def _drawing(self) -> Iterator[None]:
        """Stands around whatever moves the cursor; in between it is in the line of the bar."""
        self._draws = True
        try:
            yield
        finally:
            self._draws = False
            while self._answers:
                self.answer(self._answers.pop())

    def _note(self, refresh: bool = True) -> None:
        """Write beside the bar how long the run still takes, and what cannot be written."""
        self._bar.set_postfix_str(", ".join(filter(None, (self._left, self._failing))), refresh)

    def _end_evaluation(self) -> None:
        if self._evaluating is not None:
            self._evaluating.close()
            self._evaluating = None

    def _write(self, row: str, cells: list[str], number: int) -> None:
        """Write a line of the table, no longer than the terminal is wide."""
        text = f"  {row:<11}" + "".join(f"{cell:>11}" for cell in cells)
        self._lines[number].set_description_str(text[: shutil.get_terminal_size().columns - 1])


def numbers_of(row: str, metrics: Mapping[str, float]) -> dict[str, str]:
    """Return what these metrics have for a row, one of `ROWS`, as it is shown, by its words."""
    names = {word: getattr(shown, row) for word, shown in COLUMNS.items()}
    return {word: f"{metrics[name]:{COLUMNS[word].form}}" for word, name in names.items() if name in metrics}
