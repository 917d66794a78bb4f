"""The panel of a flight's page as static HTML: the page's script or server sets cursor, images and numbers.

Shapes: K control steps of an episode.
"""

from __future__ import annotations

import base64
import io
import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from PIL import Image

from dreamer_racing.commands import from_here
from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import speed_scale
from dreamer_racing.figures.film import laps_completed
from dreamer_racing.figures.flights import NamedFlight
from dreamer_racing.figures.scene_3d import DRONE_SCALE, Paint, paints

SHEET_COLUMNS = 25  # images per row of the sheet with all images of a flight
CURVE_WIDTH, CURVE_HEIGHT = 1000.0, 100.0  # in a curve's SVG coordinates
HEADROOM = 0.06  # space above and below a curve, as a share of its range
COLOR_STOPS = 8  # number of colours in a legend's gradient
STYLE = "dashboard.css"  # in this module's folder


@dataclass(frozen=True)
class Trace:
    """A quantity that is drawn over time."""

    name: str
    unit: str
    values: Callable[[Trajectory], np.ndarray | None]
    """Returns (K + 1,) at observations or (K,) at steps; None if the flight lacks the quantity."""


def command(channel: int) -> Callable[[Trajectory], np.ndarray]:
    """Return a function from a flight to a channel of its clipped actions in SI units: 0 thrust, 1 to 3 body rates."""
    drone = QuadrotorParameters()  # every preset has these scales
    scale = (drone.collective_thrust_scale, *drone.body_rate_max)[channel]
    offset = drone.collective_thrust_scale if channel == 0 else 0.0
    return lambda flight: offset + scale * flight.action[:, channel].clamp(-1.0, 1.0).numpy()


TRACES = (
    Trace("speed", "m/s", lambda flight: flight.speed.numpy()),
    Trace("thrust", "m/s²", command(0)),
    Trace("roll rate", "rad/s", command(1)),
    Trace("pitch rate", "rad/s", command(2)),
    Trace("yaw rate", "rad/s", command(3)),
    Trace("value", "expected return", lambda flight: None if flight.value is None else flight.value.numpy()),
)
"""The curves of a page: speed, the actor's four commands, and the critic's value."""


def panel(flights: Sequence[NamedFlight], training: Sequence[str]) -> str:
    """Return the HTML of the panel: legend, images, state, curves, notes."""
    colors = paints(len(flights))
    shown = list(zip(flights, colors, strict=True))
    lines = [*training, *(line for flight in flights for line in missing(flight))]
    lines.append(f"Drones are drawn {DRONE_SCALE:g} times their size.")
    parts = (
        f"<header><h1>{escape(flights[0].track.name)}</h1>{_legend(shown)}</header>",
        f'<section class="views">{_views(shown)}{_state(shown)}</section>',
        f'<section class="curves">{"".join(_curves(shown))}<i class="cursor"></i></section>',
        f"<footer>{''.join(f'<p>{_with_code_elements(line)}</p>' for line in lines)}</footer>",
    )
    return f'<aside class="dashboard">{"".join(parts)}</aside>'


def missing(flight: NamedFlight) -> Iterator[str]:
    """Yield a sentence with the reason for everything that a flight's page cannot show."""
    if flight.trajectory.pixels is None:
        yield f"{flight.title}: no images, because none were recorded with the flight."
    if flight.trajectory.value is None:
        yield f"{flight.title}: no value, because the flight has no critic; included agents have none."


def how_it_trained(folders: Iterable[Path]) -> str:
    """Return a line on how to open the training curves of runs in TensorBoard."""
    # Relative to the working directory if possible, because pages are shown to others.
    logged = {Path(from_here(folder)): None for folder in folders if (folder / "tensorboard").is_dir()}
    if not logged:
        return "Training curves: none, because these flights are in no run directory with TensorBoard files."
    if len(logged) == 1:
        return f"Training curves: `tensorboard --logdir {shlex.quote(str(*logged))}`"
    runs = ",".join(f"{folder.name}:{folder}" for folder in logged)
    return f"Training curves: `tensorboard --logdir_spec {shlex.quote(runs)}`"


