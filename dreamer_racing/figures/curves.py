"""Learning curves aggregated over seeds, and their CSV file, from which the figure can be drawn again.

Shapes: S seeds, P points of the common axis, D draws of the bootstrap.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dreamer_racing.figures.runs import AXES, CurveKey, RunData, along, axis_of, group_runs, is_metrics, runs_below
from dreamer_racing.settings import check_choice

CURVES = "learning_curves.csv"
POINTS, DRAWS = 240, 2000  # P, D
WINDOW_SHARE = 0.02  # default window of the running mean, as a share of the longest run
GAPS = "where a seed has no value, the mean of the others; a gap where fewer than half of the seeds have one"
ENDS_EARLY = 0.98  # runs that end before this share of a curve's longest run are reported
WEIGHT = "curriculum/body_rate_weight"
ALL_TRACKS = "all tracks"


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be drawn as a learning curve."""

    label: str
    column: str  # of `metrics.csv`
    comparable: bool = False  # a rate from 0 to 1, which is comparable across tracks, so that tracks may be pooled
    counted: bool = False  # a count, so that bars and axes begin at 0
    positive: bool = False  # never negative, so that its axis does not go below 0


QUANTITIES = {
    "return": Quantity("Return (training episodes)", "episode/return"),
    "evaluation_return": Quantity("Return (deterministic)", "evaluation/return_mean"),
    "success_rate": Quantity("Success rate (deterministic)", "evaluation/success_rate", comparable=True),
    "stochastic_success_rate": Quantity(
        "Success rate (stochastic)", "evaluation_stochastic/success_rate", comparable=True
    ),
    "gates": Quantity("Gates per episode (deterministic)", "evaluation/gates_per_episode", counted=True),
    "stochastic_gates": Quantity(
        "Gates per episode (stochastic)", "evaluation_stochastic/gates_per_episode", counted=True
    ),
    "training_gates": Quantity("Gates (training episodes)", "episode/gates_passed", counted=True),
    "lap_time": Quantity("Mean lap time (s, deterministic)", "evaluation/lap_time_mean", positive=True),
    "lap_time_best": Quantity("Best lap time (s, deterministic)", "evaluation/lap_time_best", positive=True),
    "image_error": Quantity("Image error (held out)", "held_out/image_error", positive=True),
}
"""Quantities by name; evaluations of the deterministic or stochastic policy have rewards at b₂ = 0."""
PRESENCE = ("num_episodes", "return_mean")
"""Columns, after the prefix `evaluation/` or `evaluation_stochastic/`, with a value in every evaluation's row."""


@dataclass(frozen=True)
class Curve:
    """One line of a figure with its band, all (P,)."""

    key: CurveKey
    quantity: str
    x: np.ndarray  # positions on the figure's axis
    centre: np.ndarray
    low: np.ndarray  # NaN, as is `high`, where there is a single seed
    high: np.ndarray
    seeds: np.ndarray  # int: number of runs with a value


@dataclass(frozen=True)
class LearningCurves:
    """Content of a figure of learning curves."""

    curves: list[Curve]
    raises: dict[CurveKey, np.ndarray]  # positions on the axis where the curriculum raised b₂, of all seeds together
    aggregate: str
    window: float  # of the running mean, in units of the axis
    problems: list[str]  # a line for everything left out
    axis: str = "env_steps"  # one of `AXES`


def wanted_columns(quantities: Sequence[str], axis: str = "env_steps") -> list[str]:
    """Return the columns of `metrics.csv` to draw quantities along an axis; raise ValueError if one is unknown."""
    clock = axis_of(axis).clock
    for name in quantities:
        check_choice("quantities", name, QUANTITIES)
    columns = [QUANTITIES[name].column for name in quantities]
    beside = [name for column in columns for name in _evaluation_markers(column)]
    return [*dict.fromkeys([*columns, *beside, WEIGHT, *([clock] if clock else [])])]


def _evaluation_markers(column: str) -> list[str]:
    """Return the columns that mark the rows of evaluations, for a column of evaluations."""
    prefix = column.partition("/")[0]
    return [f"{prefix}/{name}" for name in PRESENCE] if prefix.startswith("evaluation") else []


