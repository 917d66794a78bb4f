"""Metrics of a run: a CSV file over ``env_steps``, and loggers beside it."""

from __future__ import annotations

import csv
import logging
import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from dreamer_racing.training.directory import RunDirectory

logger = logging.getLogger(__name__)
X_AXIS = "env_steps"


class MetricsLog:
    """Averages the metrics pushed since the last write and writes them to ``metrics.csv`` and to loggers.

    The file has one row a write and a column ``env_steps`` first; a metric that appears later gets a new column at the
    end, empty in earlier rows. Whatever the moment the process is killed, at most the row being written is lost.

    Args:
        run_dir: folder of the run.
        loggers: TorchRL loggers that receive every row too (`dreamer_racing.training.loggers` makes some).
        resume_env_steps: of the checkpoint this run continues: rows beyond it are removed. If None, the run is new,
            and a ``metrics.csv`` already there is kept under another name.

    Example:
        >>> with MetricsLog("runs/example") as metrics:  # doctest: +SKIP
        ...     metrics.push({"loss/actor": torch.tensor(1.0)})
        ...     metrics.write(env_steps=1024)
    """

    def __init__(
        self,
        run_dir: str | Path,
        loggers: Sequence[Logger] = (),
        resume_env_steps: int | None = None,
    ) -> None:
        run_dir = Path(run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        self.path = RunDirectory(run_dir).metrics
        self.loggers = list(loggers)
        self._mean = RunningMean()
        self._columns = [X_AXIS]
        if resume_env_steps is None:
            _keep_aside(self.path)
            self._rewrite([])
        else:
            self._truncate(resume_env_steps)

    def push(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Adds values to the averages; tensors stay on their device, so that nothing waits for it.

        Args:
            metrics: values by name; of a tensor of several elements the mean counts.
        """
        self._mean.push(metrics)

    def write(self, env_steps: int) -> dict[str, float]:
        """Writes the averages as one row and starts new ones. Waits for the device once.

        Args:
            env_steps: control steps summed over environments.

        Returns:
            The averages by name; empty, and no row written, if nothing was pushed.
        """
        values = self._mean.pop()
        if not values:
            return values
        new = [name for name in values if name not in self._columns]
        if new:
            rows = _read_rows(self.path)
            self._columns += new
            self._rewrite(rows)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            row = {name: f"{value:.8g}" for name, value in values.items()}
            csv.DictWriter(file, self._columns).writerow({X_AXIS: env_steps, **row})
        for sink in self.loggers:
            sink.log_metrics(values, step=env_steps)
            if flush := getattr(sink.experiment, "flush", None):
                flush()
        return values

    def holds(self, name: str, env_steps: int) -> bool:
        """Whether a row at these env_steps has a value of this metric."""
        return any(int(row[X_AXIS]) == env_steps and row.get(name) for row in _read_rows(self.path))

    def close(self) -> None:
        """Closes the loggers that can be closed."""
        for sink in self.loggers:
            for name in ("close", "finish"):  # TensorBoard's word for it, and W&B's
                if end := getattr(sink.experiment, name, None):
                    end()

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _truncate(self, env_steps: int) -> None:
        rows = _read_rows(self.path) if self.path.exists() else []
        kept = [row for row in rows if int(row[X_AXIS]) <= env_steps]
        if len(kept) < len(rows):
            logger.info("Removing %d rows beyond env_steps=%d from %s.", len(rows) - len(kept), env_steps, self.path)
        self._columns = list(rows[0]) if rows else [X_AXIS]
        self._rewrite(kept)

    def _rewrite(self, rows: Iterable[Mapping[str, str]]) -> None:
        partial = self.path.with_name(f".{self.path.name}.partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, restval="")
            writer.writeheader()
            writer.writerows(rows)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, self.path)


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Read the complete rows."""
    header, rows, _ = read_rows(path)
    return [dict(zip(header, row, strict=True)) for row in rows]


def _keep_aside(path: Path) -> None:
    if not path.exists():
        return
    number = 1
    while (other := path.with_name(f"{path.stem}.{number}{path.suffix}")).exists():
        number += 1
    logger.warning("%s belongs to an earlier run and is kept as %s.", path, other.name)
    os.replace(path, other)


class RunningMean:
    """Means of named values, summed where the values are.

    The tensors of one push are stacked and added to the sums of their names: two kernels a push however many names.
    """

    def __init__(self) -> None:
        self._tensors: dict[tuple[torch.device, tuple[str, ...]], tuple[Tensor, int]] = {}
        self._floats: dict[str, tuple[float, int]] = {}

    def push(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Add values to the averages; tensors stay on their device."""
        by_device: dict[torch.device, dict[str, Tensor]] = defaultdict(dict)
        for name, value in metrics.items():
            if isinstance(value, Tensor):
                by_device[value.device][name] = value.detach().float().mean() if value.ndim else value.detach().float()
            else:
                total, count = self._floats.get(name, (0.0, 0))
                self._floats[name] = (total + float(value), count + 1)
        for device, values in by_device.items():
            key = (device, tuple(values))
            stacked = torch.stack(list(values.values()))
            sums, pushes = self._tensors.get(key, (torch.zeros_like(stacked), 0))
            self._tensors[key] = (sums + stacked, pushes + 1)

    def pop(self) -> dict[str, float]:
        """Returns the means by name, in order of first appearance, and starts anew. Copies once from each device."""
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
