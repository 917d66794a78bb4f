"""Drawing of races of K control steps, as PNG, PDF or SVG by the path's suffix, without pyplot's global state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator

from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Gate, Track
from dreamer_racing.evaluation.trajectory import Trajectory

Style = dict[str, Any]
"""Options of matplotlib."""
GATE_COLOR = "#e8590c"
DECOY_COLOR = "#c2255c"
INK, MUTED, FAINT = "#212529", "#868e96", "#dee2e6"
CRASH_COLOR = "#e03131"
CRASH: Style = {"marker": "x", "markersize": 11, "color": CRASH_COLOR, "markeredgewidth": 2.6}
"""Marker of a crash: a cross behind the path, so that the end of a short flight stays visible."""
START: Style = {"marker": "o", "markersize": 9, "color": "white", "markeredgecolor": INK, "markeredgewidth": 1.8}
"""Marker of a start: a ring behind the path."""
SPEED_COLORS: Colormap = LinearSegmentedColormap.from_list(
    "speed", ["#3b1f6b", "#2f5fb3", "#1fa2a6", "#7bc043", "#f2b705"]
)
BADGE: Style = {"boxstyle": "circle,pad=0.22", "facecolor": "white", "edgecolor": GATE_COLOR, "linewidth": 1.0}
DASHED = (0, (5, 3))
BOX: Style = {"facecolor": "#f8f9fa", "edgecolor": MUTED, "linewidth": 1.0, "linestyle": DASHED, "zorder": 0}
ARROW_INTERVAL = 0.1  # s between camera arrows
ARROW_LENGTH = 0.6  # m
NOTE_LETTERS = 14  # letters of a note per inch of a figure's width


def speed_scale(trajectories: Sequence[Trajectory]) -> Normalize:
    """Return the colour scale from 0 to the highest speed of the flights, rounded up to whole m/s."""
    top = max(float(np.nanmax(trajectory.speed.numpy())) for trajectory in trajectories)
    return Normalize(0.0, max(1.0, math.ceil(top)))


def draw_flight(axes: Axes, trajectory: Trajectory, speed: Normalize, plane: tuple[int, int] = (0, 1)) -> None:
    """Draw a path coloured by speed in the plane of two world axes, the camera's directions, start, and any crash."""
    points = trajectory.position[:, list(plane)].numpy()  # (K + 1, 2)
    segments = np.stack((points[:-1], points[1:]), axis=1)  # (K, 2, 2)
    lines = LineCollection(list(segments), cmap=SPEED_COLORS, norm=speed, linewidth=2.8, capstyle="round", zorder=5)
    lines.set_array(trajectory.speed[1:].numpy())
    axes.add_collection(lines, autolim=False)
    every = max(1, round(ARROW_INTERVAL / trajectory.control_dt))
    direction = camera_directions(trajectory.attitude[::every], trajectory.camera_tilt)[:, list(plane)].numpy()
    arrow: Style = {"width": 0.010, "headwidth": 4.5, "headlength": 5.0, "headaxislength": 4.5, "color": INK}
    scale: Style = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches"}
    axes.quiver(*points[::every].T, *(ARROW_LENGTH * direction).T, **scale, **arrow, alpha=0.7, zorder=6)
    axes.plot(*points[0], **START, zorder=4.5)
    if trajectory.crashed:
        axes.plot(*points[-1], **CRASH, zorder=4.6)


def draw_speed_scale(figure: Figure, panels: Sequence[Axes], speed: Normalize, label: str = "speed (m/s)") -> None:
    """Draw the colour scale of speeds beside panels."""
    bar = figure.colorbar(ScalarMappable(speed, SPEED_COLORS), ax=panels, shrink=0.6, aspect=35, pad=0.01)
    bar.set_label(label)
    bar.outline.set_visible(False)


def draw_track(axes: Axes, track: Track, labels: bool = True) -> None:
    """Draw a track from above at equal scales: its bounding box, decoys, and gates, by default numbered."""
    (x_low, y_low, _), (x_high, y_high, _) = track.bounds_low, track.bounds_high
    axes.add_patch(Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, **BOX))
    for gate in track.decoys:
        _draw_gate(axes, gate, track.shape.outer, DECOY_COLOR)
    for number, gate in enumerate(track.gates, start=1):
        _draw_gate(axes, gate, track.shape.outer, GATE_COLOR)
        if labels:
            _number_gate(axes, track, number)
    margin = 0.02 * max(x_high - x_low, y_high - y_low)
    axes.set(xlim=(x_low - margin, x_high + margin), ylim=(y_low - margin, y_high + margin))
    dress_map(axes, "y (m)" if labels else None)
    if labels:
        axes.set_xlabel("x (m)")