def learning_curves(
    runs: Sequence[RunData],
    quantities: Sequence[str] = ("return",),
    aggregate: str = "mean",
    window: float | None = None,
    problems: Sequence[str] = (),
    axis: str = "env_steps",
) -> LearningCurves:
    """Aggregate runs of any algorithms and tracks over seeds, for `QUANTITIES` on a common axis, one of `AXES`.

    The aggregate is ``mean`` (with the sample standard deviation) or ``iqm`` (interquartile mean with a 95 % interval),
    of running means over a window, in units of the axis, by default 2 % of the longest run.

    Raises:
        ValueError: there are no runs or values, a quantity or the axis is unknown, or two runs of one curve have the
            same seed.
    """
    wanted_columns(quantities, axis)
    if not runs:
        raise ValueError(f"there is no run to draw. {'; '.join(problems) or 'None was given.'}")
    runs, without_clock = along(runs, axis)
    if not runs:
        raise ValueError(f"axis={axis}: {'; '.join(without_clock)}.")
    groups = group_runs(runs)
    longest = max(run.metrics.env_steps.max(initial=0) for run in runs)
    width = float(max(window if window is not None else WINDOW_SHARE * longest, axis_of(axis).smallest_window))
    grid = np.linspace(0.0, longest, POINTS)
    missing, curves = [*problems, *without_clock, *_short_runs(groups, axis)], []
    for name in quantities:
        sampled: dict[CurveKey, Sampled] = {}
        for key, group in groups.items():
            absent = [run.name for run in group if QUANTITIES[name].column not in run.metrics.columns]
            if absent:
                who = ", ".join(absent) if len(absent) < len(group) else f"all runs of {key}"
                missing.append(f"no values of {QUANTITIES[name].column}: {who}")
            if len(absent) < len(group):
                sampled[key] = sample(group, QUANTITIES[name].column, grid, width)
        gaps = sum(value.has_gaps for value in sampled.values())
        missing += [f"{QUANTITIES[name].label}: {GAPS} ({gaps} of {len(sampled)} curves)"] if gaps else []
        curves += [_aggregate(key, name, grid, [value], aggregate) for key, value in sampled.items()]
        if aggregate == "iqm" and QUANTITIES[name].comparable:
            pooled = _pool(sampled).items()
            curves += [_aggregate(key, name, grid, strata, aggregate) for key, strata in pooled]
    if not curves:
        raise ValueError(f"no run has values of {', '.join(quantities)}. {'; '.join(missing)}")
    raises = {key: np.concatenate([weight_raises(run) for run in group]) for key, group in groups.items()}
    return LearningCurves(curves, raises, aggregate, width, missing, axis)


class Sampled(NamedTuple):
    """The runs of one curve on the common axis, (S, P) each."""

    values: np.ndarray  # NaN where a run has no value
    reached: np.ndarray  # bool: whether the point is within the measured range of the run, even without a value

    @property
    def has_gaps(self) -> bool:
        """Whether at some point one run has a value and another, although within its range, has none."""
        present = np.isfinite(self.values)
        return bool((present.any(0) & (self.reached & ~present).any(0)).any())


def sample(group: Sequence[RunData], column: str, grid: np.ndarray, window: float) -> Sampled:
    """Compute running means of runs on the common axis (P,), each within the measured range of its run."""
    tables = [measurements(run, column) for run in group]
    values = np.stack([resample(*table, grid, window) for table in tables])
    ends = np.array([(steps[0], steps[-1]) if len(steps) else (np.inf, -np.inf) for steps, _ in tables])  # (S, 2)
    reached = (grid + window / 2 >= ends[:, :1]) & (grid - window / 2 <= ends[:, 1:])
    return Sampled(values, reached)


