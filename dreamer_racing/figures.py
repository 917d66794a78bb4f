"""The paper's figures: learning curves, flights side by side, and what the world model sees and imagines.

Each is drawn from what runs store (`metrics.csv`, `evaluations/`), without a simulator or a network.
Shapes: K control steps of an episode.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from dreamer_racing.curves import ALL_TRACKS, QUANTITIES, Curve, LearningCurves
from dreamer_racing.dreams import Dream, film_strip, shown_frames
from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation import Trajectory
from dreamer_racing.plotting import (
    CRASH_COLOR,
    FAINT,
    INK,
    MUTED,
    SPEED_COLORS,
    draw_flight,
    draw_track,
    flight_legend,
    save,
    speed_scale,
)
from dreamer_racing.recording import CONTEXT_COLOR, OPEN_LOOP_COLOR
from dreamer_racing.runs import CurveKey

ALGORITHMS = {"dreamer_v3": ("DreamerV3", "#1c7ed6"), "ppo": ("PPO", "#f76707"), "sac": ("SAC", "#e03131")}
"""Names and the paper's colours; another algorithm is drawn in grey under its own name."""
TRACKS = ("circle", "kidney", "figure8")  # columns of the paper, in its order; others follow
VARIANT_LINES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))
VARIANT_SHADES = (0.0, -0.5, 0.45, -0.25)  # of an algorithm's colour: darker below 0, lighter above
BANDS = {"mean": "mean and standard deviation", "iqm": "interquartile mean and 95 % bootstrap interval"}
MAX_WARNINGS = 8  # lines in the figure; the CSV file beside it has all
NOTE_LETTERS = 14  # of a warning, an inch of the figure's width


class Flight(NamedTuple):
    """A recorded episode and what it is to be called."""

    title: str
    track: Track
    trajectory: Trajectory


def plot_learning_curves(curves: LearningCurves, path: str | Path) -> None:
    """Draw a column a track and a row a quantity, a colour an algorithm and a line style a variant.

    Ticks at the bottom are where the curriculum raised b₂, of every seed. What was left out is named in the legend.

    Reference: paper, Fig. "Reward evolution".

    Args:
        curves: what to draw.
        path: the file to write; missing folders are made.
    """
    tracks = _in_order({curve.key.track for curve in curves.curves} | {key.track for key in curves.raises}, TRACKS)
    quantities = [name for name in QUANTITIES if any(curve.quantity == name for curve in curves.curves)]
    keys = sorted({curve.key._replace(track="") for curve in curves.curves}, key=_rank)
    longest = max(curve.env_steps[-1] for curve in curves.curves)
    width = max(7.0, 0.6 + 3.9 * len(tracks))
    notes = _warning_lines(curves.problems, width)
    columns = int(width / 2.3)
    lines = 1 + math.ceil((len(keys) + any(map(len, curves.raises.values()))) / columns)
    legend_height = 0.1 + 0.2 * lines + 0.16 * len(notes)  # inches
    figure = Figure(figsize=(width, 2.7 * len(quantities) + 0.5 + legend_height), layout="constrained")
    grid = figure.add_gridspec(
        len(quantities) + 1, len(tracks), height_ratios=[2.7] * len(quantities) + [legend_height]
    )
    for row, quantity in enumerate(quantities):
        for column, track in enumerate(tracks):
            axes = figure.add_subplot(grid[row, column])
            if row == 0:
                axes.set_title(_track_title(track), fontsize=11, color=INK)
            shown = [curve for curve in curves.curves if curve.quantity == quantity and curve.key.track == track]
            if track == ALL_TRACKS and not shown:
                axes.set_axis_off()  # the tracks have no common scale
                continue
            _draw_panel(axes, shown, keys, longest)
            _draw_raises(axes, curves, track, keys)
            if column == 0:
                axes.set_ylabel(QUANTITIES[quantity].label, color=INK)
            if row == len(quantities) - 1:
                axes.set_xlabel("env_steps", color=INK)
    _draw_legend(figure.add_subplot(grid[-1, :]), curves, keys, notes, columns)
    save(figure, path)


def _draw_panel(axes: Axes, curves: Sequence[Curve], keys: Sequence[CurveKey], longest: float) -> None:
    for curve in curves:
        line = _line(curve.key._replace(track=""), keys)
        axes.fill_between(curve.env_steps, curve.low, curve.high, color=line["color"], alpha=0.18, linewidth=0)
        axes.plot(curve.env_steps, curve.centre, linewidth=1.7, **line)
    if not curves:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color=MUTED)
        axes.set_yticks([])
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlim(0.0, longest)
    _dress(axes)


def _dress(axes: Axes) -> None:
    axes.grid(color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, labelsize=8, length=0)
    axes.spines[:].set_visible(False)


def _draw_raises(axes: Axes, curves: LearningCurves, track: str, keys: Sequence[CurveKey]) -> None:
    """Draw a short tick for every rise of b₂, a level above the axis for each curve that has any."""
    raised = [key for key in keys if len(curves.raises.get(key._replace(track=track), ()))]
    for level, key in enumerate(raised):
        bottom = 0.012 + 0.05 * level
        steps = curves.raises[key._replace(track=track)]
        axes.vlines(
            steps,
            bottom,
            bottom + 0.04,
            colors=[_line(key, keys)["color"]],
            linewidth=1.0,
            alpha=0.8,
            transform=axes.get_xaxis_transform(),
        )