def save(figure: Figure, path: str | Path, left_out: Sequence[str] = ()) -> None:
    """Write a figure into a folder that may not exist yet, and what was left out of it beside it, `*_left_out.txt`.

    If nothing was left out, such a file of an earlier figure is removed.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white")
    beside = Path(path).with_name(f"{Path(path).stem}_left_out.txt")
    if left_out:
        beside.write_text("".join(f"{line}\n" for line in left_out), encoding="utf-8")
    else:
        beside.unlink(missing_ok=True)


def dress(axes: Axes, grid: Literal["both", "x", "y"] = "both") -> None:
    """Draw a faint grid without frame and ticks."""
    axes.set_axisbelow(True)
    axes.grid(axis=grid, color=FAINT, linewidth=0.6)
    axes.tick_params(colors=MUTED, labelsize=8, length=0)
    axes.spines[:].set_visible(False)


def from_zero(axes: Axes, least: float = 1.0) -> None:
    """Begin the vertical axis at 0, on which matplotlib would centre it if all values are 0, and end it above."""
    axes.set_ylim(0.0, max(least, axes.get_ylim()[1]))


def camera_directions(attitude: torch.Tensor, tilt: float | None) -> torch.Tensor:
    """Return unit vectors (..., 3) of the nose camera in the world, of attitudes (..., 4) wxyz, body → world.

    The tilt upwards from the body's x axis is in degrees; None for the default camera's.
    """
    angle = math.radians(Camera.tilt if tilt is None else tilt)
    axis = torch.tensor((math.cos(angle), 0.0, math.sin(angle)), dtype=attitude.dtype)
    return rotate(attitude, axis.expand(*attitude.shape[:-1], 3))


def dress_map(axes: Axes, y_label: str | None) -> None:
    """Set equal scales, a faint grid every 2 m and an optional label of the vertical axis."""
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(MultipleLocator(2.0))
    axes.yaxis.set_major_locator(MultipleLocator(2.0))
    dress(axes)
    if y_label:
        axes.set_ylabel(y_label)


def _draw_gate(axes: Axes, gate: Gate, width: float, color: str) -> None:
    """Draw a bar as wide as the frame, with arrows forwards at its ends, because the path would cover the middle."""
    centre, left, forward = (np.array(vector[:2]) for vector in (gate.position, gate.left, gate.forward))
    ends = np.stack((centre - left * width / 2, centre + left * width / 2))  # (2, 2)
    axes.plot(*ends.T, color=color, linewidth=4.5, solid_capstyle="butt", zorder=4)
    if gate.kind == "race":
        arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
        for side in (-0.42, 0.42):
            foot = centre + side * width * left
            axes.annotate("", xy=tuple(foot + 0.6 * forward), xytext=tuple(foot), arrowprops=arrow, zorder=4)


def _number_gate(axes: Axes, track: Track, number: int) -> None:
    """Write a gate's number beside the end that is farther from the middle of the track."""
    gate = track.gates[number - 1]
    middle = np.mean([other.position[:2] for other in track.gates], axis=0)
    centre, left = np.array(gate.position[:2]), np.array(gate.left[:2])
    outwards = 1.0 if np.dot(left, centre - middle) >= 0 else -1.0
    above = [other for other in track.gates[: number - 1] if math.dist(other.position[:2], gate.position[:2]) < 0.5]
    side = -outwards if above else outwards  # stacked gates have their numbers at opposite ends
    place = centre + side * left * (track.shape.outer / 2 + 0.45)
    axes.text(place[0], place[1], str(number), ha="center", va="center", fontsize=9, color=INK, bbox=BADGE, zorder=7)


def flight_legend(decoys: bool, crash: bool) -> list[Line2D]:
    """Return the legend entries of a flight from above, optionally with decoys and a crash."""
    bar: Style = {"linewidth": 4.5, "solid_capstyle": "butt"}
    handles = [Line2D([], [], color=GATE_COLOR, label="gate", **bar)]
    if decoys:
        handles.append(Line2D([], [], color=DECOY_COLOR, label="decoy", **bar))
    handles.append(Line2D([], [], linestyle="", label="start", **START))
    if crash:
        handles.append(Line2D([], [], linestyle="", label="crash", **CRASH))
    handles.append(Line2D([], [], color=INK, marker=r"$\rightarrow$", linestyle="", markersize=12, label="camera"))
    handles.append(Line2D([], [], color=MUTED, linestyle=DASHED, linewidth=1.0, label="bounding box"))
    return handles
