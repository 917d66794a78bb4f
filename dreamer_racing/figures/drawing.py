"""Maps and profiles of races of K control steps, as PNG, PDF or SVG by the path's suffix, without pyplot's state.

On a map, a drone above a gate looks as if it passed it: profiles show its altitude.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator, MultipleLocator

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
PROFILE_AXES = {"distance": "distance flown (m)", "time": "time (s)"}
"""Horizontal axes of profiles, and their labels."""
FRAME: Style = {"linewidth": 3.5, "solid_capstyle": "butt", "zorder": 2}
MISSED_COLOR = "#adb5bd"  # of a gate that was crossed on the map but not passed
HEADROOM = 0.3  # m above the highest thing drawn


def speed_scale(trajectories: Sequence[Trajectory]) -> Normalize:
    """Return the colour scale from 0 to the highest speed of the flights, rounded up to whole m/s."""
    speeds = [trajectory.speed.numpy() for trajectory in trajectories]  # not finite at the end of some flights
    top = max(float(speed[np.isfinite(speed)].max(initial=0.0)) for speed in speeds)
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
    dress_map(axes)
    if labels:
        axes.set(xlabel="x (m)", ylabel="y (m)")


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


def dress_map(axes: Axes) -> None:
    """Set equal scales and a faint grid every 2 m."""
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(MultipleLocator(2.0))
    axes.yaxis.set_major_locator(MultipleLocator(2.0))
    dress(axes)


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


class Crossing(NamedTuple):
    """A crossing of a race gate's bar by a flight, seen from above."""

    row: float  # fractional row of the trajectory: 0.5 is halfway between the first two rows
    gate: int  # index on the track
    passed: bool  # whether the race counted it: through the opening, in order, forwards


def crossings(track: Track, trajectory: Trajectory) -> list[Crossing]:
    """Return the crossings of a flight with the gates' bars on the map, at any height, in temporal order."""
    found = []
    target = trajectory.target_gate.numpy()
    for index, gate in enumerate(track.gates):
        offset = trajectory.position.numpy()[:, :2] - np.array(gate.position[:2])
        along, side = offset @ np.array(gate.forward[:2]), offset @ np.array(gate.left[:2])  # (K + 1,)
        steps = np.flatnonzero((along[:-1] < 0) != (along[1:] < 0))
        share = along[steps] / (along[steps] - along[steps + 1])
        across = side[steps] + share * (side[steps + 1] - side[steps])
        rows = (steps + share)[np.abs(across) <= track.shape.outer / 2].tolist()
        found += [Crossing(row, index, bool(target[int(row)] == index != target[int(row) + 1])) for row in rows]
    return sorted(found)


def profile_axis(trajectory: Trajectory, over: str) -> np.ndarray:
    """Return the positions of a trajectory's rows on the axis of a profile, (K + 1,), m or s."""
    if over == "time":
        return np.arange(len(trajectory.position)) * trajectory.control_dt
    steps = np.nan_to_num(np.linalg.norm(np.diff(trajectory.position.numpy(), axis=0), axis=1))  # (K,) m
    return np.concatenate(([0.0], np.cumsum(steps)))


def draw_speed(axes: Axes, trajectory: Trajectory, speed: Normalize, over: str = "distance") -> None:
    """Draw the speed, coloured by speed, and a numbered line at every gate pass."""
    along = profile_axis(trajectory, over)
    _draw_profile(axes, trajectory, along, trajectory.speed.numpy(), speed)
    _number_passes(axes, trajectory, along)
    axes.set(ylim=(0.0, 1.05 * float(speed.vmax or 1.0)), xlabel=PROFILE_AXES[over], ylabel="speed (m/s)")


def draw_altitude(
    axes: Axes, track: Track, trajectory: Trajectory, speed: Normalize, over: str = "distance", numbers: bool = True
) -> None:
    """Draw the altitude, coloured by speed, and a gate's frame where its bar on the map is crossed, grey if missed."""
    along = profile_axis(trajectory, over)
    height = trajectory.position[:, 2].numpy()
    _draw_profile(axes, trajectory, along, height, speed)
    for row, index, passed in crossings(track, trajectory):
        _draw_frame(axes, track, index, float(np.interp(row, np.arange(len(along)), along)), passed)
    if numbers:
        _number_passes(axes, trajectory, along)
    top = max(gate.position[2] + track.shape.outer / 2 for gate in track.gates)
    axes.axhline(0.0, color=MUTED, linewidth=1.0, zorder=1)
    axes.axhline(track.bounds_high[2], color=MUTED, linewidth=1.0, linestyle=DASHED, zorder=1)
    axes.set(ylim=(min(0.0, float(np.nanmin(height))), max(top, float(np.nanmax(height))) + HEADROOM))
    axes.set(xlabel=PROFILE_AXES[over], ylabel="altitude (m)")


def altitude_legend(flights: Sequence[tuple[Track, Trajectory]]) -> list[Line2D]:
    """Return the legend entries of altitude profiles, in addition to `flight_legend`."""
    passed = {crossing.passed for flight in flights for crossing in crossings(*flight)}
    style: Style = {"linestyle": "", "marker": "|", "markersize": 11, "markeredgewidth": 3.5}
    looks = ((True, GATE_COLOR, "frame, passed"), (False, MISSED_COLOR, "above, below or out of order"))
    return [Line2D([], [], color=color, label=label, **style) for which, color, label in looks if which in passed]


def _draw_frame(axes: Axes, track: Track, index: int, place: float, passed: bool) -> None:
    """Draw the two beams of a gate's frame, above and below its opening."""
    middle, shape = track.gates[index].position[2], track.shape
    color = GATE_COLOR if passed else MISSED_COLOR
    for sign in (-1, 1):
        ends = (middle + sign * shape.opening / 2, middle + sign * shape.outer / 2)
        axes.plot((place, place), ends, color=color, **FRAME)
    if not passed:
        at = (place, middle + shape.outer / 2)
        axes.annotate(f"({index + 1})", at, (0, 1), textcoords="offset points", ha="center", fontsize=7, color=MUTED)


def _draw_profile(axes: Axes, trajectory: Trajectory, along: np.ndarray, values: np.ndarray, speed: Normalize) -> None:
    """Draw values (K + 1,) along a flight, coloured by speed, and a crash at the end."""
    points = np.stack((along, values), axis=1)
    lines = LineCollection(list(np.stack((points[:-1], points[1:]), axis=1)), cmap=SPEED_COLORS, norm=speed)
    lines.set(array=trajectory.speed[1:].numpy(), linewidth=2.2, capstyle="round", zorder=4)
    axes.add_collection(lines)
    if trajectory.crashed and np.isfinite(points[-1]).all():
        axes.plot(*points[-1], **CRASH, zorder=3, clip_on=False)
    axes.set_xlim(0.0, max(along[-1], 1e-6))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    dress(axes)


def _number_passes(axes: Axes, trajectory: Trajectory, along: np.ndarray) -> None:
    for row in np.flatnonzero(np.diff(trajectory.target_gate)):
        place, number = along[row + 1], str(int(trajectory.target_gate[row]) + 1)
        axes.axvline(place, color=FAINT, linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
        axes.text(place, 1.02, number, transform=axes.get_xaxis_transform(), ha="center", fontsize=7, color=MUTED)
