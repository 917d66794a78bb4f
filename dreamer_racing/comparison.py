"""Variants of an experiment side by side: what each came to over its seeds, as a table and as a picture.

Shapes: S seeds of a variant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dreamer_racing.plotting import FAINT, INK, MUTED, save
from dreamer_racing.runs import CurveKey, RunData, group_runs

REFERENCE = "default"  # the variant that the others are compared with
LAST_SHARE = 0.2  # of a run: what is averaged
COLUMNS = {
    "gates": ("Gates per evaluation", "evaluation/gates_per_episode"),
    "success": ("Success rate", "evaluation/success_rate"),
    "return": ("Return in training", "episode/return"),
    "image": ("Image error", "held_out/image_error"),
}
"""What is compared: heading, and column of ``metrics.csv``."""
DRAWN = ("gates", "return")
OTHER_COLOR = "#74c0fc"
WALL_CLOCK = "wall_clock"  # column: s since the run began


@dataclass(frozen=True)
class VariantResult:
    """What the runs of one variant came to.

    Args:
        key: algorithm, track and variant.
        values: by name of ``COLUMNS``, each run's mean over the last fifth of it, (S,); without those that no run has.
        env_steps: of the shortest run.
        wall_clock: s, mean of the runs; None if none recorded it.
    """

    key: CurveKey
    values: dict[str, np.ndarray]
    env_steps: int
    wall_clock: float | None

    @property
    def name(self) -> str:
        """Of the variant."""
        return (self.key.variant or REFERENCE).replace("_", " ")


def compare_variants(runs: Sequence[RunData]) -> list[VariantResult]:
    """Average the ends of runs over the seeds of each variant; the reference comes first, then by name.

    Raises:
        ValueError: there are no runs, or those of one variant were not configured alike.
    """
    if not runs:
        raise ValueError("there is no run to compare.")
    results = [_result(key, group) for key, group in group_runs(runs).items()]
    return sorted(results, key=lambda result: (result.key[:2], result.key.variant not in ("", REFERENCE), result.key))


def _result(key: CurveKey, group: Sequence[RunData]) -> VariantResult:
    ends = {name: [_end(run, column) for run in group] for name, (_, column) in COLUMNS.items()}
    values = {name: np.array([value for value in found if value is not None]) for name, found in ends.items()}
    clocks = [run.metrics.columns[WALL_CLOCK][1][-1] for run in group if WALL_CLOCK in run.metrics.columns]
    return VariantResult(
        key,
        {name: found for name, found in values.items() if len(found)},
        int(min(run.metrics.env_steps[-1] for run in group)),
        float(np.mean(clocks)) if clocks else None,
    )


def _end(run: RunData, column: str) -> float | None:
    """Average a column over the last fifth of a run; None if there is nothing."""
    if column not in run.metrics.columns:
        return None
    steps, values = run.metrics.columns[column]
    late = values[steps >= (1 - LAST_SHARE) * run.metrics.env_steps[-1]]
    return float(late.mean()) if len(late) else float(values[-1])


def comparison_table(results: Sequence[VariantResult]) -> str:
    """Write the results as Markdown: mean ± standard deviation over seeds; an empty cell was not measured."""
    shown = [name for name in COLUMNS if any(name in result.values for result in results)]
    headings = [
        "algorithm",
        "track",
        "variant",
        "seeds",
        "env_steps",
        *(COLUMNS[name][0] for name in shown),
        "wall clock",
    ]
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for result in results:
        seeds = max((len(values) for values in result.values.values()), default=0)
        clock = "" if result.wall_clock is None else f"{result.wall_clock / 60:.1f} min"
        cells = [result.key.algorithm, result.key.track, result.name, str(seeds), f"{result.env_steps:,}"]
        cells += [_cell(result.values.get(name)) for name in shown]
        lines.append(f"| {' | '.join([*cells, clock])} |")
    return "\n".join([*lines, ""])


def _cell(values: np.ndarray | None) -> str:
    if values is None:
        return ""
    spread = f" ± {values.std(ddof=1):.3g}" if len(values) > 1 else ""
    return f"{values.mean():.3g}{spread}"


def plot_comparison(results: Sequence[VariantResult], path: str | Path) -> None:
    """Draw a bar a variant, its standard deviation over seeds, and a dot a seed; the reference is a dashed line.

    Args:
        results: of `compare_variants`.
        path: the file to write; missing folders are made.
    """
    shown = [name for name in DRAWN if any(name in result.values for result in results)]
    several = len({result.key[:2] for result in results}) > 1
    figure = Figure(figsize=(3.0 + 3.4 * len(shown), 1.1 + 0.34 * len(results)), layout="constrained")
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    places = np.arange(len(results))
    for axes, name in zip(panels, shown, strict=True):
        for place, result in zip(places, results, strict=True):
            values = result.values.get(name)
            if values is None:
                continue
            reference = result.key.variant in ("", REFERENCE)
            error = values.std(ddof=1) if len(values) > 1 else 0.0
            axes.barh(
                place, values.mean(), xerr=error, color=INK if reference else "#74c0fc", ecolor=MUTED, height=0.65
            )
            axes.plot(values, np.full(len(values), place), "o", color="white", markeredgecolor=INK, markersize=4)
            if reference and not several:
                axes.axvline(values.mean(), color=INK, linestyle=(0, (4, 3)), linewidth=0.9)
        axes.set_title(COLUMNS[name][0], loc="left", fontsize=10, color=INK)
        axes.grid(axis="x", color=FAINT, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(colors=MUTED, labelsize=9, length=0)
        axes.spines[:].set_visible(False)
    names = [" ".join([*(result.key[:2][::-1] if several else ()), result.name]) for result in results]
    panels[0].set_yticks(places, names)
    panels[0].invert_yaxis()
    save(figure, path)
