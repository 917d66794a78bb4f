"""Learning curves over seeds: what is drawn, as numbers, and as a CSV file from which it can be drawn again.

Shapes: S seeds, P points of the common axis, D draws of the bootstrap.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dreamer_racing.runs import CurveKey, RunData, group_runs

POINTS = 240  # P
WINDOW_SHARE = 0.02  # of the longest run: the running mean's window, unless it is given
ENDS_EARLY = 0.98  # of the longest run of a curve: one that ends before is mentioned
WEIGHT = "curriculum/body_rate_weight"
ALL_TRACKS = "all tracks"


@dataclass(frozen=True)
class Quantity:
    """Something to draw over env_steps."""

    label: str
    column: str
    """Of `metrics.csv`."""
    comparable: bool = False
    """Whether the same value means the same on every track, so that tracks may be pooled."""


QUANTITIES = {
    "return": Quantity("Return (training episodes)", "episode/return"),
    "evaluation_return": Quantity("Return (evaluation)", "evaluation/return_mean"),
    "success_rate": Quantity("Success rate", "evaluation/success_rate", comparable=True),
    "gates": Quantity("Gates per episode", "evaluation/gates_per_episode"),
    "training_gates": Quantity("Gates (training episodes)", "episode/gates_passed"),
    "lap_time": Quantity("Mean lap time (s)", "evaluation/lap_time_mean"),
    "lap_time_best": Quantity("Best lap time (s)", "evaluation/lap_time_best"),
}


@dataclass(frozen=True)
class Curve:
    """One line of a figure and the band around it, all (P,)."""

    key: CurveKey
    quantity: str
    env_steps: np.ndarray
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: np.ndarray
    """int: how many runs have a value there."""


@dataclass(frozen=True)
class LearningCurves:
    """Everything that a figure of learning curves shows."""

    curves: list[Curve]
    raises: dict[CurveKey, np.ndarray]
    """env_steps at which the curriculum raised b₂, of all seeds together."""
    aggregate: str
    window: float
    """Of the running mean, env_steps."""
    problems: list[str]
    """What was left out, a line each."""


def wanted_columns(quantities: Sequence[str]) -> list[str]:
    """Name the columns of `metrics.csv` that some quantities are drawn from.

    Raises:
        ValueError: unknown quantity.
    """
    for name in quantities:
        if name not in QUANTITIES:
            raise ValueError(f"quantities={name}: there are {', '.join(QUANTITIES)}.")
    return [*(QUANTITIES[name].column for name in quantities), WEIGHT]


def learning_curves(
    runs: Sequence[RunData],
    quantities: Sequence[str] = ("return",),
    aggregate: str = "mean",
    window: float | None = None,
    problems: Sequence[str] = (),
) -> LearningCurves:
    """Aggregate runs over seeds on a common axis of env_steps.

    Args:
        runs: of any algorithms and tracks.
        quantities: names out of `QUANTITIES`.
        aggregate: ``mean`` (with the standard deviation) or ``iqm`` (interquartile mean with a 95 % interval).
        window: of the running mean, env_steps; None for 2 % of the longest run.
        problems: what was left out already.

    Raises:
        ValueError: no runs, an unknown name, or runs of one curve that were not configured alike.
    """
    wanted_columns(quantities)
    if aggregate not in AGGREGATES:
        raise ValueError(f"aggregate={aggregate}: there are {', '.join(AGGREGATES)}.")
    if not runs:
        raise ValueError(f"there is no run to draw. {'; '.join(problems) or 'None was given.'}")
    groups = group_runs(runs)
    longest = max(run.metrics.env_steps.max(initial=0) for run in runs)
    width = float(max(window if window is not None else WINDOW_SHARE * longest, 1.0))
    grid = np.linspace(0.0, longest, POINTS)
    missing, curves = [*problems, *_short_runs(groups)], []
    for name in quantities:
        column = QUANTITIES[name].column
        values: dict[CurveKey, np.ndarray] = {}
        for key, group in groups.items():
            tables = [run.metrics.columns[column] for run in group if column in run.metrics.columns]
            absent = [run.name for run in group if column not in run.metrics.columns]
            if absent:
                who = ", ".join(absent) if tables else f"all runs of {key}"
                missing.append(f"no values of {column}: {who}")
            if tables:
                values[key] = np.stack([resample(*table, grid, width) for table in tables])
        curves += [_aggregate(key, name, grid, [value], aggregate) for key, value in values.items()]
        if aggregate == "iqm" and QUANTITIES[name].comparable:
            pooled = _pool(values).items()
            curves += [_aggregate(key, name, grid, strata, aggregate) for key, strata in pooled]
    if not curves:
        raise ValueError(f"no run has values of {', '.join(quantities)}. {'; '.join(missing)}")
    raises = {key: np.concatenate([weight_raises(run) for run in group]) for key, group in groups.items()}
    return LearningCurves(curves, raises, aggregate, width, missing)


def resample(steps: np.ndarray, values: np.ndarray, grid: np.ndarray, window: float) -> np.ndarray:
    """Take the running mean of a metric at other env_steps.

    Args:
        steps: (R,) env_steps of the values, rising.
        values: (R,).
        grid: (P,) env_steps to return values for.
        window: env_steps around each, over which to average.

    Returns:
        (P,): the mean within the window; where there is no value, between the neighbours; NaN beyond the
        ends.
    """
    first = np.searchsorted(steps, grid - window / 2, "left")
    last = np.searchsorted(steps, grid + window / 2, "right")
    sums = np.concatenate(([0.0], np.cumsum(values)))
    count = last - first
    mean = (sums[last] - sums[first]) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.interp(grid, steps, values, left=np.nan, right=np.nan))


def weight_raises(run: RunData) -> np.ndarray:
    """Find the env_steps at which the curriculum raised b₂ by a whole increment."""
    if WEIGHT not in run.metrics.columns:
        return np.empty(0)
    steps, weight = run.metrics.columns[WEIGHT]
    # A row is the mean of what was in force since the row before: one between two levels is no level of its own.
    levels = np.floor(weight / float(run.config.get("curriculum.increment") or 1e-9) + 1e-3)
    return steps[1:][np.diff(levels) > 0]


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Average the middle half along the first axis.

    Reference: Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021.

    Args:
        scores: (S, ...) of S runs, of which a quarter, rounded down, is cut off at either end.
    """
    cut = len(scores) // 4
    return np.sort(scores, axis=0)[cut : len(scores) - cut].mean(axis=0)