def measurements(run: RunData, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return sorted env_steps and values of a column, (R,) each, with NaN for every evaluation without a value."""
    columns = run.metrics.columns
    steps, values = columns.get(column, (np.empty(0), np.empty(0)))
    evaluated = [columns[name][0] for name in _evaluation_markers(column) if name in columns]
    without = np.setdiff1d(np.concatenate([*evaluated, np.empty(0)]), steps)
    order = np.argsort(np.concatenate((steps, without)), kind="stable")
    filled = np.concatenate((values, np.full(len(without), np.nan)))
    return np.concatenate((steps, without))[order], filled[order]


def resample(steps: np.ndarray, values: np.ndarray, grid: np.ndarray, window: float) -> np.ndarray:
    """Compute the running mean of values (R,) at sorted env_steps (R,) on a grid of env_steps, (P,).

    It is the mean over the window at each row, interpolated linearly between rows, so that windows with few rows cause
    no steps. NaN beyond the ends, and beside a row without a value (NaN) if the window contains no value.
    """
    if not len(steps):
        return np.full(len(grid), np.nan)
    rows = np.where(np.isfinite(values), _within(steps, values, steps, window), np.nan)  # (R,)
    lines = np.interp(grid, steps, rows, left=np.nan, right=np.nan)
    return np.where(np.isfinite(lines), lines, _within(steps, values, grid, window))


def _within(steps: np.ndarray, values: np.ndarray, places: np.ndarray, window: float) -> np.ndarray:
    """Return the mean of the values (R,) within the window around each place (K,); NaN if there is none."""
    first = np.searchsorted(steps, places - window / 2, "left")
    last = np.searchsorted(steps, places + window / 2, "right")
    found = np.isfinite(values)
    sums = np.concatenate(([0.0], np.cumsum(np.where(found, values, 0.0))))
    counts = np.concatenate(([0], np.cumsum(found)))
    count = counts[last] - counts[first]
    return np.where(count > 0, (sums[last] - sums[first]) / np.maximum(count, 1), np.nan)


def weight_raises(run: RunData) -> np.ndarray:
    """Return the env_steps at which the curriculum raised b₂ by a whole increment."""
    if WEIGHT not in run.metrics.columns:
        return np.empty(0)
    steps, weight = run.metrics.columns[WEIGHT]
    # A row is the mean since the row before; a value between two levels is rounded down.
    levels = np.floor(weight / float(run.config.get("curriculum.increment") or 1e-9) + 1e-3)
    return steps[1:][np.diff(levels) > 0]


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Return the mean of the middle half of S runs (S, ...): a quarter, rounded down, is cut off at either end.

    Reference: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021.
    """
    import scipy.stats  # takes a second; not needed in training

    return scipy.stats.trim_mean(scores, 0.25, axis=0)


def bootstrap_interval(
    strata: Sequence[np.ndarray], statistic: Callable[[np.ndarray], np.ndarray] = interquartile_mean
) -> np.ndarray:
    """Return the 2.5 and the 97.5 percentile (2, P) of a statistic along the first axis, by D draws of a bootstrap.

    It is stratified: every track keeps its number of runs (S, P).

    Reference: Agarwal et al., 2021, whose library rliable is not used: it needs arch, pandas and seaborn, and its
    stratified bootstrap draws from numpy's global generator.
    """
    generator = np.random.default_rng(0)
    pooled = [stratum[generator.integers(len(stratum), size=(len(stratum), DRAWS))] for stratum in strata]
    return np.percentile(statistic(np.concatenate(pooled)), (2.5, 97.5), axis=0)  # of (D, P)


def _deviation_band(strata: Sequence[np.ndarray]) -> np.ndarray:
    pooled = np.concatenate(strata)
    return pooled.mean(0) + np.array([[-1.0], [1.0]]) * pooled.std(0, ddof=1)


AGGREGATES: dict[str, tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]] = {
    "mean": (lambda runs: runs.mean(0), _deviation_band),
    "iqm": (interquartile_mean, bootstrap_interval),
}
"""Functions for the centre, from runs (S, P), and for the band (2, P), from runs by track."""


def _aggregate(key: CurveKey, quantity: str, grid: np.ndarray, strata: list[Sampled], aggregate: str) -> Curve:
    """Aggregate runs, by track, at every point where at least half of the runs in range have a value."""
    present = np.isfinite(np.concatenate([stratum.values for stratum in strata]))  # (S, P)
    reached = np.concatenate([stratum.reached for stratum in strata])  # (S, P)
    shown = present & (2 * present.sum(0) >= (present | reached).sum(0))
    result = np.full((3, len(grid)), np.nan)  # centre, low, high
    centre, band = AGGREGATES[aggregate]
    for pattern in np.unique(shown, axis=1).T:
        points = (shown == pattern[:, None]).all(0)
        chosen = np.split(pattern, np.cumsum([len(stratum.values) for stratum in strata])[:-1])
        kept = [stratum.values[runs][:, points] for stratum, runs in zip(strata, chosen, strict=True) if runs.any()]
        if kept:
            result[0, points] = centre(np.concatenate(kept))
        if max(map(len, kept), default=0) > 1:  # a single run has no spread
            result[1:, points] = band(kept)
    return Curve(key, quantity, grid, result[0], result[1], result[2], present.sum(0))