def readings(flights: Sequence[NamedFlight]) -> dict[str, Any]:
    """Return the panel's words and numbers at each row of each flight, as JSON values."""
    return {
        "duration": duration([flight.trajectory for flight in flights]),
        "columns": SHEET_COLUMNS,
        "flights": [
            {
                "control_dt": flight.trajectory.control_dt,
                "words": state_words(flight),
                "values": {
                    trace.name: [round(value, 3) if math.isfinite(value) else None for value in values.tolist()]
                    for trace in TRACES
                    if (values := trace.values(flight.trajectory)) is not None
                },
            }
            for flight in flights
        ],
    }


def state_words(flight: NamedFlight) -> list[list[str]]:
    """Return lap, next gate and status at each of the K + 1 rows of a flight from its start."""
    _, track, trajectory = flight
    laps = np.minimum(laps_completed(trajectory) + 1, track.laps).tolist()
    rows = zip(laps, (trajectory.target_gate + 1).tolist(), strict=True)
    words = [[f"{lap}/{track.laps}", f"{gate}/{track.num_gates}", "flying"] for lap, gate in rows]
    words[-1][2] = trajectory.ending
    return words


def image_sheet(pixels: np.ndarray) -> str:
    """Return the images of a flight (K + 1, H, W, 3) as the data URI of one PNG, row by row."""
    count, height, width, channels = pixels.shape
    rows = math.ceil(count / SHEET_COLUMNS)
    sheet = np.zeros((rows * SHEET_COLUMNS, height, width, channels), np.uint8)
    sheet[:count] = pixels
    grid = sheet.reshape(rows, SHEET_COLUMNS, height, width, channels).transpose(0, 2, 1, 3, 4)
    buffer = io.BytesIO()
    Image.fromarray(grid.reshape(rows * height, SHEET_COLUMNS * width, channels)).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _legend(shown: Sequence[tuple[NamedFlight, Paint]]) -> str:
    """Return each flight's colour, result, and colour scale of speeds."""
    top = speed_scale([flight.trajectory for flight, _ in shown]).vmax
    rows = []
    for flight, paint in shown:
        stops = ", ".join(to_hex(paint.speeds(share)) for share in np.linspace(0.0, 1.0, COLOR_STOPS))
        rows.append(
            f'<div class="flight" style="--color: {paint.color}"><b>{escape(flight.title)}</b>'
            f"<span>{escape(_result(flight.trajectory))}</span>"
            f'<span class="scale">0<i style="background: linear-gradient(90deg, {stops})"></i>{top:g} m/s</span></div>'
        )
    return "".join(rows)


def _result(flight: Trajectory) -> str:
    """Return the outcome of a flight and its lap times as text."""
    completed = laps_completed(flight)
    ends = [0, *(np.flatnonzero(np.diff(completed)) + 1).tolist()]
    laps = " ".join(f"{(after - before) * flight.control_dt:.2f}" for before, after in pairwise(ends))
    return f"{flight.ending}, {'laps ' + laps + ' s' if laps else 'no lap'}"


def _views(shown: Sequence[tuple[NamedFlight, Paint]]) -> str:
    """Return the on-board images, or a note for a flight without images."""
    views = []
    for index, (flight, paint) in enumerate(shown):
        if (pixels := flight.trajectory.pixels) is None:
            views.append(f'<div class="view" style="--color: {paint.color}"><span>no images recorded</span></div>')
            continue
        count, height, width = pixels.shape[:3]
        rows = math.ceil(count / SHEET_COLUMNS)
        views.append(
            f'<div class="view view-{index}" role="img" aria-label="on-board image" style="--color: {paint.color};'
            f" aspect-ratio: {width} / {height}; --columns: {SHEET_COLUMNS}; --rows: {rows};"
            f' background-image: url({image_sheet(pixels.numpy())})"></div>'
        )
    return "".join(views)


def _state(shown: Sequence[tuple[NamedFlight, Paint]]) -> str:
    """Return the HTML table of time, lap, gate and status; the page updates its cells."""
    head = '<tr><td class="time" colspan="3" data-time>0.00 s</td></tr><tr><th>lap</th><th>gate</th><th></th></tr>'
    rows = [
        f'<tr style="--color: {paint.color}" title="{escape(flight.title)}">'
        + "".join(f'<td data-words="{index}">{escape(word)}</td>' for word in state_words(flight)[0])
        + "</tr>"
        for index, (flight, paint) in enumerate(shown)
    ]
    return f'<table class="state">{head}{"".join(rows)}</table>'


