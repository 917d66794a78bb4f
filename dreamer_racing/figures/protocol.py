"""Figures of the evaluation protocol and of the perception report, as PNG, PDF or SVG by the path's suffix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.evaluation.evaluate import CRASHES, FINISHED, Episode, Evaluation
from dreamer_racing.evaluation.protocol import CONDITIONS, MODES, Result, report_heading, results_table
from dreamer_racing.evaluation.sight import BIN_DEGREES, NEAREST_VISIBLE_GATE, Sight, SightResults, is_race_gate
from dreamer_racing.figures.drawing import (
    DASHED,
    INK,
    MUTED,
    draw_altitude,
    draw_flight,
    draw_speed_scale,
    draw_track,
    dress,
    from_zero,
    save,
    speed_scale,
)
from dreamer_racing.training.directory import RunDirectory

MODE_COLORS = {"deterministic": "#6f9be0", "stochastic": "#f2b705"}
CAUSE_COLORS = dict(
    zip(CRASHES, ("#e8590c", "#c2255c", "#7950f2", "#1fa2a6", "#495057", "#adb5bd", "#a0522d"), strict=True)
)
Z95 = 1.96  # half-width of the central 95 % of a normal distribution, in standard deviations
SIGHT_COLORS = ("#6f9be0", "#7bc043", "#c2255c")


class Bar(NamedTuple):
    """A mean, its 95 % interval, and the number of samples; with one sample the interval has zero width."""

    height: float
    low: float
    high: float
    n: int


def share_bar(happened: Sequence[bool]) -> Bar:
    """Return the share of true values with Wilson's interval, which keeps a positive width at shares of 0 and 1.

    Reference: Wilson, Probable inference, the law of succession, and statistical inference, 1927.
    """
    import scipy.stats  # takes a second; not needed in training

    low, high = scipy.stats.binomtest(sum(happened), len(happened)).proportion_ci(0.95, "wilson")
    return Bar(float(np.mean(happened)), float(low), float(high), len(happened))


def mean_bar(values: Sequence[float], height: float | None = None) -> Bar:
    """Return the mean of independent non-negative values, or another ``height``, with the mean's normal interval."""
    n, mean = len(values), float(np.mean(values)) if height is None else height
    half = Z95 * float(np.std(values, ddof=1)) / np.sqrt(n) if n > 1 else 0.0
    return Bar(mean, max(0.0, mean - half), mean + half, n)


def write_markdown(directory: Path, results: Sequence[Result], provenance: dict[str, Any]) -> None:
    """Write evaluation.md, the table of conditions, with its plots."""
    title = f"{provenance['algorithm']} on {provenance['track']}, {provenance['env_steps']:,} env_steps"
    into = RunDirectory(directory).plots
    plot_conditions(results, into / "conditions.png", title)
    presets = list(dict.fromkeys(result.preset for result in results))
    for preset in presets:
        flown = {r.mode: r.evaluation for r in results if r.preset == preset and r.condition == "nominal"}
        plot_crashes(flown, into / f"crashes_{preset}.png", f"{title}, nominal, {preset}")
    meanings = "\n".join(f"- `{condition.name}`: {condition.meaning}" for condition in CONDITIONS)
    names = ("conditions", *(f"crashes_{preset}" for preset in presets))
    plots = "\n\n".join(f"![{name}](plots/{name}.png)" for name in names)
    text = f"{report_heading(title, provenance)}\n{results_table(results)}\n{meanings}\n\n{plots}\n"
    (directory / "evaluation.md").write_text(text, encoding="utf-8")