def _pool(sampled: dict[CurveKey, Sampled]) -> dict[CurveKey, list[Sampled]]:
    """Pool the tracks of each variant that was run on all tracks, if there are several."""
    tracks = {key.track for key in sampled}
    pooled: dict[CurveKey, list[Sampled]] = defaultdict(list)
    for key, value in sampled.items():
        pooled[key._replace(track=ALL_TRACKS)].append(value)
    return {key: strata for key, strata in pooled.items() if len(strata) == len(tracks) > 1}


def _short_runs(groups: dict[CurveKey, list[RunData]], axis: str) -> list[str]:
    """Return a line for each run that ends before the longest run of its curve."""
    lines, form = [], axis_of(axis).form
    for group in groups.values():
        ends = [run.metrics.env_steps.max(initial=0) for run in group]
        lines += [
            f"{run.name} ends at {end:{form}} of {max(ends):{form}} {axis}: fewer seeds after that"
            for run, end in zip(group, ends, strict=True)
            if end < ENDS_EARLY * max(ends)
        ]
    return lines


_KEYS = ("quantity", "track", "algorithm", "variant")
_VALUES = ("centre", "low", "high", "seeds")
_RAISE = "b2_raised"  # in the column quantity, for rows without values


def write_curves(path: str | Path, curves: LearningCurves) -> None:
    """Write curves as one CSV file, one row per point, after header lines with `#` that hold the settings."""
    form = ".6g" if axis_of(curves.axis).clock else ".0f"
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        file.write(f"# aggregate: {curves.aggregate}\n# window: {curves.window!r}\n")
        file.writelines(f"# problem: {problem}\n" for problem in curves.problems)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*_KEYS, curves.axis, *_VALUES))
        for curve in curves.curves:
            for x, *values, seeds in zip(curve.x, curve.centre, curve.low, curve.high, curve.seeds, strict=True):
                cells = [f"{value:.6g}" if math.isfinite(value) else "" for value in values]
                writer.writerow((curve.quantity, *curve.key, f"{x:{form}}", *cells, seeds))
        for key, raises in curves.raises.items():
            writer.writerows((_RAISE, *key, f"{x:{form}}", "", "", "", "") for x in raises)


def curves_file(path: str | Path) -> Path | None:
    """Return the curves file that a path names: a CSV that is no metrics table, or the one in a folder without runs."""
    path = Path(path).expanduser()
    if path.is_dir():
        file = path / CURVES
        return file if file.is_file() and next(runs_below(path), None) is None else None
    return path if path.suffix == ".csv" and path.is_file() and not is_metrics(path) else None


def read_curves(path: str | Path) -> LearningCurves:
    """Read a file written by `write_curves`; raise ValueError if it is of another kind."""
    with Path(path).open(newline="", encoding="utf-8") as file:
        lines = file.readlines()
    notes = [line[2:].rstrip("\n").partition(": ") for line in lines if line.startswith("# ")]
    head = {name: text for name, _, text in notes if name != "problem"}
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    names = tuple(reader.fieldnames or ())
    axis = next((name for name in AXES if names == (*_KEYS, name, *_VALUES)), None)
    if axis is None or head.keys() != {"aggregate", "window"}:
        raise ValueError(f"{path} holds no learning curves: they are written by recipes/plot.py.")
    rows: dict[tuple[str, CurveKey], list[list[float]]] = defaultdict(list)
    for row in reader:
        key = CurveKey(row["track"], row["algorithm"], row["variant"])
        rows[row["quantity"], key].append([float(row[name] or "nan") for name in (axis, *_VALUES)])
    tables = {curve: np.array(values).T for curve, values in rows.items()}  # (5, P)
    curves = [
        Curve(key, quantity, x, centre, low, high, seeds.astype(int))
        for (quantity, key), (x, centre, low, high, seeds) in tables.items()
        if quantity != _RAISE
    ]
    raises = {key: table[0] for (quantity, key), table in tables.items() if quantity == _RAISE}
    problems = [text for name, _, text in notes if name == "problem"]
    return LearningCurves(curves, raises, head["aggregate"], float(head["window"]), problems, axis)
