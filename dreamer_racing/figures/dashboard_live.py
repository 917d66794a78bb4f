"""Live page of one or two flights on a viser server, with the scene and panel of `dashboard`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from dreamer_racing.envs.tracks import Track
from dreamer_racing.figures.dashboard import LOOPBACK, quiet_server
from dreamer_racing.figures.dashboard_panel import (
    SHEET_COLUMNS,
    STYLE,
    TRACES,
    ShownFlight,
    beside,
    duration,
    panel,
    row_at,
    state_words,
)
from dreamer_racing.figures.scene_3d import RaceScene, check_viser, paints

FRAME = 0.04  # s between frames during playback
IN_VISER = """
.dashboard { padding: 4px 12px }
.dashboard .state, .dashboard output { display: none }
.numbers { width: calc(100% - 24px); margin: 0 12px; text-align: left; font-size: 12px; line-height: 1.25 }
.numbers th { font-weight: 400; color: #868e96 }
"""
"""CSS differences from the page in a file: viser places the panel, and numbers are shown below viser's slider."""


def serve(
    track: Track,
    flights: Sequence[ShownFlight],
    port: int,
    training: Sequence[str] = (),
    announce: Callable[[str], None] = lambda address: None,
    goes_on: Callable[[], bool] = lambda: True,
) -> None:
    """Serve a live page of flights to browsers on this machine until ``goes_on`` returns False.

    Args:
        track: the track of all flights.
        flights: one or two flights.
        port: the port; if taken, the next free one.
        training: see `write_page`.
        announce: called with the address once the page is ready.
        goes_on: called before each frame; returns whether to continue.

    Raises:
        ValueError: viser is not installed.
    """
    check_viser()
    trajectories = [flight.trajectory for flight in flights]
    end = duration(trajectories)
    with quiet_server(port) as server:
        scene = RaceScene(server, track, trajectories)
        # A share button would open a tunnel to this machine from outside.
        server.gui.configure_theme(control_width="large", show_share_button=False, show_logo=False)
        server.gui.main_panel.dock_right()
        play = server.gui.add_checkbox("play", True)
        now: Any = server.gui.add_slider("time (s)", 0.0, end, min(0.01, end), 0.0)
        numbers, moving = server.gui.add_html(""), server.gui.add_html("")
        server.gui.add_html(f"<style>{beside(STYLE)}{IN_VISER}</style>{panel(track, flights, training)}")
        announce(f"http://{LOOPBACK}:{server.get_port()}")
        while goes_on():
            began = time.monotonic()
            rows = [row_at(trajectory, now.value) for trajectory in trajectories]
            scene.place(rows)
            numbers.content = number_table(track, flights, rows)
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


def number_table(track: Track, flights: Sequence[ShownFlight], rows: Sequence[int]) -> str:
    """Return an HTML table with lap, gate and all traces of each flight at its row."""
    columns = []
    for (_, trajectory), paint, row in zip(flights, paints(len(flights)), rows, strict=True):
        cells = list(state_words(track, trajectory)[row])
        for trace in TRACES:
            values = trace.values(trajectory)
            cells.append("–" if values is None or row >= len(values) else f"{values[row]:.2f} {trace.unit}")
        columns.append([f'<td style="color: {paint.color}">{cell}</td>' for cell in cells])
    names = ("lap", "gate", "", *(trace.name for trace in TRACES))
    lines = (f"<tr><th>{name}</th>{''.join(cells)}</tr>" for name, *cells in zip(names, *columns, strict=True))
    return f'<table class="numbers">{"".join(lines)}</table>'