def _draw_legend(
    axes: Axes, curves: LearningCurves, keys: Sequence[CurveKey], notes: Sequence[str], columns: int
) -> None:
    """Fill the space below the panels: what was aggregated how, the curves' names, and what was left out."""
    handles = [
        Line2D([], [], linewidth=2.0, label=f"{_label(key)} ({_seed_count(curves, key)})", **_line(key, keys))
        for key in keys
    ]
    if any(map(len, curves.raises.values())):
        tick: dict[str, Any] = {"marker": "|", "markersize": 8, "linestyle": "", "color": MUTED}
        handles.append(Line2D([], [], label="the curriculum raises b₂", **tick))
    axes.set_axis_off()
    style: dict[str, Any] = {"frameon": False, "fontsize": 9, "borderaxespad": 0.0, "labelcolor": INK}
    how = f"{BANDS[curves.aggregate]} over seeds; running mean over {_steps(curves.window)} env_steps"
    legend = axes.legend(handles=handles, loc="upper left", ncols=columns, title=how, alignment="left", **style)
    legend.get_title().set(fontsize=9, color=MUTED)
    if notes:
        axes.add_artist(legend)
        empty = [Line2D([], [], linestyle="", label=note) for note in notes]
        style |= {"fontsize": 8, "labelcolor": CRASH_COLOR, "handlelength": 0.0, "handletextpad": 0.0}
        axes.legend(handles=empty, loc="lower left", labelspacing=0.2, **style)


def _warning_lines(problems: Sequence[str], width: float) -> list[str]:
    shown = list(problems[:MAX_WARNINGS])
    if len(problems) > len(shown):
        shown.append(f"and {len(problems) - len(shown)} more, in the CSV file")
    return [
        line
        for problem in shown
        for line in textwrap.wrap(f"! {problem}", int(NOTE_LETTERS * width), subsequent_indent="   ")
    ]


def _steps(env_steps: float) -> str:
    """Write a number of env_steps shortly: 24k, 1.5M."""
    return EngFormatter(sep="")(float(f"{env_steps:.2g}"))


def _seed_count(curves: LearningCurves, key: CurveKey) -> str:
    """Say over how many seeds, one number if it is the same on every track."""
    own = [curve for curve in curves.curves if curve.key._replace(track="") == key and curve.key.track != ALL_TRACKS]
    counts = sorted({int(curve.seeds.max()) for curve in own})
    text = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]}–{counts[-1]}"
    return f"{text} seed{'s' if counts[-1] > 1 else ''}"


def _label(key: CurveKey) -> str:
    name = ALGORITHMS.get(key.algorithm, (key.algorithm, MUTED))[0]
    return f"{name}, {key.variant}" if key.variant else name


def _line(key: CurveKey, keys: Sequence[CurveKey]) -> dict[str, Any]:
    """Choose colour and style: the algorithm's colour; the more variants it has, the lighter and darker they are."""
    own = [other.variant for other in keys if other.algorithm == key.algorithm]
    index = own.index(key.variant)
    color = np.array(to_rgb(ALGORITHMS.get(key.algorithm, ("", MUTED))[1]))
    shade = VARIANT_SHADES[index % len(VARIANT_SHADES)]
    mixed = color * (1 + shade) if shade < 0 else color + (1 - color) * shade
    return {"color": tuple(mixed), "linestyle": VARIANT_LINES[index % len(VARIANT_LINES)]}


def _rank(key: CurveKey) -> tuple[int, CurveKey]:
    names = list(ALGORITHMS)
    return names.index(key.algorithm) if key.algorithm in names else len(names), key


def _in_order(names: set[str], first: Sequence[str]) -> list[str]:
    """Sort names: those that come first, the others by the alphabet, the pool of all at the end."""
    return sorted(
        names,
        key=lambda name: (name == ALL_TRACKS, name not in first, *([first.index(name)] if name in first else []), name),
    )


def _track_title(track: str) -> str:
    return re.sub(r"(?<=[a-z])(?=\d)", " ", track.replace("_", " ")).capitalize()


def plot_flights(flights: Sequence[Flight], path: str | Path, over: str = "distance", columns: int = 3) -> None:
    """Draw flights from above, side by side, with the camera's direction, and the speed of each below it.

    Reference: paper, Figs. "emergent" (with decoys and without) and "real world" (simulated and real).

    Args:
        flights: which.
        path: the file to write; missing folders are made.
        over: axis of the speed profile: ``distance`` flown (m) or ``time`` (s).
        columns: flights in a row at most.

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
    size = (4.6 * columns + 0.7, rows * (top + 1.9) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
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
    save(figure, path)


def _proportion(track: Track) -> float:
    """Depth of the hall over its width."""
    width, depth, _ = (high - low for low, high in zip(track.bounds_low, track.bounds_high, strict=True))
    return depth / width


def _outcome(flight: Flight) -> str:
    seconds = len(flight.trajectory.action) * flight.trajectory.control_dt
    gates = int((np.diff(flight.trajectory.target_gate) != 0).sum())
    outcome = (flight.trajectory.outcome or "recording stopped").replace("_", " ")
    return f"{flight.track.name}: {gates} gates in {seconds:.2f} s ({outcome})"


PROFILE_AXES = {"distance": "distance flown (m)", "time": "time (s)"}


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
    _dress(axes)


def plot_dreams(dreams: Sequence[tuple[str, Dream]], path: str | Path, columns: int = 6) -> None:
    """Draw real, reconstructed and imagined observations of several stages of training, time from left to right.

    Reference: paper, Fig. "imagined".

    Args:
        dreams: the stages, each with its name; the first window of each is shown.
        path: the file to write; missing folders are made.
        columns: points in time.

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
        axes.set_yticks([(index + 0.5) * height for index in range(3)], ["real", "reconstructed", "imagined"])
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
    save(figure, path)
