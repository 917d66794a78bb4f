"""Comparison of an experiment's variants: results aggregated over S seeds each, as numbers and as a table."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dreamer_racing.figures.curves import ENDS_EARLY, QUANTITIES
from dreamer_racing.figures.runs import AXES, REFERENCE, CurveKey, RunData, along, axis_of, group_runs
from dreamer_racing.training.metrics import WALL_CLOCK

LAST_SHARE = 0.2  # length of the final window in which variants are compared, as a share of its end
COMPARED = ("gates", "success_rate", "evaluation_return", "image_error")  # names in `QUANTITIES`
COLUMNS = (*(QUANTITIES[name].column for name in COMPARED), *filter(None, (axis.clock for axis in AXES.values())))


@dataclass(frozen=True)
class VariantResult:
    """Results of the runs of one variant."""

    key: CurveKey
    seeds: int  # S, number of runs that reach the window
    values: dict[str, np.ndarray]
    """Each run's mean over the window, by name in `COMPARED`, if any has logged it: (S,), or fewer without a value."""
    window: tuple[float, float]  # on the axis, common to all variants of the algorithm on the track
    wall_clock: float | None  # mean duration of these runs, s; None if no run recorded it

    @property
    def name(self) -> str:
        """Display name, with spaces for underscores except in settings."""
        name = self.key.variant or REFERENCE
        return name if "=" in name else name.replace("_", " ")


@dataclass(frozen=True)
class Comparison:
    """Content of a table or figure of variants."""

    results: list[VariantResult]
    problems: list[str]  # a line for everything left out
    axis: str = "env_steps"  # one of `AXES`

    @property
    def caption(self) -> str:
        """Explanation of the numbers."""
        of = f"{self.axis} that every variant reached" if axis_of(self.axis).clock else "longest run's env_steps"
        return (
            "Mean ± sample standard deviation (n − 1) over seeds, each the mean of what it logged within the last "
            f"{100 * LAST_SHARE:.0f} % of the {of}. Evaluations use rewards with b₂ = 0."
        )


def compare_variants(runs: Sequence[RunData], problems: Sequence[str] = (), axis: str = "env_steps") -> Comparison:
    """Average runs over a final window and the seeds of each variant, sorted with the reference first, then by name.

    The window is the same for all variants of an algorithm on a track. It ends at the env_steps of the longest run, or
    on a time axis at the time that every variant has reached, so that no variant has more time than another.

    Raises:
        ValueError: there are no runs, or two runs of one variant have the same seed.
    """
    runs, without_clock = along(runs, axis)
    if not runs:
        raise ValueError("; ".join(without_clock) or "there is no run to compare.")
    groups = group_runs(runs)
    ends: dict[tuple[str, str], list[float]] = defaultdict(list)  # of the longest run of each variant
    for key, group in groups.items():
        ends[key[:2]].append(max(map(_end, group)))
    form, timed = axis_of(axis).form, axis_of(axis).clock is not None
    found = [*problems, *without_clock]
    found += [
        f"{algorithm} {track}: compared up to {min(last):{form}} {axis}, where the shortest variant ends, "
        f"of {max(last):{form}}"
        for (track, algorithm), last in ends.items()
        if timed and min(last) < ENDS_EARLY * max(last)
    ]
    results = []
    for key, group in groups.items():
        last = min(ends[key[:2]]) if timed else max(ends[key[:2]])
        first = (1 - LAST_SHARE) * last
        found += [
            f"{run.name} ends at {_end(run):{form}} {axis}, but {first:{form}} to {last:{form}} are compared: "
            + ("left out" if _end(run) < first else "used up to its end")
            for run in group
            if _end(run) < ENDS_EARLY * last
        ]
        results.append(_result(key, [run for run in group if _end(run) >= first], (first, last)))
    order = sorted(results, key=lambda result: (result.key[:2], not result.key.is_reference, result.key))
    return Comparison(order, found, axis)


def _end(run: RunData) -> float:
    return float(run.metrics.env_steps.max(initial=0.0))


def _result(key: CurveKey, group: Sequence[RunData], window: tuple[float, float]) -> VariantResult:
    first, last = window
    values = {}
    for name in COMPARED:
        column = QUANTITIES[name].column
        tables = [run.metrics.columns[column] for run in group if column in run.metrics.columns]
        late = [found[(steps >= first) & (steps <= last)] for steps, found in tables]
        if tables:
            values[name] = np.array([found.mean() for found in late if len(found)])
    clocks = [run.metrics.columns[WALL_CLOCK][1][-1] for run in group if WALL_CLOCK in run.metrics.columns]
    return VariantResult(key, len(group), values, window, float(np.mean(clocks)) if clocks else None)


def comparison_table(comparison: Comparison) -> str:
    """Return a Markdown table; empty cells were not measured, and cells with fewer seeds than their row give n."""
    results = comparison.results
    shown = [name for name in COMPARED if any(name in result.values for result in results)]
    labels = [QUANTITIES[name].label for name in shown]
    headings = ["algorithm", "track", "variant", "seeds", comparison.axis, *labels, "wall clock"]
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    form = axis_of(comparison.axis).form
    for result in results:
        clock = "" if result.wall_clock is None else f"{result.wall_clock / 60:.1f} min"
        window = "–".join(f"{place:{form}}" for place in result.window)
        cells = [result.key.algorithm, result.key.track, result.name, str(result.seeds), window]
        cells += [_cell(result.values.get(name, np.empty(0)), result.seeds) for name in shown]
        lines.append(f"| {' | '.join([*cells, clock])} |")
    lines += ["", comparison.caption]
    if comparison.problems:
        lines += ["", *(f"- {problem}" for problem in comparison.problems)]
    return "\n".join([*lines, ""])


def _cell(values: np.ndarray, seeds: int) -> str:
    if not len(values):
        return ""
    spread = f" ± {values.std(ddof=1):.3g}" if len(values) > 1 else ""
    count = "" if len(values) == seeds else f" (n = {len(values)})"
    return f"{values.mean():.3g}{spread}{count}"
