"""Videos and GIFs: they can be read back, with as many frames of the right size and colour."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures import film
from dreamer_racing.figures.film import (
    CONTEXT_COLOR,
    OPEN_LOOP_COLOR,
    onboard_beside_map,
    side_by_side,
    top_down_frames,
    write_gif,
    write_video,
)

PALETTE = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [240, 240, 240]], dtype=np.uint8)


def blocks(frames: int, height: int = 16, width: int = 16) -> np.ndarray:
    """Frame t is PALETTE[t % 4], its left upper quarter the next colour."""
    index = np.arange(frames) % 4
    video = np.repeat(PALETTE[index][:, None, None], height, axis=1).repeat(width, axis=2)
    video[:, : height // 2, : width // 2] = PALETTE[(index + 1) % 4][:, None, None]
    return video


def flight(steps: int = 10) -> Trajectory:
    position = torch.zeros(steps + 1, 3)
    position[:, 0] = torch.linspace(-4, 4, steps + 1)
    attitude = torch.zeros(steps + 1, 4)
    attitude[:, 0] = 1
    velocity = torch.tensor([2.0, 0, 0]).expand(steps + 1, 3)
    gate = torch.zeros(steps + 1, dtype=torch.int64)
    pixels = torch.as_tensor(blocks(steps + 1))
    return Trajectory(position, attitude, velocity, gate, torch.zeros(steps, 4), pixels, 0.02, "ground")


@pytest.mark.parametrize(
    ("size", "scale", "expected"),
    [
        ((16, 16), 4, (64, 64)),
        ((16, 16), None, (256, 256)),
        ((64, 40), None, (256, 160)),
        ((272, 20), None, (272, 20)),  # already large: not enlarged
        ((15, 21), 3, (46, 64)),  # H.264 wants even sizes
    ],
)
def test_video_reads_back(tmp_path, size, scale, expected):
    path = tmp_path / "new" / "video.mp4"
    frames = blocks(12, *size)
    assert write_video(path, frames, fps=50, scale=scale)
    read = iio.imread(path, plugin="FFMPEG")
    assert read.shape == (12, *expected, 3)
    metadata = iio.immeta(path, plugin="FFMPEG")
    assert metadata["fps"] == 50
    assert metadata["codec"] == "h264"
    assert metadata["pix_fmt"].startswith("yuv420p")
    corner, middle = read[:, 3, 3].astype(int), read[:, -4, -4].astype(int)
    assert np.abs(middle - frames[:, -1, -1]).max() < 25
    assert np.abs(corner - frames[:, 0, 0]).max() < 25


@pytest.mark.parametrize(
    ("name", "write", "owner", "part"),
    [("a.mp4", write_video, film, "_make_even"), ("a.gif", write_gif, Image.Image, "save")],
)
def test_a_film_that_is_broken_off_leaves_the_one_before_and_nothing_else(
    tmp_path, monkeypatch, name, write, owner, part
):
    frames = []

    def fails(first, *rest, **_):
        """In place of what makes a frame even, at the ninth one; or of what saves an image, half of which is there."""
        frames.append(first)
        if owner is film and len(frames) < 9:
            return first
        for path in rest:
            Path(path).write_bytes(b"GIF89a")
        raise OSError(28, "No space left on device")

    write(tmp_path / name, blocks(12))
    before = (tmp_path / name).read_bytes()
    monkeypatch.setattr(owner, part, fails)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path / name, blocks(10))
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_without_ffmpeg_one_warning_stands_for_all_videos(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(film, "_finds_ffmpeg", cache(film._finds_ffmpeg.__wrapped__))  # that has found nothing yet
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: (_ for _ in ()).throw(RuntimeError("No ffmpeg.")))
    assert not any(write_video(tmp_path / f"{name}.mp4", blocks(3)) for name in "ab")
    assert not list(tmp_path.iterdir())
    assert [record.message for record in caplog.records] == [
        "no videos are written: No ffmpeg. pip install imageio-ffmpeg brings ffmpeg."
    ]


def test_gif_reads_back(tmp_path):
    frames = torch.as_tensor(blocks(12))
    size = write_gif(tmp_path / "new" / "a.gif", frames, fps=25, scale=2, colors=16)
    assert size == (tmp_path / "new" / "a.gif").stat().st_size < 4000
    with Image.open(tmp_path / "new" / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"], image.info["loop"]) == (12, (32, 32), 40, 0)
        for index in range(12):
            image.seek(index)
            shown = np.asarray(image.convert("RGB")).astype(int)
            assert np.abs(shown[::2, ::2] - frames[index].numpy()).max() <= 8


def test_gif_delay_is_one_that_browsers_keep(tmp_path):
    write_gif(tmp_path / "a.gif", blocks(3), fps=100, loop=False)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["duration"] == 20
        assert "loop" not in image.info


def test_side_by_side_places_panels_and_marks_the_phase():
    real, imagined = blocks(6), 255 - blocks(6)
    frames = side_by_side(torch.as_tensor(real), imagined, context=2, error=True, scale=3, border=4)
    side = 3 * 16 + 8
    assert frames.shape == (6, side, 3 * side, 3)
    assert frames.dtype == np.uint8
    inner = slice(4, 4 + 48)
    panels = [frames[:, inner, first + 4 : first + 52] for first in (0, side, 2 * side)]
    np.testing.assert_array_equal(panels[0][:, 1::3, 1::3], real)
    np.testing.assert_array_equal(panels[1][:, ::3, ::3], imagined)
    np.testing.assert_array_equal(panels[2][:, 2::3, ::3], np.abs(real.astype(int) - imagined))
    border = frames[:, 0, side + 5]
    np.testing.assert_array_equal(border, [CONTEXT_COLOR] * 2 + [OPEN_LOOP_COLOR] * 4)
    assert side_by_side(real, imagined, context=2).shape == (6, 72, 144, 3)


def test_moving_map_follows_the_drone():
    track = load_track("circle")
    frames = top_down_frames(track, flight(), size=128, tail=0.04)
    assert frames.shape == (11, 128, 128, 3)
    dark = [np.argwhere((frame < 80).all(-1)).mean(0) for frame in frames[:-1]]  # the dot is the only dark thing
    columns = np.array([column for _, column in dark])
    metres = np.diff(columns) * (8 + 2 * 1.6) / 128  # the map shows the gates and 1.6 m around them
    np.testing.assert_allclose(metres, 0.8, atol=0.15)
    assert np.abs(np.array([row for row, _ in dark]) - 64).max() < 2


def test_lost_state_can_be_drawn():
    trajectory = flight()
    trajectory.position[-1] = float("nan")
    assert len(top_down_frames(load_track("circle"), trajectory, size=64)) == 11


def test_onboard_beside_map():
    track = load_track("circle")
    frames = onboard_beside_map(track, flight(), size=64, gap=6)
    assert frames.shape == (11, 64, 64 + 6 + 64, 3)
    np.testing.assert_array_equal(frames[:, ::4, :64:4], blocks(11))
    assert (frames[:, :, 64:70] == 255).all()
    # A size that is no multiple of the images' grows to the next.
    np.testing.assert_array_equal(onboard_beside_map(track, flight(), size=60, gap=6), frames)
    assert onboard_beside_map(track, flight(), size=8, gap=6).shape == (11, 16, 16 + 6 + 16, 3)
    with pytest.raises(ValueError, match="16 × 12 pixels"):
        onboard_beside_map(track, replace(flight(), pixels=flight().pixels[:, :, :12]))
    with pytest.raises(ValueError, match="from_pixels=True"):
        onboard_beside_map(track, replace(flight(), pixels=None))


@pytest.mark.parametrize("frames", [np.zeros((2, 4, 4, 3)), blocks(2)[0], blocks(2)[:0], blocks(2)[..., :2]])
@pytest.mark.parametrize("write", [write_video, write_gif])
def test_wrong_frames_are_refused(tmp_path, write, frames):
    with pytest.raises(ValueError, match="wanted: uint8"):
        write(tmp_path / "file", frames)


def test_panels_of_different_sizes_are_refused():
    with pytest.raises(ValueError, match="must be equal"):
        side_by_side(blocks(3), blocks(2), context=1)
