"""Figures of tracks, of flights, alone and side by side, and of a world model's dreams, without a simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import (
    BADGE,
    BOX,
    GATE_COLOR,
    INK,
    altitude_legend,
    draw_altitude,
    draw_flight,
    draw_speed,
    draw_speed_scale,
    draw_track,
    dress_map,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR, STRIP_FRAMES, film_strip, shown_frames

COLUMNS = 3  # of several flights or tracks
CELL = (5.0, 5.6)  # width and height per track, inches
HEIGHT_SPREAD = 0.5  # m between gates, above which a side view is drawn
ALTITUDE_HEIGHT = 1.5  # of the panel below a single flight, inches
TITLE_ROOM = 0.35  # space above the panels, inches
PROFILE_HEIGHT = 1.3  # height of a profile, inches


def plot_top_down(track: Track, trajectory: Trajectory, path: str | Path) -> None:
    """Draw a track and the path of one episode from above, its altitude, and a side view if gates differ in height.

    Black arrows along the path are the camera's direction, as in the paper's figure of perception-aware flight.
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
    rows = [7.6 / width * size for size in metres] + [ALTITUDE_HEIGHT]  # inches
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
    axes.set(xlabel="x (m)", ylabel="z (m)", ylim=(min(z_low, 0.0) - 0.2, z_high + 0.2))
    dress_map(axes)


def plot_tracks(tracks: Sequence[Track], path: str | Path) -> None:
    """Draw each track from above and from the side, with gate numbers and the direction of flight."""
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


class NamedFlight(NamedTuple):
    """A recorded episode with its title and track."""

    title: str
    track: Track
    trajectory: Trajectory


def plot_flights(
    flights: Sequence[NamedFlight], path: str | Path, over: str = "distance", problems: Sequence[str] = ()
) -> None:
    """Draw flights from above side by side, at one scale, with the camera's direction; altitude and speed below.

    Reference: paper, Figs. "emergent" (with decoys and without) and "real world" (simulated and real).

    Profiles are over an axis of `PROFILE_AXES`. ``problems`` are lines for everything left out.
    """
    columns = min(COLUMNS, len(flights))
    rows = math.ceil(len(flights) / columns)
    halls = [np.subtract(flight.track.bounds_high, flight.track.bounds_low) for flight in flights]
    half = np.max(halls, axis=0)[:2] / 2  # m
    top = 4.4 * half[1] / half[0]  # inches
    width, height = 4.6 * columns + 0.7, rows * (top + 2 * PROFILE_HEIGHT + 0.9) + 0.5 + TITLE_ROOM
    figure = Figure(figsize=(width, height))
    # The layout reserves no space for titles of panels with a fixed aspect ratio.
    figure.set_layout_engine(ConstrainedLayoutEngine(rect=(0, 0, 1, 1 - TITLE_ROOM / height)))
    grid = figure.add_gridspec(3 * rows, columns, height_ratios=[top, PROFILE_HEIGHT, PROFILE_HEIGHT] * rows)
    speed = speed_scale([flight.trajectory for flight in flights])
    panels: list[Axes] = []
    for index, flight in enumerate(flights):
        row, column = divmod(index, columns)
        own = [figure.add_subplot(grid[3 * row + place, column]) for place in range(3)]
        _draw_flight_and_profiles(own, flight, speed, half, over)
        for axes in own if column else ():
            axes.set_ylabel("")
        panels += own
    draw_speed_scale(figure, panels, speed)
    decoys, crash = any(f.track.decoys for f in flights), any(f.trajectory.crashed for f in flights)
    handles = flight_legend(decoys, crash) + altitude_legend([flight[1:] for flight in flights])
    figure.legend(handles=handles, loc="outside lower left", ncols=3 if columns == 1 else 8, frameon=False, fontsize=9)
    save(figure, path, problems)


def _draw_flight_and_profiles(
    panels: Sequence[Axes], flight: NamedFlight, speed: Normalize, half: np.ndarray, over: str
) -> None:
    """Draw a map that extends ``half`` (x, y), m, from the hall's middle to each side; below it altitude and speed."""
    axes, altitude, profile = panels
    draw_track(axes, flight.track)
    draw_flight(axes, flight.trajectory, speed)
    middle = [(low + high) / 2 for low, high in zip(flight.track.bounds_low, flight.track.bounds_high, strict=True)]
    axes.set_xlim(middle[0] - 1.03 * half[0], middle[0] + 1.03 * half[0])
    axes.set_ylim(middle[1] - 1.03 * half[1], middle[1] + 1.03 * half[1])
    flown = f"{flight.trajectory.gates_passed} gates in {flight.trajectory.duration:.2f} s ({flight.trajectory.ending})"
    axes.set_title(f"{flight.title}\n{flight.track.name}: {flown}", loc="left", fontsize=9, color=INK)
    draw_altitude(altitude, flight.track, flight.trajectory, speed, over, numbers=False)
    draw_speed(profile, flight.trajectory, speed, over)
    altitude.set_xlabel("")


def plot_dreams(dreams: Sequence[tuple[str, Dream]], path: str | Path, problems: Sequence[str] = ()) -> None:
    """Draw real, reconstructed and imagined observations of named stages of training, the first window of each.

    Reference: paper, Fig. "imagined".
    """
    figure = Figure(figsize=(1.4 + 1.15 * STRIP_FRAMES, 4.0 * len(dreams) + 0.3), layout="compressed")
    panels = figure.subplots(len(dreams), 1, squeeze=False)[:, 0]
    for axes, (name, dream) in zip(panels, dreams, strict=True):
        frames = shown_frames(dream)
        strip = film_strip(dream, frames)
        axes.imshow(strip, interpolation="nearest")
        height, width = strip.shape[0] / 3, strip.shape[1] / len(frames)
        times = [f"{(frame - dream.context + 1) * dream.frame_dt:+.2f} s" for frame in frames]
        axes.set_xticks([(index + 0.5) * width for index in range(len(frames))], times)
        by_model = "{0},\nseen from the\ndecoded pose" if dream.from_pose else "{0}"
        rows = ["real", by_model.format("reconstructed"), by_model.format("imagined")]
        axes.set_yticks([(index + 0.5) * height for index in range(3)], rows)
        axes.tick_params(
            length=0, labelsize=8, labelcolor=INK, top=True, labeltop=True, bottom=False, labelbottom=False
        )
        axes.spines[:].set_visible(False)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
    square: dict[str, Any] = {"marker": "s", "linestyle": "", "markersize": 7}
    labels = "the model has seen this image", "predicted from actions alone, from 0 s on"
    handles = [
        Line2D([], [], color=tuple(np.divide(color, 255)), label=label, **square)
        for color, label in zip((CONTEXT_COLOR, OPEN_LOOP_COLOR), labels, strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2, frameon=False, fontsize=9)
    save(figure, path, problems)
