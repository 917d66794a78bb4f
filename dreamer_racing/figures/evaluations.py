"""Access to the evaluation files in a run's folder: paths, scores, and reading the first valid one."""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from dreamer_racing.evaluation.trajectory import NUMBERS
from dreamer_racing.training.directory import RunDirectory

T = TypeVar("T")

STORED = ("flight", "deterministic")  # prefixes of the files of recipes/fly.py and recipes/evaluate.py
REASON_LETTERS = 160  # maximum length of the reason why a file cannot be read


def evaluation_files(directory: Path, ending: str) -> list[Path]:
    """Find the files of a run's evaluations of the deterministic policy, by their ending.

    First those of training, sorted by env_steps, then those of `recipes/evaluate.py`: `evaluation`, `evaluation_2` ...
    """
    files = RunDirectory(directory).evaluations.glob(f"*{ending}")
    during = {int(name): file for file in files if (name := file.name.removesuffix(ending)).isdigit()}
    number = {folder: re.fullmatch(r"evaluation(?:_(\d+))?", folder.name) for folder in directory.glob("evaluation*")}
    folders = sorted((int(match[1] or 1), folder) for folder, match in number.items() if match)
    after = [RunDirectory(folder).evaluations / f"deterministic{ending}" for _, folder in folders]
    return [*(during[env_steps] for env_steps in sorted(during)), *(file for file in after if file.is_file())]


def stored_flights(folder: Path) -> list[Path]:
    """Return the files of a run's evaluation flights, the latest last; or those in a recipe's output folder."""
    if evaluated := evaluation_files(folder, NUMBERS):
        return evaluated
    places = (folder, RunDirectory(folder).evaluations)
    return [file for place in places for name in STORED if (file := place / f"{name}{NUMBERS}").is_file()]


def evaluation_score(flight: Path) -> tuple[float, float]:
    """Return the score of a flight's evaluation, (gates per episode, mean return); −∞ if it cannot be read."""
    try:
        numbers = json.loads(flight.with_name(f"{flight.name.removesuffix(NUMBERS)}.json").read_text(encoding="utf-8"))
        return float(numbers["gates_per_episode"]), float(numbers["return_mean"])
    except (OSError, ValueError, KeyError, TypeError):
        return -math.inf, -math.inf


def first_readable(files: Iterable[Path], read: Callable[[Path], T], problems: list[str]) -> tuple[Path, T] | None:
    """Read the first of a run's evaluation files that ``read`` can, without a ValueError or OSError.

    If files were skipped, ``problems`` gets a line with the run, the first of these files and the reason.

    Returns:
        The file and its content; None if no file can be read.
    """
    failures: list[tuple[Path, Exception]] = []
    found = None
    for file in files:
        try:
            found = file, read(file)
            break
        except (ValueError, OSError) as error:
            failures.append((file, error))
    if failures:
        first, failure = failures[0]
        more = len(failures) - 1
        others = f" and {more} other{'s' if more > 1 else ''}" if more else ""
        reason = textwrap.shorten(str(failure).replace(f"{first.parent}{os.sep}", ""), REASON_LETTERS).rstrip(".")
        line = f"{RunDirectory.of(first).path.name} without {first.name}{others}: {reason}"
        problems += [line] if line not in problems else []
    return found
