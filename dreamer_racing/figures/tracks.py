"""Maps of several tracks in one figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from dreamer_racing.envs.tracks import Track
from dreamer_racing.figures.drawing import INK, draw_track, save
from dreamer_racing.figures.top_down import draw_track_side

COLUMNS = 3
CELL = (5.0, 5.6)  # width and height per track, inches


def plot_tracks(tracks: Sequence[Track], path: str | Path) -> None:
    """Draw each track from above and from the side, with gate numbers and the direction of flight.

    Args:
        tracks: at least one track.
        path: the file to write; missing folders are created.

    Raises:
        ValueError: there is no track.
    """
    if not tracks:
        raise ValueError("There is no track to draw: give at least one.")
    columns = min(len(tracks), COLUMNS)
    rows = math.ceil(len(tracks) / columns)
    figure = Figure(figsize=(CELL[0] * columns, CELL[1] * rows), layout="constrained")
    cells = figure.subfigures(rows, columns, squeeze=False).flat
    for cell, track in zip(cells, tracks, strict=False):  # the last row may have empty cells
        _, depth, height = (high - low for low, high in zip(track.bounds_low, track.bounds_high, strict=True))
        above, side = cell.subplots(2, 1, sharex=True, height_ratios=[depth, height])
        draw_track(above, track)
        above.set_xlabel("")
        draw_track_side(side, track)
        title = f"{track.name}: {track.num_gates} gates, {sum(track.gate_distances):.1f} m"
        cell.suptitle(title, x=0.02, ha="left", fontsize=11, color=INK)  # not a title of the map, whose height varies
    save(figure, path)
