"""Maps of tracks side by side."""

from __future__ import annotations

import pytest
from PIL import Image

from dreamer_racing.envs.tracks import BUILTIN_TRACKS, load_track
from dreamer_racing.figures.tracks import CELL, plot_tracks


def test_every_track_is_drawn_from_above_and_from_the_side(tmp_path):
    tracks = [load_track(name) for name in BUILTIN_TRACKS[:4]]
    plot_tracks(tracks, tmp_path / "new" / "tracks.png")
    with Image.open(tmp_path / "new" / "tracks.png") as image:
        assert image.size == (round(3 * CELL[0] * 150), round(2 * CELL[1] * 150))
        pixels = image.convert("L")
        cells = [pixels.crop((left, 0, left + 750, 840)).getextrema() for left in (0, 750, 1500)]
        assert all(low < 128 for low, _ in cells)
        assert pixels.crop((760, 850, 2240, 1670)).getextrema() == (255, 255), "cells to spare stay white"


def test_no_track_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no track"):
        plot_tracks([], tmp_path / "tracks.png")
