"""Figures of what evaluations have stored: flights side by side, and what the world model sees and imagines.

Each is drawn from files in `evaluations/`, without a simulator or a network.
Shapes: K control steps of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.evaluate import Trajectory
from dreamer_racing.figures.drawing import (
    CRASH_COLOR,
    INK,
    MUTED,
    SPEED_COLORS,
    draw_flight,
    draw_track,
    dress,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR, film_strip, shown_frames

TITLE_ROOM = 0.35  # inches above the panels
PROFILE_AXES = {"distance": "distance flown (m)", "time": "time (s)"}


class NamedFlight(NamedTuple):
    """A recorded episode and what it is to be called."""

    title: str
    track: Track
    trajectory: Trajectory


def plot_flights(
    flights: Sequence[NamedFlight],
    path: str | Path,
    over: str = "distance",
    columns: int = 3,
    problems: Sequence[str] = (),
) -> None:
    """Draw flights from above, side by side, with the camera's direction, and the speed of each below it.

    Reference: paper, Figs. "emergent" (with decoys and without) and "real world" (simulated and real).

    Args:
        flights: which.
        path: the file to write; missing folders are made.
        over: axis of the speed profile: ``distance`` flown (m) or ``time`` (s).
        columns: flights in a row at most.
        problems: what was left out, a line each.

    Raises:
        ValueError: no flights, or an unknown axis.
    """
    if not flights:
        raise ValueError("no flights to draw.")
    if over not in PROFILE_AXES:
        raise ValueError(f"over={over}: there are {', '.join(PROFILE_AXES)}.")
    columns = min(columns, len(flights))
    rows = math.ceil(len(flights) / columns)
    top = max(4.6 * _proportion(flight.track) for flight in flights)  # inches
    width, height = 4.6 * columns + 0.7, rows * (top + 1.9) + 0.4 + TITLE_ROOM
    figure = Figure(figsize=(width, height))
    # The layout forgets the titles of panels whose sides have a fixed proportion.
    figure.set_layout_engine(ConstrainedLayoutEngine(rect=(0, 0, 1, 1 - TITLE_ROOM / height)))
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[top, 1.5] * rows)
    speed = speed_scale([flight.trajectory for flight in flights])
    above, below = [], []
    for index, flight in enumerate(flights):
        row, column = divmod(index, columns)
        above.append(axes := figure.add_subplot(grid[2 * row, column]))
        draw_track(axes, flight.track)
        draw_flight(axes, flight.trajectory, speed)
        axes.set_title(f"{flight.title}\n{_outcome(flight)}", loc="left", fontsize=9, color=INK)
        below.append(profile := figure.add_subplot(grid[2 * row + 1, column]))
        _draw_speed(profile, flight.trajectory, speed, over)
        for panel in (axes, profile) if column else ():
            panel.set_ylabel("")
    bar = figure.colorbar(ScalarMappable(speed, SPEED_COLORS), ax=above + below, shrink=0.6, aspect=35, pad=0.01)
    bar.set_label("speed (m/s)")
    bar.outline.set_visible(False)
    decoys, crash = any(f.track.decoys for f in flights), any(f.trajectory.crashed for f in flights)
    handles = flight_legend(decoys, crash)
    figure.legend(handles=handles, loc="outside lower left", ncols=3 if columns == 1 else 6, frameon=False, fontsize=9)
    save(figure, path, problems)


def _proportion(track: Track) -> float:
    """Depth of the hall over its width."""
    width, depth, _ = (high - low for low, high in zip(track.bounds_low, track.bounds_high, strict=True))
    return depth / width


def _outcome(flight: NamedFlight) -> str:
    seconds = len(flight.trajectory.action) * flight.trajectory.control_dt
    gates = int((np.diff(flight.trajectory.target_gate) != 0).sum())
    outcome = (flight.trajectory.outcome or "recording stopped").replace("_", " ")
    return f"{flight.track.name}: {gates} gates in {seconds:.2f} s ({outcome})"


def profile_axis(trajectory: Trajectory, over: str) -> np.ndarray:
    """Where the rows of a trajectory lie on the axis of the speed profile, (K + 1,), m or s."""
    if over == "time":
        return np.arange(len(trajectory.position)) * trajectory.control_dt
    steps = np.nan_to_num(np.linalg.norm(np.diff(trajectory.position.numpy(), axis=0), axis=1))  # (K,) m
    return np.concatenate(([0.0], np.cumsum(steps)))


def _draw_speed(axes: Axes, trajectory: Trajectory, speed: Normalize, over: str) -> None:
    """Draw the speed, coloured by itself, and a numbered line at every gate passed."""
    along, values = profile_axis(trajectory, over), trajectory.speed.numpy()
    points = np.stack((along, values), axis=1)
    lines = LineCollection(list(np.stack((points[:-1], points[1:]), axis=1)), cmap=SPEED_COLORS, norm=speed)
    lines.set(array=values[1:], linewidth=2.4, capstyle="round", zorder=3)
    axes.add_collection(lines)
    for row in np.flatnonzero(np.diff(trajectory.target_gate)):
        axes.axvline(along[row + 1], color=MUTED, linewidth=0.8, linestyle=(0, (2, 2)), zorder=2)
        number = str(int(trajectory.target_gate[row]) + 1)
        axes.text(
            along[row + 1], 1.02, number, transform=axes.get_xaxis_transform(), ha="center", fontsize=7, color=MUTED
        )
    if trajectory.crashed and np.isfinite(points[-1]).all():
        axes.plot(
            *points[-1], marker="X", color=CRASH_COLOR, markersize=9, markeredgecolor="white", zorder=4, clip_on=False
        )
    axes.set(xlim=(0.0, max(along[-1], 1e-6)), ylim=(0.0, 1.05 * float(speed.vmax or 1.0)), xlabel=PROFILE_AXES[over])
    axes.set_ylabel("speed (m/s)")
    axes.yaxis.set_major_locator(MaxNLocator(4))
    dress(axes)


def plot_dreams(
    dreams: Sequence[tuple[str, Dream]], path: str | Path, columns: int = 6, problems: Sequence[str] = ()
) -> None:
    """Draw real, reconstructed and imagined observations of several stages of training, time from left to right.

    Reference: paper, Fig. "imagined".

    Args:
        dreams: the stages, each with its name; the first window of each is shown.
        path: the file to write; missing folders are made.
        columns: points in time.
        problems: what was left out, a line each.

    Raises:
        ValueError: no dreams.
    """
    if not dreams:
        raise ValueError("no dreams to draw.")
    figure = Figure(figsize=(1.4 + 1.15 * columns, 4.0 * len(dreams) + 0.3), layout="compressed")
    panels = figure.subplots(len(dreams), 1, squeeze=False)[:, 0]
    for axes, (name, dream) in zip(panels, dreams, strict=True):
        frames = shown_frames(dream, columns)
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
    phases = (
        (CONTEXT_COLOR, "the model has seen this image"),
        (OPEN_LOOP_COLOR, "predicted from actions alone, since 0 s"),
    )
    handles = [
        Line2D([], [], color=(red / 255, green / 255, blue / 255), label=label, **square)
        for (red, green, blue), label in phases
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2, frameon=False, fontsize=9)
    save(figure, path, problems)
