"""Figure of one flight from above, with its altitude and, if gates differ in height, a side view."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import (
    BADGE,
    BOX,
    GATE_COLOR,
    INK,
    SPEED_COLORS,
    draw_flight,
    draw_track,
    dress_map,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.figures.profiles import altitude_legend, draw_altitude

HEIGHT_SPREAD = 0.5  # m between gates, above which a side view is drawn
PROFILE_HEIGHT = 1.5  # height of the altitude panel, inches


def plot_top_down(track: Track, trajectory: Trajectory, path: str | Path, title: str | None = None) -> None:
    """Draw a track and the path of one episode from above, its altitude, and a side view if gates differ in height.

    Gates are bars with arrows in the direction of flight and their number in the order of flight; black arrows along
    the path are the camera's direction, as in the paper's figure of perception-aware flight.

    Args:
        track: the track.
        trajectory: the path, coloured by speed.
        path: the file to write; missing folders are created.
        title: title of the figure; None for the track's name, and the episode's duration, top speed and outcome.
    """
    figure, axes, side, altitude = _layout(track)
    speed = speed_scale([trajectory])
    draw_track(axes, track)
    draw_flight(axes, trajectory, speed)
    if side is not None:
        draw_track_side(side, track)
        draw_flight(side, trajectory, speed, plane=(0, 2))
    draw_altitude(altitude, track, trajectory, speed, over="time")
    bar = figure.colorbar(ScalarMappable(speed, SPEED_COLORS), ax=figure.axes, shrink=0.6, aspect=35, pad=0.01)
    bar.set_label("speed (m/s)")
    bar.outline.set_visible(False)
    axes.set_title(title or _title(track, trajectory), loc="left", fontsize=11, color=INK, pad=8)
    handles = flight_legend(bool(track.decoys), trajectory.crashed) + altitude_legend([(track, trajectory)])
    figure.legend(handles=handles, loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    save(figure, path)


def _layout(track: Track) -> tuple[Figure, Axes, Axes | None, Axes]:
    """Create a figure 9 inches wide with map and optional side view, both to the track's scale, and altitude."""
    width, depth, height = (high - low for low, high in zip(track.bounds_low, track.bounds_high, strict=True))
    heights = [gate.position[2] for gate in track.gates]
    metres = [depth, height] if max(heights) - min(heights) > HEIGHT_SPREAD else [depth]
    rows = [7.6 / width * size for size in metres] + [PROFILE_HEIGHT]  # inches
    figure = Figure(figsize=(9.0, sum(rows) + 0.6 * len(rows) + 0.9), layout="constrained")
    axes, *side, altitude = figure.subplots(len(rows), 1, height_ratios=rows)
    return figure, axes, side[0] if side else None, altitude


def draw_track_side(axes: Axes, track: Track) -> None:
    """Draw a track from the side (x–z plane) with numbered gates, each as the outline of its frame."""
    (x_low, _, z_low), (x_high, _, z_high) = track.bounds_low, track.bounds_high
    axes.add_patch(Rectangle((x_low, z_low), x_high - x_low, z_high - z_low, **BOX))
    outer = track.shape.outer
    labels: list[tuple[float, float]] = []
    for number, gate in enumerate(track.gates, start=1):
        width = max(outer * abs(gate.left[0]), 0.15)
        x, _, z = gate.position
        corner = (x - width / 2, z - outer / 2)
        axes.add_patch(Rectangle(corner, width, outer, fill=False, edgecolor=GATE_COLOR, linewidth=2.0, zorder=4))
        while any(math.dist((x, z), label) < 0.6 for label in labels):
            z += 0.3  # above the number of another gate at the same place
        labels.append((x, z))
        axes.text(x, z, str(number), ha="center", va="center", fontsize=9, color=INK, bbox=BADGE, zorder=7)
    axes.set(xlabel="x (m)", ylim=(min(z_low, 0.0) - 0.2, z_high + 0.2))
    dress_map(axes, "z (m)")


def _title(track: Track, trajectory: Trajectory) -> str:
    seconds = (len(trajectory.position) - 1) * trajectory.control_dt
    top = float(np.nanmax(trajectory.speed.numpy()))
    outcome = (trajectory.outcome or "recording stopped").replace("_", " ")
    return f"{track.name}: {seconds:.2f} s, up to {top:.1f} m/s ({outcome})"