def plot_conditions(results: Sequence[Result], path: str | Path, title: str) -> None:
    """Draw success rate and gates per episode of each condition, with one bar per mode of the policy."""
    places = list(dict.fromkeys((result.preset, result.condition) for result in results))
    figure = Figure(figsize=(max(9.0, 1.2 * len(places)), 6.4), layout="constrained")
    success, gates = figure.subplots(2, 1, sharex=True)
    for index, mode in enumerate(MODES):
        flown = {(r.preset, r.condition): _distinct(r.evaluation) for r in results if r.mode == mode}
        at = np.array([number + (index - 0.5) * 0.4 for number, place in enumerate(places) if place in flown])
        shown = [flown[place] for place in places if place in flown]
        finished = [share_bar([episode.outcome == FINISHED for episode in episodes]) for episodes in shown]
        passed = [mean_bar([episode.gates_passed for episode in episodes]) for episodes in shown]
        _draw_bars(success, at, finished, MODE_COLORS[mode], mode, "{:.0%}")
        _draw_bars(gates, at, passed, MODE_COLORS[mode], mode, "{:.2f}")
    _dress(success, "Success")
    _dress(gates, "Gates per episode")
    share_axis(success)
    from_zero(gates)
    gates.set_ylim(top=1.25 * gates.get_ylim()[1])
    labels = [f"{condition.replace('_', ' ')}\n{preset}" for preset, condition in places]
    gates.set_xticks(range(len(places)), labels, fontsize=8)
    success.legend(frameon=False, fontsize=8, ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.16))
    note = "Lines: 95 % intervals over n different flights (success: Wilson, mean gates: normal)."
    figure.supxlabel(note, x=0.01, ha="left", fontsize=8, color=MUTED)
    _save(figure, path, title)


def _distinct(evaluation: Evaluation) -> list[Episode]:
    """Return the distinct episodes; without randomness, all episodes on a track are the same flight."""
    return list({repr(episode): episode for episode in evaluation.episodes}.values())


