"""A page of one or two flights in a single HTML file: the race in 3-D with a scrubber, and a panel with data.

The file combines viser's recording of a `RaceScene`, which includes the viewer, with a panel whose images, numbers and
cursor follow the time of viser's scrubber.
Shapes: K control steps of an episode; F flights, one or two.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.dashboard_panel import STYLE, ShownFlight, beside, panel, readings, row_at
from dreamer_racing.figures.scene_3d import RaceScene, check_viser

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
"""Servers listen on the loopback interface only."""
KEYS = "Space: play or pause. Comma or full stop: one step back or forward. Click on a curve: go to that time."
HOLD = 1.0  # s that the last frame is held before the recording repeats


def write_page(path: str | Path, track: Track, flights: Sequence[ShownFlight], training: Sequence[str] = ()) -> int:
    """Write the page of one or two flights in one scene.

    Args:
        path: the file; missing folders are created.
        track: the track of all flights.
        flights: one or two flights.
        training: lines that say how to see the flights' training curves, with commands between backquotes.

    Returns:
        Size of the file, bytes.

    Raises:
        ValueError: viser is not installed.
    """
    check_viser()
    text = compose(record(track, flights), track, flights, training)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    partial = Path(path).with_name(f".{Path(path).name}.partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
    return len(text.encode())


def record(track: Track, flights: Sequence[ShownFlight]) -> str:
    """Return viser's HTML page that plays the flights from their start."""
    trajectories = [flight.trajectory for flight in flights]
    times = moments(trajectories)
    with quiet_server(port=0) as server:
        scene = RaceScene(server, track, trajectories)
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


def compose(viewer: str, track: Track, flights: Sequence[ShownFlight], training: Sequence[str]) -> str:
    """Insert the panel into viser's page.

    Raises:
        RuntimeError: the page's HTML differs from that of the expected viser version.
    """
    names = " against ".join(flight.title for flight in flights)
    title, end = "<title>Viser</title>", "</body>"
    if viewer.count(title) != 1 or end not in viewer:
        raise RuntimeError(f"viser's page has no {title} or no {end}: this version of viser is not the one expected.")
    viewer = viewer.replace(title, f"<title>{escape(track.name)}: {escape(names)}</title>")
    body, _, rest = viewer.rpartition(end)
    data = json.dumps(readings(track, flights), allow_nan=False).replace("<", "\\u003c")
    parts = (
        f"<style>{beside(STYLE)}{beside('dashboard_page.css')}</style>",
        panel(track, flights, [*training, KEYS]),
        f'<script type="application/json" id="flights">{data}</script>',
        f"<script>{beside('dashboard.js')}</script>",
    )
    return "".join((body, *parts, end, rest))


def moments(flights: Sequence[Trajectory]) -> list[float]:
    """Return the distinct times of all rows of all flights, sorted, s."""
    times = sorted(row * flight.control_dt for flight in flights for row in range(len(flight.position)))
    return [time for before, time in pairwise([-1.0, *times]) if time - before > 1e-9]
