"""Figures of stored evaluations: flights side by side, and reconstructions and predictions of the world model.

They are drawn from files in `evaluations/`, without a simulator or a network.
Shapes: K control steps of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import (
    INK,
    draw_flight,
    draw_speed_scale,
    draw_track,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR, STRIP_FRAMES, film_strip, shown_frames
from dreamer_racing.figures.profiles import PROFILE_AXES, altitude_legend, draw_altitude, draw_speed
from dreamer_racing.settings import check_choice

TITLE_ROOM = 0.35  # space above the panels, inches
PROFILE_HEIGHT = 1.3  # height of a profile, inches


class NamedFlight(NamedTuple):
    """A recorded episode with its title and track."""

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
    """Draw flights from above side by side, at one scale, with the camera's direction; altitude and speed below.

    Reference: paper, Figs. "emergent" (with decoys and without) and "real world" (simulated and real).

    Profiles are over an axis of `PROFILE_AXES`. ``problems`` are lines for everything left out.

    Raises:
        ValueError: there are no flights, or the axis is unknown.
    """
    if not flights:
        raise ValueError("no flights to draw.")
    check_choice("over", over, PROFILE_AXES)
    columns = min(columns, len(flights))
    rows = math.ceil(len(flights) / columns)
    half = [max(size) / 2 for size in zip(*(_floor_size(flight.track) for flight in flights), strict=True)]  # m
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
    panels: Sequence[Axes], flight: NamedFlight, speed: Normalize, half: Sequence[float], over: str
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


def _floor_size(track: Track) -> tuple[float, float]:
    """Return width and depth of a track's bounding box, m."""
    (x_low, y_low, _), (x_high, y_high, _) = track.bounds_low, track.bounds_high
    return x_high - x_low, y_high - y_low


def plot_dreams(dreams: Sequence[tuple[str, Dream]], path: str | Path, problems: Sequence[str] = ()) -> None:
    """Draw real, reconstructed and imagined observations of named stages of training, time from left to right.

    Only the first window of each is shown.

    Reference: paper, Fig. "imagined".

    Raises:
        ValueError: there are no dreams.
    """
    if not dreams:
        raise ValueError("no dreams to draw.")
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
    phases = (
        (CONTEXT_COLOR, "the model has seen this image"),
        (OPEN_LOOP_COLOR, "predicted from actions alone, from 0 s on"),
    )
    handles = [
        Line2D([], [], color=(red / 255, green / 255, blue / 255), label=label, **square)
        for (red, green, blue), label in phases
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2, frameon=False, fontsize=9)
    save(figure, path, problems)
