"""Variants of an experiment side by side: what each came to over its seeds, as numbers and as a table.

Shapes: S seeds of a variant.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dreamer_racing.figures.curves import ENDS_EARLY, QUANTITIES
from dreamer_racing.figures.runs import AXES, REFERENCE, CurveKey, RunData, along, axis_of, group_runs
from dreamer_racing.training.clock import WALL_CLOCK

LAST_SHARE = 0.2  # of the longest run of an algorithm on a track: where its variants are compared
COMPARED = ("gates", "success_rate", "evaluation_return", "image_error")  # names out of `QUANTITIES`
COLUMNS = (*(QUANTITIES[name].column for name in COMPARED), *filter(None, (axis.clock for axis in AXES.values())))


@dataclass(frozen=True)
class VariantResult:
    """What the runs of one variant came to.

    Args:
        key: algorithm, track and variant.
        seeds: S, runs that reach the window.
        values: by name of ``COMPARED``, each run's mean over the window, (S,) or fewer where runs have no value there;
            without those that no run has logged.
        window: first and last place on the axis of what was averaged, common to all variants of the algorithm on the
            track.
        wall_clock: s, mean of these runs; None if none recorded it.
    """

    key: CurveKey
    seeds: int
    values: dict[str, np.ndarray]
    window: tuple[float, float]
    wall_clock: float | None

    @property
    def name(self) -> str:
        """Of the variant; settings in it are spelt as one gives them."""
        name = self.key.variant or REFERENCE
        return name if "=" in name else name.replace("_", " ")


@dataclass(frozen=True)
class Comparison:
    """What a table or a picture of variants shows."""

    results: list[VariantResult]
    problems: list[str]
    """What was left out, a line each."""
    axis: str = "env_steps"
    """Along what runs were compared, one of `AXES`."""

    @property
    def caption(self) -> str:
        """What the numbers are."""
        of = f"{self.axis} that every variant has had" if axis_of(self.axis).clock else "longest run's env_steps"
        return (
            "Mean ± sample standard deviation (n − 1) over seeds, each the mean of what it logged within the last "
            f"{100 * LAST_SHARE:.0f} % of the {of}. Evaluations are paid at b₂ = 0."
        )


def compare_variants(runs: Sequence[RunData], problems: Sequence[str] = (), axis: str = "env_steps") -> Comparison:
    """Average the ends of runs over the seeds of each variant; the reference comes first, then by name.

    Variants of one algorithm on one track are averaged over the same part of the axis: up to the env_steps of the
    longest run, or up to the time that every variant has had, so that none is judged by more of it than another.

    Args:
        runs: of any algorithms and tracks.
        problems: what was left out already.
        axis: one of `AXES`.

    Raises:
        ValueError: there are no runs, or those of one variant were not configured alike.
    """
    runs, without_clock = along(runs, axis)
    if not runs:
        raise ValueError("; ".join(without_clock) or "there is no run to compare.")
    groups = group_runs(runs)
    ends: dict[tuple[str, str], list[float]] = defaultdict(list)  # of the longest run of each variant
    for key, group in groups.items():
        ends[key[:2]].append(max(map(_end, group)))
    found = [*problems, *without_clock, *_short_windows(ends, axis)]
    results = []
    for key, group in groups.items():
        last = min(ends[key[:2]]) if axis_of(axis).clock else max(ends[key[:2]])
        first = (1 - LAST_SHARE) * last
        found += [_ends_early(run, first, last, axis) for run in group if _end(run) < ENDS_EARLY * last]
        results.append(_result(key, [run for run in group if _end(run) >= first], (first, last)))
    order = sorted(results, key=lambda result: (result.key[:2], not result.key.is_reference, result.key))
    return Comparison(order, found, axis)


def _end(run: RunData) -> float:
    return float(run.metrics.env_steps.max(initial=0.0))


def _short_windows(ends: Mapping[tuple[str, str], Sequence[float]], axis: str) -> list[str]:
    """Mention where variants are compared long before the longest of them ends, since one of them has had no more."""
    if not axis_of(axis).clock:
        return []
    form = axis_of(axis).form
    return [
        f"{algorithm} {track}: compared up to {min(last):{form}} {axis}, where the first variant ends, "
        f"of {max(last):{form}}"
        for (track, algorithm), last in ends.items()
        if min(last) < ENDS_EARLY * max(last)
    ]


def _ends_early(run: RunData, first: float, last: float, axis: str) -> str:
    form = axis_of(axis).form
    what = "left out" if _end(run) < first else "it counts as far as it goes"
    return f"{run.name} ends at {_end(run):{form}} {axis}, compared are {first:{form}} to {last:{form}}: {what}"


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
    """Write the results as Markdown; an empty cell was not measured, and one with fewer seeds than its row says so."""
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