def bootstrap_interval(
    strata: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], np.ndarray] = interquartile_mean,
    draws: int = 2000,
    seed: int = 0,
) -> np.ndarray:
    """Bound a statistic of pooled runs by a stratified percentile bootstrap: every track keeps its number of runs.

    Reference: Agarwal et al., 2021, whose library rliable is not used: it needs arch, pandas and seaborn, and its
    stratified bootstrap draws from numpy's global generator.

    Args:
        strata: the runs of each track, (S, P).
        statistic: of an array (S, ...) along its first axis.
        draws: D.
        seed: of the draws.

    Returns:
        (2, P): the 2.5 and the 97.5 percentile.
    """
    generator = np.random.default_rng(seed)
    pooled = [stratum[generator.integers(len(stratum), size=(len(stratum), draws))] for stratum in strata]
    return np.percentile(statistic(np.concatenate(pooled)), (2.5, 97.5), axis=0)  # of (D, P)


def _mean(strata: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pooled = np.concatenate(strata)
    centre, spread = pooled.mean(0), pooled.std(0)
    return centre, centre - spread, centre + spread


def _iqm(strata: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return interquartile_mean(np.concatenate(strata)), *bootstrap_interval(strata)


AGGREGATES = {"mean": _mean, "iqm": _iqm}


def _aggregate(key: CurveKey, quantity: str, grid: np.ndarray, strata: list[np.ndarray], aggregate: str) -> Curve:
    """Aggregate the runs (S, P) of each stratum, at every point those that have a value there."""
    present = np.isfinite(np.concatenate(strata))  # (S, P)
    result = np.full((3, len(grid)), np.nan)  # centre, low, high
    for pattern in np.unique(present, axis=1).T:
        points = (present == pattern[:, None]).all(0)
        kept = [stratum[np.isfinite(stratum[:, points]).all(1)][:, points] for stratum in strata]
        if any(len(stratum) for stratum in kept):
            result[:, points] = AGGREGATES[aggregate]([stratum for stratum in kept if len(stratum)])
    centre, low, high = result
    return Curve(key, quantity, grid, centre, low, high, present.sum(0))


def _pool(values: dict[CurveKey, np.ndarray]) -> dict[CurveKey, list[np.ndarray]]:
    """Put the tracks of an algorithm together, if it has been run on all of several."""
    tracks = {key.track for key in values}
    pooled: dict[CurveKey, list[np.ndarray]] = defaultdict(list)
    for key, value in values.items():
        pooled[key._replace(track=ALL_TRACKS)].append(value)
    return {key: strata for key, strata in pooled.items() if len(strata) == len(tracks) > 1}


def _short_runs(groups: dict[CurveKey, list[RunData]]) -> list[str]:
    """Mention the runs that end before the others of their curve do."""
    lines = []
    for group in groups.values():
        ends = [run.metrics.env_steps.max(initial=0) for run in group]
        lines += [
            f"{run.name} ends at {end:,.0f} of {max(ends):,.0f} env_steps: fewer seeds from there"
            for run, end in zip(group, ends, strict=True)
            if end < ENDS_EARLY * max(ends)
        ]
    return lines


_COLUMNS = ("quantity", "track", "algorithm", "variant", "env_steps", "centre", "low", "high", "seeds")
_RAISE = "b2_raised"  # in the column quantity, of rows that have no value


def write_curves(path: str | Path, curves: LearningCurves) -> None:
    """Write curves as one CSV file, a row a point, under lines with `#` that say how they were made."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        file.write(f"# aggregate: {curves.aggregate}\n# window: {curves.window!r}\n")
        file.writelines(f"# problem: {problem}\n" for problem in curves.problems)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for curve in curves.curves:
            numbers = zip(curve.env_steps, curve.centre, curve.low, curve.high, curve.seeds, strict=True)
            for steps, *values, seeds in numbers:
                cells = [f"{value:.6g}" if math.isfinite(value) else "" for value in values]
                writer.writerow((curve.quantity, *curve.key, f"{steps:.0f}", *cells, seeds))
        for key, steps in curves.raises.items():
            writer.writerows((_RAISE, *key, f"{step:.0f}", "", "", "", "") for step in steps)


def read_curves(path: str | Path) -> LearningCurves:
    """Read what `write_curves` wrote.

    Raises:
        ValueError: this is no such file.
    """
    with Path(path).open(newline="", encoding="utf-8") as file:
        lines = file.readlines()
    notes = [line[2:].rstrip("\n").partition(": ") for line in lines if line.startswith("# ")]
    head = {name: text for name, _, text in notes if name != "problem"}
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    if tuple(reader.fieldnames or ()) != _COLUMNS or head.keys() != {"aggregate", "window"}:
        raise ValueError(f"{path} holds no learning curves: they are written by recipes/plot.py.")
    rows: dict[tuple[str, CurveKey], list[list[float]]] = defaultdict(list)
    for row in reader:
        key = CurveKey(row["track"], row["algorithm"], row["variant"])
        rows[row["quantity"], key].append([float(row[name] or "nan") for name in _COLUMNS[4:]])
    tables = {names: np.array(values).T for names, values in rows.items()}  # (5, P)
    curves = [
        Curve(key, quantity, env_steps, centre, low, high, seeds.astype(int))
        for (quantity, key), (env_steps, centre, low, high, seeds) in tables.items()
        if quantity != _RAISE
    ]
    raises = {key: table[0] for (quantity, key), table in tables.items() if quantity == _RAISE}
    problems = [text for name, _, text in notes if name == "problem"]
    return LearningCurves(curves, raises, head["aggregate"], float(head["window"]), problems)
