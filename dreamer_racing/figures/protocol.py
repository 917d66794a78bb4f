"""Pictures of the evaluation protocol and of the perception report: PNG, PDF or SVG by the path's suffix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.evaluate import CRASHES, Evaluation, Trajectory
from dreamer_racing.evaluation.protocol import MODES, Result
from dreamer_racing.evaluation.sight import BIN_DEGREES, NEAREST_VISIBLE_GATE, Sight
from dreamer_racing.figures.drawing import FAINT, INK, MUTED, SPEED_COLORS, draw_flight, draw_track, save, speed_scale

MODE_COLORS = {"deterministic": "#2f5fb3", "stochastic": "#f2b705"}
CAUSE_COLORS = dict(
    zip(CRASHES, ("#e8590c", "#c2255c", "#7950f2", "#1fa2a6", "#495057", "#adb5bd", "#a0522d"), strict=True)
)
SIGHT_COLORS = ("#2f5fb3", "#7bc043", "#c2255c")


def plot_conditions(results: Sequence[Result], path: str | Path, title: str | None = None) -> None:
    """Draw success and gates per episode of each condition, a bar for each mode of the policy.

    Args:
        results: of the protocol.
        path: the file to write; missing folders are made.
        title: above the picture.
    """
    places = list(dict.fromkeys((result.preset, result.condition) for result in results))
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    success, gates = figure.subplots(2, 1, sharex=True)
    panels = (
        (success, "Success", "success_rate", "{:.0%}"),
        (gates, "Gates per episode", "gates_per_episode", "{:.2f}"),
    )
    for axes, name, value, form in panels:
        for index, mode in enumerate(MODES):
            own = {(r.preset, r.condition): getattr(r.evaluation, value) for r in results if r.mode == mode}
            heights = [own.get(place, np.nan) for place in places]
            _draw_bars(axes, np.arange(len(places)) + (index - 0.5) * 0.4, heights, MODE_COLORS[mode], mode, form=form)
        _dress(axes, name)
    success.set_ylim(0.0, 1.05)
    success.yaxis.set_major_formatter(PercentFormatter(1.0))
    labels = [f"{condition.replace('_', ' ')}\n{preset}" for preset, condition in places]
    gates.set_xticks(range(len(places)), labels, fontsize=8)
    success.legend(frameon=False, fontsize=8, ncols=2, loc="upper right", bbox_to_anchor=(1.0, 1.18))
    _save(figure, path, title)


def plot_crashes(flown: Mapping[str, Evaluation], path: str | Path, title: str | None = None) -> None:
    """Draw on the way to which gate episodes crashed, and by which cause: a panel for each evaluation.

    Args:
        flown: evaluations by name, on tracks with the same number of gates.
        path: the file to write; missing folders are made.
        title: above the picture.
    """
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
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("next gate at the crash")
    panels[0].set_ylabel("episodes")
    if shown:
        figure.legend(loc="outside lower center", ncols=len(shown), frameon=False, fontsize=8)
    _save(figure, path, title)


def plot_sight(
    flights: Mapping[str, tuple[Track, Trajectory, Mapping[str, Sight]]],
    camera: Camera,
    path: str | Path,
    title: str | None = None,
) -> None:
    """Draw where the camera looked: flights from above, distributions of angles, and shares of time in view.

    Args:
        flights: by name (``without decoys``), on tracks of one size: the track, one flight, and the sights of all.
        camera: the nose camera.
        path: the file to write; missing folders are made.
        title: above the picture.
    """
    columns, track = len(flights), next(iter(flights.values()))[0]
    width, depth = (high - low for low, high in zip(track.bounds_low[:2], track.bounds_high[:2], strict=True))
    map_height = min(6.5, 8.5 / columns * depth / width)
    figure = Figure(figsize=(10.0, map_height + 5.4), layout="constrained")
    rows = figure.subfigures(3, 1, squeeze=False, height_ratios=[map_height + 0.4, 2.8, 2.2])
    maps, distributions, shares = rows[:, 0]
    _draw_maps(maps, flights, camera)
    panels = distributions.subplots(1, columns, sharey=True, squeeze=False)[0]
    for axes, (name, (_, _, sights)) in zip(panels, flights.items(), strict=True):
        _draw_distributions(axes, name, sights, camera)
    panels[0].set_ylabel("share of observations, per 5°")
    _draw_shares(shares.subplots(), {name: sights for name, (_, _, sights) in flights.items()})
    _save(figure, path, title)


def _draw_maps(
    figure: Figure, flights: Mapping[str, tuple[Track, Trajectory, Mapping[str, Sight]]], camera: Camera
) -> None:
    panels = figure.subplots(1, len(flights), squeeze=False)[0]
    speed = speed_scale([trajectory for _, trajectory, _ in flights.values()])
    for axes, (name, (track, trajectory, _)) in zip(panels, flights.items(), strict=True):
        draw_track(axes, track)
        draw_flight(axes, trajectory, speed, tilt=camera.tilt)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
    bar = figure.colorbar(ScalarMappable(speed, SPEED_COLORS), ax=list(panels), shrink=0.8, aspect=30)
    bar.set_label("speed (m/s); arrows: camera", fontsize=8)
    bar.outline.set_visible(False)


def _draw_distributions(axes: Axes, name: str, sights: Mapping[str, Sight], camera: Camera) -> None:
    edges = np.arange(0, 180 + BIN_DEGREES, BIN_DEGREES)
    drawn = {thing: sight for thing, sight in sights.items() if not thing.startswith("decoy ")}  # any decoy is enough
    for color, (thing, sight) in zip(SIGHT_COLORS, drawn.items(), strict=False):
        axes.stairs(sight.histogram().numpy(), edges, color=color, label=thing, linewidth=1.6, fill=False)
    axes.axvline(camera.field_of_view / 2, color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
    _dress(axes, f"{name}: angle between camera axis and …")
    axes.set(xlim=(0, 180), xlabel="degrees; dashed: half the field of view")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[3, 6]))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(frameon=False, fontsize=8)


def _draw_shares(axes: Axes, flights: Mapping[str, Mapping[str, Sight]]) -> None:
    things = list(dict.fromkeys(thing for sights in flights.values() for thing in sights))
    width = 0.8 / len(flights)
    for index, (name, sights) in enumerate(flights.items()):
        heights = [sights[thing].share_in_view if thing in sights else np.nan for thing in things]
        places = np.arange(len(things)) + (index - (len(flights) - 1) / 2) * width
        _draw_bars(axes, places, heights, SIGHT_COLORS[index], name, width, "{:.0%}")
    labels = ["any gate" if thing == NEAREST_VISIBLE_GATE else thing for thing in things]
    axes.set_xticks(range(len(things)), labels, fontsize=8)
    axes.set_ylim(0.0, 1.1)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    _dress(axes, "Share of time in view")
    axes.legend(frameon=False, fontsize=8)


def _draw_bars(
    axes: Axes,
    places: np.ndarray,
    heights: Sequence[float],
    color: str,
    label: str,
    width: float = 0.4,
    form: str = "{:.2g}",
) -> None:
    """Draw bars with their values above them; NaN draws nothing."""
    axes.bar(places, heights, width=0.92 * width, color=color, label=label)
    for place, height in zip(places, heights, strict=True):
        if np.isfinite(height):
            axes.text(place, height, form.format(height), ha="center", va="bottom", fontsize=7, color=INK)


def _dress(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.tick_params(colors=MUTED, labelsize=8, length=0)
    axes.spines[:].set_visible(False)


def _save(figure: Figure, path: str | Path, title: str | None) -> None:
    if title:
        figure.suptitle(title, x=0.02, ha="left", fontsize=11, color=INK)
    save(figure, path)