def plot_crashes(flown: Mapping[str, Evaluation], path: str | Path, title: str) -> None:
    """Draw the number of crashes by next gate and cause, with one panel per evaluation on tracks of as many gates."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    panels = figure.subplots(1, len(flown), sharey=True, squeeze=False)[0]
    shown: set[str] = set()
    for axes, (name, evaluation) in zip(panels, flown.items(), strict=True):
        bottom = np.zeros(evaluation.num_gates)
        gates = np.arange(1, evaluation.num_gates + 1)
        for cause, counts in evaluation.crashes_by_gate.items():
            if not any(counts):
                continue
            label = None if cause in shown else cause.replace("_", " ")
            axes.bar(gates, counts, bottom=bottom, color=CAUSE_COLORS[cause], width=0.7, label=label)
            bottom += counts
            shown.add(cause)
        _dress(axes, f"{name}: {int(bottom.sum())} of {len(evaluation.episodes)} crashed")
        axes.set_xticks(gates)
        axes.set_xlim(0.4, evaluation.num_gates + 0.6)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("next gate at the crash")
    from_zero(panels[0])
    panels[0].set_ylabel("episodes")
    if shown:
        figure.legend(loc="outside lower center", ncols=len(shown), frameon=False, fontsize=8)
    _save(figure, path, title)


def plot_sight(looked: Mapping[str, SightResults], camera: Camera, path: str | Path, title: str) -> None:
    """Draw where the camera pointed, on tracks of one size: flights from above, angles, and shares of time in view.

    Results are given by their names, such as ``without decoys``.
    """
    columns, track = len(looked), next(iter(looked.values())).track
    width, depth = (high - low for low, high in zip(track.bounds_low[:2], track.bounds_high[:2], strict=True))
    map_height = min(6.5, 8.5 / columns * depth / width)
    rows = [map_height, 1.3, 2.4, 1.9]  # inches
    figure = Figure(figsize=(10.0, sum(rows) + 2.6), layout="constrained")
    grid = figure.add_gridspec(4, columns, height_ratios=rows)
    maps, profiles, below = ([figure.add_subplot(grid[row, column]) for column in range(columns)] for row in range(3))
    speed = speed_scale([results.trajectory for results in looked.values()])
    for axes, profile, (name, results) in zip(maps, profiles, looked.items(), strict=True):
        draw_track(axes, results.track)
        draw_flight(axes, results.trajectory, speed)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
        draw_altitude(profile, results.track, results.trajectory, speed)
    for axes in (*maps[1:], *profiles[1:]):
        axes.set_ylabel("")
    draw_speed_scale(figure, [*maps, *profiles], speed, "speed (m/s); arrows: camera")
    for axes, (name, results) in zip(below, looked.items(), strict=True):
        _draw_distributions(axes, name, results.sights, camera)
        axes.sharey(below[0])
    from_zero(below[0], least=0.01)
    below[0].set_ylabel("share of observations, per 5°")
    shares = {
        name: {thing: sight for thing, sight in results.sights.items() if not is_race_gate(thing)}
        for name, results in looked.items()
    }
    _draw_shares(figure.add_subplot(grid[3, :]), shares)
    _save(figure, path, title)


def _draw_distributions(axes: Axes, name: str, sights: Mapping[str, Sight], camera: Camera) -> None:
    edges = np.arange(0, 180 + BIN_DEGREES, BIN_DEGREES)
    single = {thing for thing in sights if thing.startswith("decoy ") or is_race_gate(thing)}  # left out
    drawn = {thing: sight for thing, sight in sights.items() if thing not in single}
    for color, (thing, sight) in zip(SIGHT_COLORS, drawn.items(), strict=False):
        axes.stairs(sight.histogram().numpy(), edges, color=color, label=thing, linewidth=1.6, fill=False)
    axes.axvline(camera.field_of_view / 2, color=MUTED, linewidth=1.0, linestyle=DASHED)
    _dress(axes, f"{name}: angle between camera axis and …")
    axes.set(xlim=(0, 180), xlabel="degrees; dashed: half the field of view")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[3, 6]))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(frameon=False, fontsize=8)


def _draw_shares(axes: Axes, flights: Mapping[str, Mapping[str, Sight]]) -> None:
    things = list(dict.fromkeys(thing for sights in flights.values() for thing in sights))
    width = 0.8 / len(flights)
    for index, (name, sights) in enumerate(flights.items()):
        at = [
            number + (index - (len(flights) - 1) / 2) * width for number, thing in enumerate(things) if thing in sights
        ]
        bars = [mean_bar(s.shares_by_flight, s.share_in_view) for s in (sights[t] for t in things if t in sights)]
        _draw_bars(axes, np.array(at), bars, SIGHT_COLORS[index], name, "{:.0%}", width)
    labels = ["any gate" if thing == NEAREST_VISIBLE_GATE else thing for thing in things]
    axes.set_xticks(range(len(things)), labels, fontsize=8)
    axes.set_xlim(-0.6, len(things) - 0.4)
    _dress(axes, "Share of time in view; lines: 95 % interval over n flights")
    share_axis(axes)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.22))


def share_axis(axes: Axes) -> None:
    """Set the axis to shares from 0 to 1, with room above for the bars' labels."""
    axes.set_ylim(0.0, 1.35)
    axes.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


def _draw_bars(
    axes: Axes, places: np.ndarray, bars: Sequence[Bar], color: str, label: str, form: str, width: float = 0.4
) -> None:
    """Draw bars with their intervals, and write value and n above."""
    heights = np.array([bar.height for bar in bars])
    ends = np.array([(bar.height - bar.low, bar.high - bar.height) for bar in bars]).clip(0.0).T  # (2, M)
    style: dict[str, Any] = {"ecolor": INK, "elinewidth": 1.2, "capsize": 2.5}
    axes.bar(places, heights, yerr=ends, error_kw=style, width=0.92 * width, color=color, label=label)
    for place, bar in zip(places, bars, strict=True):
        words = f"{form.format(bar.height)}\nn = {bar.n}"
        at = (place, bar.high)
        axes.annotate(words, at, (0, 3), textcoords="offset points", ha="center", va="bottom", fontsize=7, color=INK)


def _dress(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    dress(axes, "y")


def _save(figure: Figure, path: str | Path, title: str) -> None:
    figure.suptitle(title, x=0.02, ha="left", fontsize=11, color=INK)
    save(figure, path)
