"""What evaluations have left in a run's folder: which files, how good each was, and the first that can be read."""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from dreamer_racing.training.directory import RunDirectory

T = TypeVar("T")

REASON_LETTERS = 160  # of why a file cannot be read


def evaluation_files(directory: Path, ending: str) -> list[Path]:
    """Find what the evaluations of a run have left, during training and, by `recipes/evaluate.py`, after it.

    Args:
        directory: of the run.
        ending: of the files' names, after the env_steps or the policy's name.

    Returns:
        The files: during training by env_steps, rising, then those of `evaluation`, `evaluation_2` ...; those of
        stochastic policies are left out.
    """
    files = RunDirectory(directory).evaluations.glob(f"*{ending}")
    during = {int(name): file for file in files if (name := file.name.removesuffix(ending)).isdigit()}
    number = {folder: re.fullmatch(r"evaluation(?:_(\d+))?", folder.name) for folder in directory.glob("evaluation*")}
    folders = sorted((int(match[1] or 1), folder) for folder, match in number.items() if match)
    after = [RunDirectory(folder).evaluations / f"deterministic{ending}" for _, folder in folders]
    return [*(during[env_steps] for env_steps in sorted(during)), *(file for file in after if file.is_file())]


def evaluation_score(file: Path, ending: str) -> tuple[float, float]:
    """Say how good the evaluation was that left a file: gates per episode, then the return; the worst if unknown."""
    try:
        numbers = json.loads(file.with_name(f"{file.name.removesuffix(ending)}.json").read_text(encoding="utf-8"))
        return float(numbers["gates_per_episode"]), float(numbers["return_mean"])
    except (OSError, ValueError, KeyError, TypeError):
        return -math.inf, -math.inf


def first_readable(files: Iterable[Path], read: Callable[[Path], T], problems: list[str]) -> tuple[Path, T] | None:
    """Read the first of some files of a run's evaluations that can be read.

    Args:
        files: which, in the order of preference.
        read: raises ValueError or OSError at what it cannot read.
        problems: gets a line if files were passed over, with the run, the first of them and why.

    Returns:
        The file and what is in it; None if none of them can be read.
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
