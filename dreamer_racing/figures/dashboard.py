"""A page of one or two flights: the race in 3-D with a scrubber, and a panel with data.

A page in a file combines viser's recording of a `RaceScene`, which includes the viewer, with a panel whose images,
numbers and cursor follow the time of viser's scrubber. A live page shows the same from a viser server.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Callable, Iterator, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.dashboard_panel import (
    SHEET_COLUMNS,
    STYLE,
    TRACES,
    beside,
    duration,
    panel,
    readings,
    row_at,
    state_words,
)
from dreamer_racing.figures.flights import NamedFlight
from dreamer_racing.figures.scene_3d import RaceScene, check_viser, paints
from dreamer_racing.training.directory import replace_text

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"  # servers listen on this interface only
KEYS = "Space: play or pause. Comma or full stop: one step back or forward. Click on a curve: go to that time."
HOLD = 1.0  # s that the last frame is held before the recording repeats
FRAME = 0.04  # s between frames of a live page
IN_VISER = """
.dashboard { padding: 4px 12px }
.dashboard .state, .dashboard output { display: none }
.numbers { width: calc(100% - 24px); margin: 0 12px; text-align: left; font-size: 12px; line-height: 1.25 }
.numbers th { font-weight: 400; color: #868e96 }
"""
"""CSS differences from the page in a file: viser places the panel, and numbers are shown below viser's slider."""


def write_page(path: str | Path, flights: Sequence[NamedFlight], training: Sequence[str] = ()) -> int:
    """Write the page of one flight, or of two on the same track; return its size in bytes.

    Lines of ``training`` say how to see the flights' training curves, with commands between backquotes.

    Raises:
        ValueError: viser is not installed.
    """
    check_viser()
    text = compose(record(flights), flights, training)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    replace_text(Path(path), text)
    return len(text.encode())


def record(flights: Sequence[NamedFlight]) -> str:
    """Return viser's HTML page that plays the flights from their start."""
    trajectories = [flight.trajectory for flight in flights]
    times = moments(trajectories)
    with quiet_server(port=0) as server:
        scene = RaceScene(server, flights[0].track, trajectories)
        scene.place([0] * len(flights))
        recording = server.get_scene_serializer()
        for now, following in pairwise([*times, times[-1] + HOLD]):
            scene.place([row_at(trajectory, now) for trajectory in trajectories])
            recording.insert_sleep(following - now)
        return recording.as_html()


@contextlib.contextmanager
def quiet_server(port: int) -> Iterator[viser.ViserServer]:
    """Run a viser server on the loopback interface within a context, without its printed banner."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=LOOPBACK, port=port, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def compose(viewer: str, flights: Sequence[NamedFlight], training: Sequence[str]) -> str:
    """Insert the panel into viser's page; raise RuntimeError if its HTML is not that of the expected version."""
    names = " against ".join(flight.title for flight in flights)
    title, end = "<title>Viser</title>", "</body>"
    if viewer.count(title) != 1 or end not in viewer:
        raise RuntimeError(f"viser's page has no {title} or no {end}: this version of viser is not the one expected.")
    viewer = viewer.replace(title, f"<title>{escape(flights[0].track.name)}: {escape(names)}</title>")
    body, _, rest = viewer.rpartition(end)
    data = json.dumps(readings(flights), allow_nan=False).replace("<", "\\u003c")
    parts = (
        f"<style>{beside(STYLE)}{beside('dashboard_page.css')}</style>",
        panel(flights, [*training, KEYS]),
        f'<script type="application/json" id="flights">{data}</script>',
        f"<script>{beside('dashboard.js')}</script>",
    )
    return "".join((body, *parts, end, rest))


def moments(flights: Sequence[Trajectory]) -> list[float]:
    """Return the distinct times of all rows of all flights, sorted, s."""
    times = sorted(row * flight.control_dt for flight in flights for row in range(len(flight.position)))
    return [time for before, time in pairwise([-1.0, *times]) if time - before > 1e-9]


def serve(
    flights: Sequence[NamedFlight],
    port: int,
    training: Sequence[str] = (),
    announce: Callable[[str], None] = lambda address: None,
    goes_on: Callable[[], bool] = lambda: True,
) -> None:
    """Serve a live page of one or two flights on a track to browsers on this machine, until ``goes_on`` returns False.

    The port is the next free one if it is taken; ``announce`` is called with the address once the page is ready.

    Raises:
        ValueError: viser is not installed.
    """
    check_viser()
    trajectories = [flight.trajectory for flight in flights]
    end = duration(trajectories)
    with quiet_server(port) as server:
        scene = RaceScene(server, flights[0].track, trajectories)
        # A share button would open a tunnel to this machine from outside.
        server.gui.configure_theme(control_width="large", show_share_button=False, show_logo=False)
        server.gui.main_panel.dock_right()
        play = server.gui.add_checkbox("play", True)
        now: Any = server.gui.add_slider("time (s)", 0.0, end, min(0.01, end), 0.0)
        numbers, moving = server.gui.add_html(""), server.gui.add_html("")
        server.gui.add_html(f"<style>{beside(STYLE)}{IN_VISER}</style>{panel(flights, training)}")
        announce(f"http://{LOOPBACK}:{server.get_port()}")
        while goes_on():
            began = time.monotonic()
            rows = [row_at(trajectory, now.value) for trajectory in trajectories]
            scene.place(rows)
            numbers.content = number_table(flights, rows)
            moving.content = f"<style>{positions(rows, now.value / end)}</style>"
            time.sleep(FRAME)
            if play.value:
                now.value = round((now.value + time.monotonic() - began) % end, 3)


def positions(rows: Sequence[int], share: float) -> str:
    """Return CSS rules with the cursor position and the image that each view shows from its sheet."""
    views = (
        f".dashboard .view-{index} {{ --column: {row % SHEET_COLUMNS} !important;"
        f" --row: {row // SHEET_COLUMNS} !important }}"
        for index, row in enumerate(rows)
    )
    return "".join((f".dashboard {{ --now: {share:.4f} !important }}", *views))


def number_table(flights: Sequence[NamedFlight], rows: Sequence[int]) -> str:
    """Return an HTML table with lap, gate and all traces of each flight at its row."""
    columns = []
    for flight, paint, row in zip(flights, paints(len(flights)), rows, strict=True):
        cells = list(state_words(flight)[row])
        for trace in TRACES:
            values = trace.values(flight.trajectory)
            cells.append("–" if values is None or row >= len(values) else f"{values[row]:.2f} {trace.unit}")
        columns.append([f'<td style="color: {paint.color}">{cell}</td>' for cell in cells])
    names = ("lap", "gate", "", *(trace.name for trace in TRACES))
    lines = (f"<tr><th>{name}</th>{''.join(cells)}</tr>" for name, *cells in zip(names, *columns, strict=True))
    return f'<table class="numbers">{"".join(lines)}</table>'
