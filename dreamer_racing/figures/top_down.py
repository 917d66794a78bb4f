"""Figures of one flight from above, with its altitude and, if gates differ in height, a side view; and of tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import (
    BADGE,
    BOX,
    GATE_COLOR,
    INK,
    draw_flight,
    draw_speed_scale,
    draw_track,
    dress_map,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.figures.profiles import altitude_legend, draw_altitude

HEIGHT_SPREAD = 0.5  # m between gates, above which a side view is drawn
PROFILE_HEIGHT = 1.5  # height of the altitude panel, inches
COLUMNS = 3  # of several tracks
CELL = (5.0, 5.6)  # width and height per track, inches


def plot_top_down(track: Track, trajectory: Trajectory, path: str | Path) -> None:
    """Draw a track and the path of one episode from above, its altitude, and a side view if gates differ in height.

    Gates are bars with arrows in the direction of flight and their number in the order of flight; black arrows along
    the path are the camera's direction, as in the paper's figure of perception-aware flight.
    """
    figure, axes, side, altitude = _layout(track)
    speed = speed_scale([trajectory])
    draw_track(axes, track)
    draw_flight(axes, trajectory, speed)
    if side is not None:
        draw_track_side(side, track)
        draw_flight(side, trajectory, speed, plane=(0, 2))
    draw_altitude(altitude, track, trajectory, speed, over="time")
    draw_speed_scale(figure, figure.axes, speed)
    top = float(np.nanmax(trajectory.speed.numpy()))
    title = f"{track.name}: {trajectory.duration:.2f} s, up to {top:.1f} m/s ({trajectory.ending})"
    axes.set_title(title, loc="left", fontsize=11, color=INK, pad=8)
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


def plot_tracks(tracks: Sequence[Track], path: str | Path) -> None:
    """Draw each track from above and from the side, with gate numbers and the direction of flight.

    Raises:
        ValueError: there is no track.
    """
    if not tracks:
        raise ValueError("There is no track to draw: give at least one.")
    columns = min(len(tracks), COLUMNS)
    rows = math.ceil(len(tracks) / columns)
    figure = Figure(figsize=(CELL[0] * columns, CELL[1] * rows), layout="constrained")
    cells = figure.subfigures(rows, columns, squeeze=False).flat
    for cell, track in zip(cells, tracks, strict=False):  # the last row may have empty cells
        _, depth, height = (high - low for low, high in zip(track.bounds_low, track.bounds_high, strict=True))
        above, side = cell.subplots(2, 1, sharex=True, height_ratios=[depth, height])
        draw_track(above, track)
        above.set_xlabel("")
        draw_track_side(side, track)
        title = f"{track.name}: {track.num_gates} gates, {sum(track.gate_distances):.1f} m"
        cell.suptitle(title, x=0.02, ha="left", fontsize=11, color=INK)  # not a title of the map, whose height varies
    save(figure, path)
