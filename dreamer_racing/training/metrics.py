"""Metrics of a run: a CSV file over ``env_steps``, and further loggers."""

from __future__ import annotations

import csv
import io
import itertools
import logging
import math
import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from dreamer_racing.settings import quoted
from dreamer_racing.training.directory import RunDirectory, replace_text

logger = logging.getLogger(__name__)
X_AXIS, WALL_CLOCK, CPU_CLOCK = "env_steps", "wall_clock", "cpu_clock"
MOST_DIGITS = 19
"""Maximum number of digits of env_steps; a longer number is damaged, and Python's int() reads only some thousands."""


class MetricsLog:
    """Averages the metrics pushed since the last write, and writes them to ``metrics.csv`` and to loggers.

    The file has one row per write, and ``env_steps`` as its first column; a metric that appears later gets a new column
    at the end, empty in earlier rows. If the process is killed, at most the row being written is lost. Rows that cannot
    be written to a full disk wait for the next write.

    Args:
        run_dir: Folder of the run.
        loggers: TorchRL loggers that also receive every row (`dreamer_racing.figures.loggers` makes some).
        resume_env_steps: env_steps of the last row that a resumed run keeps: later rows are removed. If None, the run
            is new, and an existing ``metrics.csv`` is kept under another name.
        pending: Metrics that are not yet written, to be saved with the run.

    Example:
        >>> metrics = MetricsLog("runs/example")  # doctest: +SKIP
        >>> metrics.push({"loss/actor": torch.tensor(1.0)})  # doctest: +SKIP
        >>> metrics.write(env_steps=1024)  # doctest: +SKIP
    """

    def __init__(
        self,
        run_dir: str | Path,
        loggers: Sequence[Logger] = (),
        resume_env_steps: int | None = None,
        pending: Journal | None = None,
    ) -> None:
        run_dir = Path(run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        self.path = RunDirectory(run_dir).metrics
        self.loggers = list(loggers)
        self._pending = pending or Journal()
        self._columns = [X_AXIS]
        if resume_env_steps is None:
            _keep_aside(self.path)
            self._rewrite([], [])
        else:
            self._truncate(resume_env_steps)

    def push(self, metrics: Mapping[str, Tensor | float], count: int = 1) -> None:
        """Add values by name, each the mean of ``count``, to the averages; tensors stay on their device, so none waits.

        A tensor with several elements is averaged.
        """
        self._pending.averages.push(metrics, count)

    def write(self, env_steps: int) -> dict[str, float]:
        """Make a row of the averages and write it: `close_row` and `flush`."""
        values = self.close_row(env_steps)
        self.flush()
        return values

    def close_row(self, env_steps: int) -> dict[str, float]:
        """Make a row of the averages, which `flush` writes, and start new averages. Waits for the device once.

        Returns:
            The averages by name; empty, without a new row, if nothing was pushed.
        """
        values = self._pending.averages.pop()
        if values:
            self._pending.rows.append((env_steps, values))
        return values

    def flush(self) -> None:
        """Write the pending rows.

        Raises:
            OSError: The file cannot be written; then it is unchanged, and the rows stay pending. Or a logger cannot
                write; then the file and the other loggers still have the rows.
        """
        rows = self._pending.rows
        if not rows:
            return
        new = [name for name in dict.fromkeys(name for _, row in rows for name in row) if name not in self._columns]
        if new:
            self._rewrite(_read_rows(self.path), new)
        self._append(rows)
        written, self._pending.rows = rows, []
        self._pending.written = written[-1][0]
        failed: OSError | None = None
        for sink in self.loggers:
            try:
                for env_steps, values in written:
                    sink.log_metrics(values, step=env_steps)
                if flush := getattr(sink.experiment, "flush", None):
                    flush()
            except OSError as error:
                failed = failed or error
                if renew := getattr(sink, "renew", None):
                    renew()
        if failed:
            raise failed

    def log_evaluation(self, env_steps: int) -> None:
        """Send plots and videos of the evaluations at ``env_steps`` to the loggers that take them."""
        directory, stem = RunDirectory(self.path.parent), f"{env_steps:09d}"
        for sink in self.loggers:
            if hasattr(sink, "log_picture") and hasattr(sink, "log_film"):  # TorchRL's own take scalars alone
                for file in sorted(directory.plots.glob(f"{stem}*.png")):
                    sink.log_picture(f"evaluation{file.stem.removeprefix(stem)}/plot", file, env_steps)
                for file in sorted(directory.videos.glob(f"{stem}*.mp4")):
                    sink.log_film(f"evaluation{file.stem.removeprefix(stem)}/film", file, env_steps)

    def close(self) -> None:
        """Close the loggers that can be closed."""
        for sink in self.loggers:
            for name in ("close", "finish"):  # method of TensorBoard and of W&B
                if end := getattr(sink.experiment, name, None):
                    try:
                        end()
                    except OSError as error:
                        logger.warning("The last metrics sent to %s may be lost: %s.", type(sink).__name__, error)

    def _truncate(self, env_steps: int) -> None:
        rows = _read_rows(self.path) if self.path.exists() else []
        kept = [row for row in rows if int(row[X_AXIS]) <= env_steps]
        if len(kept) < len(rows):
            logger.info("Removing %d rows beyond env_steps=%d from %s.", len(rows) - len(kept), env_steps, self.path)
        named = {name for row in kept for name, cell in row.items() if cell}  # a column appears with its first value
        columns = [name for name in (rows[0] if rows else ()) if name in named and name != X_AXIS]
        self._rewrite([{name: row[name] for name in (X_AXIS, *columns)} for row in kept], columns)

    def _append(self, rows: Iterable[tuple[int, Mapping[str, float]]]) -> None:
        """Append rows with known columns; if that fails, restore the file."""
        size = self.path.stat().st_size
        try:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, self._columns)
                for env_steps, values in rows:
                    writer.writerow({X_AXIS: env_steps, **{name: f"{value:.8g}" for name, value in values.items()}})
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            os.truncate(self.path, size)
            raise

    def _rewrite(self, rows: Iterable[Mapping[str, str]], new_columns: Sequence[str]) -> None:
        """Replace the file by one with these rows and additional columns."""
        columns = [*self._columns, *new_columns]
        content = io.StringIO(newline="")
        writer = csv.DictWriter(content, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
        replace_text(self.path, content.getvalue())
        self._columns = columns


class Journal:
    """What a resumed run needs to write the same rows: metrics not yet in the file, and when actions were last due.

    Attributes:
        averages: Averages of the metrics pushed since the latest row.
        rows: env_steps and values of rows that are not yet written.
        written: env_steps of the latest row in the file; 0 before the first.
        latest: env_steps at which each periodic action was last due, restored in place.
    """

    def __init__(self, latest: dict[str, int] | None = None) -> None:
        self.averages = RunningMean()
        self.rows: list[tuple[int, dict[str, float]]] = []
        self.written = 0
        self.latest = {} if latest is None else latest

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        averages = self.averages.state_dict()
        return {"latest": dict(self.latest), "averages": averages, "rows": list(self.rows), "written": self.written}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.averages.load_state_dict(state_dict["averages"])
        self.rows, self.written = list(state_dict["rows"]), state_dict["written"]
        self.latest.update(state_dict["latest"])


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Read the complete rows; skip those without a number of env_steps, and log that."""
    header, cells, _ = read_rows(path)
    rows = [dict(zip(header, row, strict=True)) for row in cells]
    steps = [row[X_AXIS] for row in rows]
    damaged = [cell for cell in steps if not (cell.isascii() and cell.isdigit() and len(cell) < MOST_DIGITS)]
    if damaged:
        logger.warning(
            "%s is damaged: %s is not a number of env_steps. %d of %d rows are ignored.",
            path, quoted(damaged[0]), len(damaged), len(rows),
        )  # fmt: skip
    return [row for row in rows if row[X_AXIS] not in damaged]


def _keep_aside(path: Path) -> None:
    if path.exists():
        names = (path.with_name(f"{path.stem}.{number}{path.suffix}") for number in itertools.count(1))
        other = next(name for name in names if not name.exists())
        logger.warning("%s belongs to an earlier run and is kept as %s.", path, other.name)
        os.replace(path, other)


class RunningMean:
    """Running means of named values, summed on the values' device.

    The tensors of one push are stacked and added to the sums of their names: two kernels for any number of names.
    """

    def __init__(self) -> None:
        self._tensors: dict[tuple[torch.device, tuple[str, ...]], tuple[Tensor, int]] = {}
        self._floats: dict[str, tuple[float, int]] = {}

    def push(self, metrics: Mapping[str, Tensor | float], count: int = 1) -> None:
        """Add values to the averages with weight ``count``; tensors stay on their device."""
        by_device: dict[torch.device, dict[str, Tensor]] = defaultdict(dict)
        for name, value in metrics.items():
            if isinstance(value, Tensor):
                by_device[value.device][name] = value.detach().float().mean() if value.ndim else value.detach().float()
            else:
                total, counted = self._floats.get(name, (0.0, 0))
                self._floats[name] = (total + count * float(value), counted + count)
        for device, values in by_device.items():
            key = (device, tuple(values))
            stacked = torch.stack(list(values.values()))
            sums, counted = self._tensors.get(key, (torch.zeros_like(stacked), 0))
            self._tensors[key] = (sums + count * stacked, counted + count)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "tensors": [(list(names), total.clone(), count) for (_, names), (total, count) in self._tensors.items()],
            "floats": dict(self._floats),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned; tensors stay on the device that they were loaded to."""
        self._tensors = {
            (total.device, tuple(names)): (total.clone(), count) for names, total, count in state_dict["tensors"]
        }
        self._floats = dict(state_dict["floats"])

    def pop(self) -> dict[str, float]:
        """Return the means by name, and start new ones. Copies once from each device."""
        totals: dict[str, tuple[float, int]] = dict(self._floats)
        for device in {device for device, _ in self._tensors}:
            groups = [(names, *entry) for (where, names), entry in self._tensors.items() if where == device]
            numbers = iter(torch.cat([total for _, total, _ in groups]).tolist())
            for names, _, count in groups:
                for name in names:
                    total, before = totals.get(name, (0.0, 0))
                    totals[name] = (total + next(numbers), before + count)
        self._tensors.clear()
        self._floats.clear()
        return {name: total / count for name, (total, count) in totals.items()}


@dataclass(frozen=True)
class MetricsTable:
    """Readable contents of a `metrics.csv`."""

    columns: dict[str, tuple[np.ndarray, np.ndarray]]
    """env_steps and values of the finite cells, (R,) each, by column name; columns without any are left out."""
    env_steps: np.ndarray
    """env_steps of all rows, (R,)."""
    problems: list[str]
    """Descriptions of what was left out."""


def read_rows(path: Path) -> tuple[list[str], list[list[str]], list[str]]:
    """Return the header, the rows with as many cells as it has, and descriptions of what was left out.

    The last row may be truncated by a kill, or still being written.

    Raises:
        ValueError: The file is not a table of metrics.
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
    """Read the wanted columns of a `metrics.csv` that it has, or all, as numbers, in the order of env_steps.

    Raises:
        ValueError: The file is not a table of metrics, or has no rows.
        OSError: The file is missing or cannot be read.
    """
    header, rows, problems = read_rows(Path(path))
    if not rows:
        raise ValueError(f"{path} has no rows: nothing was logged yet.")
    steps = np.array([_number(row[header.index(X_AXIS)]) for row in rows])
    order = np.argsort(steps, kind="stable")[: np.isfinite(steps).sum()]  # NaN sorts last
    if len(order) < len(rows):
        problems.append(f"{len(rows) - len(order)} of {len(rows)} rows have no number of env_steps")
    columns, unreadable = {}, 0
    for index, name in enumerate(header):
        if name == X_AXIS or (wanted is not None and name not in wanted):
            continue
        cells = [row[index] for row in rows]
        values = np.array([_number(cell) for cell in cells])
        unreadable += sum(cells[i].lower() not in ("", "nan") for i in np.flatnonzero(np.isnan(values)))
        kept = order[np.isfinite(values[order])]
        if len(kept):
            columns[name] = (steps[kept], values[kept])
    if unreadable:
        problems.append(f"{unreadable} cells are not numbers")
    return MetricsTable(columns, steps[order], problems)


def _number(cell: str) -> float:
    """Parse a cell; an empty or unreadable one becomes NaN."""
    try:
        return float(cell)
    except ValueError:
        return math.nan
