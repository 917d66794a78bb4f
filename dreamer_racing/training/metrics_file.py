"""Reading a run's `metrics.csv`, in whatever state the run left it.

Shapes: R rows.
"""

from __future__ import annotations

import csv
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

X_AXIS = "env_steps"


@dataclass(frozen=True)
class MetricsTable:
    """What could be read of a `metrics.csv`."""

    columns: dict[str, tuple[np.ndarray, np.ndarray]]
    """env_steps and values, (R,) each, by name; without empty, unreadable and non-finite cells, or no entry at all."""
    env_steps: np.ndarray
    """(R,) of all rows."""
    problems: list[str]
    """What was left out, one phrase each."""


def read_rows(path: Path) -> tuple[list[str], list[list[str]], list[str]]:
    """Read the complete rows; the last one may have been cut short by a kill, or is being written.

    Args:
        path: the file.

    Returns:
        The header, the rows with as many cells as it has, and what was left out, one phrase each.

    Raises:
        ValueError: this is no table of metrics.
    """
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        lines = file.readlines()
    problems = []
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
        problems.append("its last row is cut short")
    try:
        header, *rows = [cells for cells in csv.reader(lines) if cells] or [[X_AXIS]]
    except csv.Error as error:
        raise ValueError(f"{path} is not a table of metrics: {error}.") from error
    if X_AXIS not in header:
        raise ValueError(f"{path} is not a table of metrics: its first line has no column {X_AXIS}.")
    whole = [row for row in rows if len(row) == len(header)]
    if len(whole) < len(rows):
        problems.append(f"{len(rows) - len(whole)} of {len(rows)} rows are incomplete")
    return header, whole, problems


def read_metrics(path: str | Path, wanted: Collection[str] | None = None) -> MetricsTable:
    """Read columns of a `metrics.csv` as numbers, in the order of env_steps.

    Args:
        path: the file.
        wanted: names of columns; None for all. Those that the file does not have are left out.

    Raises:
        ValueError: this is no table of metrics, or it has no rows.
        OSError: the file is missing or cannot be read.
    """
    header, rows, problems = read_rows(Path(path))
    if not rows:
        raise ValueError(f"{path} has no rows: nothing was logged yet.")
    steps = _numbers([row[header.index(X_AXIS)] for row in rows])
    order = np.argsort(steps, kind="stable")[: np.isfinite(steps).sum()]  # what is not a number comes last
    if len(order) < len(rows):
        problems.append(f"{len(rows) - len(order)} of {len(rows)} rows have no number of env_steps")
    columns, unreadable = {}, 0
    for index, name in enumerate(header):
        if name == X_AXIS or (wanted is not None and name not in wanted):
            continue
        cells = [row[index] for row in rows]
        values = _numbers(cells)
        unreadable += sum(not _is_number(cells[i]) for i in np.flatnonzero(np.isnan(values)))
        kept = order[np.isfinite(values[order])]
        if len(kept):
            columns[name] = (steps[kept], values[kept])
    if unreadable:
        problems.append(f"{unreadable} cells are not numbers")
    return MetricsTable(columns, steps[order], problems)


def _numbers(cells: list[str]) -> np.ndarray:
    """Parse (R,); what is empty or not a number becomes NaN."""
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array([float(cell) if cell and _is_number(cell) else np.nan for cell in cells])


def _is_number(cell: str) -> bool:
    """Whether a cell is a number or, as it may be, empty."""
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True