def _curves(shown: Sequence[tuple[NamedFlight, Paint]]) -> Iterator[str]:
    """Yield the curves of each trace that at least one flight has, and their time axis."""
    longest = duration([flight.trajectory for flight, _ in shown])
    passes = "".join(_passes(flight.trajectory, paint, longest) for flight, paint in shown)
    for trace in TRACES:
        series = [trace.values(flight.trajectory) for flight, _ in shown]
        finite = np.concatenate([values[np.isfinite(values)] for values in series if values is not None] or [[]])
        if not len(finite):
            continue
        low, high = float(finite.min()), float(finite.max())
        room = HEADROOM * (high - low) or 0.5
        frame = (low - room, high + room)
        lines, now = [_zero(*frame)], []
        for index, ((flight, paint), values) in enumerate(zip(shown, series, strict=True)):
            if values is not None:
                stretches = _points(values, flight.trajectory.control_dt / longest, *frame)
                lines += [f'<polyline points="{points}" stroke="{paint.color}"/>' for points in stretches]
                now.append(
                    f'<output data-value="{index}" data-of="{trace.name}" style="--color: {paint.color}"></output>'
                )
        yield (
            f'<div class="curve"><div class="name">{trace.name} <small>{trace.unit}</small>'
            f"{''.join(reversed(now))}</div>"
            f'<div class="range"><span>{high:.3g}</span><span>{low:.3g}</span></div>'
            f'<svg viewBox="0 0 {CURVE_WIDTH:g} {CURVE_HEIGHT:g}" preserveAspectRatio="none">'
            f"{passes}{''.join(lines)}</svg></div>"
        )
    yield f'<div class="times"><span>0 s</span><span>{longest:.2f} s</span></div>'


def _zero(low: float, high: float) -> str:
    """Return an SVG line at zero if it is within a curve's range."""
    level = CURVE_HEIGHT * high / (high - low)
    inside = low < 0.0 < high
    return f'<line class="zero" x2="{CURVE_WIDTH:g}" y1="{level:.1f}" y2="{level:.1f}"/>' if inside else ""


def _passes(flight: Trajectory, paint: Paint, longest: float) -> str:
    """Return SVG lines at all gate passes, of another class where a lap ends."""
    lines, target = [], flight.target_gate.numpy()
    for row in (np.flatnonzero(np.diff(target)) + 1).tolist():
        place = CURVE_WIDTH * row * flight.control_dt / longest
        kind = "lap" if target[row] == 0 else "gate"
        lines.append(
            f'<line class="{kind}" x1="{place:.1f}" x2="{place:.1f}" y2="{CURVE_HEIGHT:g}" stroke="{paint.color}"/>'
        )
    return "".join(lines)


def _points(values: np.ndarray, step: float, low: float, high: float) -> Iterator[str]:
    """Yield the SVG points of each part of a curve without gaps; ``step`` is a share of the width."""
    place = CURVE_WIDTH * step * np.arange(len(values))
    level = CURVE_HEIGHT * (high - values) / (high - low)
    finite = np.isfinite(values)
    for part in np.split(np.arange(len(values)), np.flatnonzero(np.diff(finite)) + 1):
        if finite[part[0]]:
            yield " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(place[part], level[part], strict=True))


def _with_code_elements(line: str) -> str:
    """Convert text between backquotes to HTML code elements."""
    parts = escape(line).split("`")
    return "".join(f"<code>{part}</code>" if index % 2 else part for index, part in enumerate(parts))


def duration(flights: Sequence[Trajectory]) -> float:
    """Return the duration of the longest flight, s."""
    return max(flight.duration for flight in flights)


def row_at(flight: Trajectory, time: float) -> int:
    """Return the row of a flight at a time in s; the last row after its end."""
    return min(int(time / flight.control_dt + 1e-6), len(flight.position) - 1)


def beside(name: str) -> str:
    """Read a text file in this module's folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
