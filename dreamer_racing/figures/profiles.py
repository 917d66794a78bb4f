"""Profiles of speed and altitude along a flight of K steps; on a map, a drone above a gate looks as if it passed it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import CRASH, DASHED, FAINT, GATE_COLOR, MUTED, SPEED_COLORS, Style, dress

PROFILE_AXES = {"distance": "distance flown (m)", "time": "time (s)"}
"""Horizontal axes of profiles, and their labels."""
FRAME: Style = {"linewidth": 3.5, "solid_capstyle": "butt", "zorder": 2}
MISSED_COLOR = "#adb5bd"  # of a gate that was crossed on the map but not passed
HEADROOM = 0.3  # m above the highest thing drawn


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
