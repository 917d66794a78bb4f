"""Films: what is written, what is written over them, and the view from behind."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from dreamer_racing.envs.drone.parameters import load_preset
from dreamer_racing.envs.simulator import chase
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures import film
from dreamer_racing.figures.report import chase_beside_onboard
from tests.flights import level_flight, random_flight

PALETTE = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [240, 240, 240]], dtype=np.uint8)


def blocks(frames: int, height: int = 16, width: int = 16) -> np.ndarray:
    """Frame t is PALETTE[t % 4], its left upper quarter the next colour."""
    index = np.arange(frames) % 4
    video = np.repeat(PALETTE[index][:, None, None], height, axis=1).repeat(width, axis=2)
    video[:, : height // 2, : width // 2] = PALETTE[(index + 1) % 4][:, None, None]
    return video


def flight() -> Trajectory:
    """In 10 steps along x, from −4 to 4 m."""
    along = torch.tensor([1.0, 0.0, 0.0])
    moving = {"linear_velocity": (2.0 * along).repeat(11, 1), "pixels": torch.as_tensor(blocks(11))}
    return level_flight(torch.linspace(-4, 4, 11)[:, None] * along, **moving, outcome="ground")


@pytest.mark.parametrize(
    ("size", "scale", "expected"),
    [
        ((64, 40), None, (256, 160)),
        ((272, 20), None, (272, 20)),  # already large: not enlarged
        ((15, 21), 3, (46, 64)),  # H.264 wants even sizes
    ],
)
def test_video_reads_back(tmp_path, size, scale, expected):
    path = tmp_path / "new" / "video.mp4"
    frames = blocks(12, *size)
    assert film.write_video(path, frames, fps=50, scale=scale)
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
    [("a.mp4", film.write_video, film, "_make_even"), ("a.gif", film.write_gif, Image.Image, "save")],
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

    write(tmp_path / name, blocks(12, 256, 256))  # so large that ffmpeg has begun to write when the frames end
    before = (tmp_path / name).read_bytes()
    monkeypatch.setattr(owner, part, fails)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path / name, blocks(10, 256, 256))
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_without_ffmpeg_one_warning_stands_for_all_videos(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(film, "_finds_ffmpeg", cache(film._finds_ffmpeg.__wrapped__))  # that has found nothing yet
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: (_ for _ in ()).throw(RuntimeError("No ffmpeg.")))
    assert not any(film.write_video(tmp_path / f"{name}.mp4", blocks(3)) for name in "ab")
    assert not list(tmp_path.iterdir())
    assert [record.message for record in caplog.records] == [
        "no videos are written: No ffmpeg. For ffmpeg: pip install imageio-ffmpeg."
    ]


def test_gif_reads_back(tmp_path):
    frames = torch.as_tensor(blocks(12))
    size = film.write_gif(tmp_path / "new" / "a.gif", frames, fps=25, colors=16)
    assert size == (tmp_path / "new" / "a.gif").stat().st_size < 4000
    with Image.open(tmp_path / "new" / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"], image.info["loop"]) == (12, (16, 16), 40, 0)
        for index in range(12):
            image.seek(index)
            shown = np.asarray(image.convert("RGB")).astype(int)
            assert np.abs(shown - frames[index].numpy()).max() <= 8
    film.write_gif(tmp_path / "a.gif", blocks(3), fps=100)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["duration"] == 20  # ms, which browsers keep


def test_side_by_side_places_panels_and_marks_the_phase():
    real, imagined = blocks(6), 255 - blocks(6)
    frames = film.side_by_side(torch.as_tensor(real), imagined, context=2, scale=3)
    side = 3 * 16 + 8
    assert frames.shape == (6, side, 2 * side, 3) and frames.dtype == np.uint8
    left, right = (frames[:, 4:52, first + 4 : first + 52] for first in (0, side))
    np.testing.assert_array_equal(left[:, 1::3, 1::3], real)
    np.testing.assert_array_equal(right[:, ::3, ::3], imagined)
    np.testing.assert_array_equal(frames[:, 0, side + 5], [film.CONTEXT_COLOR] * 2 + [film.OPEN_LOOP_COLOR] * 4)


def test_moving_map_follows_the_drone(monkeypatch):
    track = load_track("circle")
    monkeypatch.setattr(film, "MAP_TAIL", 0.04)
    frames = film.top_down_frames(track, flight(), size=128)
    assert frames.shape == (11, 128, 128, 3)
    dark = [np.argwhere((frame < 80).all(-1)).mean(0) for frame in frames[:-1]]  # the dot is the only dark thing
    columns = np.array([column for _, column in dark])
    metres = np.diff(columns) * (8 + 2 * 1.6) / 128  # the map shows the gates and 1.6 m around them
    np.testing.assert_allclose(metres, 0.8, atol=0.15)
    assert np.abs(np.array([row for row, _ in dark]) - 64).max() < 2


def test_onboard_beside_map():
    track = load_track("circle")
    frames = film.onboard_beside_map(track, flight(), size=60)  # grows to the next multiple of the images'
    assert frames.shape == (11, 64, 64 + 8 + 64, 3)
    np.testing.assert_array_equal(frames[:, ::4, :64:4], blocks(11))
    assert (frames[:, :, 64:72] == 255).all()
    assert film.onboard_beside_map(track, flight(), size=8).shape == (11, 16, 16 + 8 + 16, 3)


@pytest.mark.parametrize("frames", [np.zeros((2, 4, 4, 3)), blocks(2)[0], blocks(2)[:0], blocks(2)[..., :2]])
@pytest.mark.parametrize("write", [film.write_video, film.write_gif])
def test_wrong_frames_are_refused(tmp_path, write, frames):
    with pytest.raises(ValueError, match="must be uint8"):
        write(tmp_path / "file", frames)


# Words on films: what they say of a race by hand, and that they cover nothing of it.


def test_time_speed_gate_and_lap_of_a_race():
    track = replace(load_track("circle"), laps=2)  # four gates
    flight = random_flight(steps=9)
    flight.target_gate[:] = torch.tensor([0, 0, 1, 2, 3, 0, 1, 2, 3, 0])
    flight.linear_velocity[:] = torch.tensor([3.0, 0.0, 4.0])
    flight.linear_velocity[4] = float("nan")
    words = film.race_words(track, flight)
    assert words[0] == " 0.00 s   5.0 m/s  gate 1/4  lap 1/2"
    assert words[4] == " 0.08 s   lost  gate 4/4  lap 1/2"
    assert words[5] == " 0.10 s   5.0 m/s  gate 1/4  lap 2/2"
    assert words[9].endswith("gate 1/4  lap 2/2")  # the race is over: there is no third lap


def test_a_lap_that_ends_in_a_step_of_two_gates_counts():
    flight = random_flight(steps=9)
    flight.target_gate[:] = torch.tensor([0, 2, 3, 1, 2, 3, 0, 0, 2, 0])
    assert film.laps_completed(flight).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]


def test_a_dream_says_what_it_has_seen():
    imagined = ["imagined +0.04 s", "imagined +0.08 s"]
    assert film.dream_words(3, context=2, frame_dt=0.08) == [film.SEEN, film.SEEN, imagined[1]]
    assert film.dream_words(5, 1, 0.04, cycle=3) == [film.SEEN, *imagined, film.SEEN, imagined[0]]


def test_words_stand_above_the_picture():
    frames = np.random.default_rng(0).integers(0, 256, (2, 30, 300, 3), dtype=np.uint8)
    captioned = film.caption(frames, ["1.00 s", "1.02 s"], [film.SEEN, "imagined +0.02 s"])
    strip = captioned.shape[1] - 30
    assert 12 < strip < 30 and captioned.shape[2] == 300
    np.testing.assert_array_equal(captioned[:, strip:], frames)
    for frame, color in zip(captioned, (film.CONTEXT_COLOR, film.OPEN_LOOP_COLOR), strict=True):
        letters = frame[:strip, 150:].reshape(-1, 3)
        distance = np.abs(letters.astype(int) - color).sum(-1)
        assert distance.min() < 40 and tuple(letters[0]) == film.STRIP_COLOR
    assert (captioned[0, :strip, :150] != captioned[1, :strip, :150]).any()


@pytest.mark.parametrize(("width", "right"), [(256, []), (528, [film.SEEN])])
def test_a_line_fits_into_its_strip(width, right):
    words = "12.34 s  12.3 m/s  gate 10/12  lap 3/3  8x slower"
    captioned = film.caption(np.zeros((1, 4, width, 3), np.uint8), [words], right)
    strip = captioned[0, : captioned.shape[1] - 4, : width // 2 if right else width]
    written = (strip != film.STRIP_COLOR).any((0, 2))
    assert written.any() and not written[-2:].any()


def test_short_flights_are_slowed():
    assert [film.slow_motion(seconds) for seconds in (12.0, 4.0, 1.5, 0.1, 0.0)] == [1, 1, 3, 8, 8]


# The view from outside: the drone is in it, the camera stays behind it and in the hall, and no display is needed.


LEVEL = np.array([[1.0, 0.0, 0.0, 0.0]])
GATE, BEGINNING = np.array([0]), np.array([0.0])


def view_of_circle(num_envs: int = 1) -> ChaseView:
    return ChaseView(load_track("circle"), load_preset("easy"), num_envs, size=64)


@pytest.fixture
def view() -> Iterator[ChaseView]:
    view = view_of_circle()
    yield view
    view.close()


def start() -> np.ndarray:
    return np.add([load_track("circle").start_position], (0.0, 0.0, 0.5))


def flight_of(rows: int, image_size: int = 16) -> Trajectory:
    """A drone that hovers at the start of Circle; its images are grey."""
    position = torch.tensor(start(), dtype=torch.float32).repeat(rows, 1)
    return level_flight(position, pixels=torch.full((rows, image_size, image_size, 3), 100, dtype=torch.uint8))


def test_the_drone_is_below_the_middle_of_the_picture_and_large_enough(view, monkeypatch) -> None:
    (frame,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    monkeypatch.setattr(chase, "DRONE_GROUP", chase.HALL_GROUP)
    (empty,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    rows, columns = np.nonzero((frame != empty).any(-1))
    assert 60 < len(rows) < 800, "the drone, and nothing but it: some percent of 64 × 64 pixels"
    assert abs(columns.mean() - 31.5) < 2 and 32 < rows.mean() < 50
    assert np.ptp(columns) > 10


def test_it_looks_towards_the_next_gate_whatever_the_drone_does(view) -> None:
    """The same picture of the hall for a drone that has turned; another for another gate."""
    turned = np.array([[math.cos(1.0), 0.0, 0.0, math.sin(1.0)]])
    (ahead,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    (askew,) = view.draw(start(), turned, GATE, BEGINNING)
    (other,) = view.draw(start(), LEVEL, GATE + 2, BEGINNING)
    assert 0.0 < (ahead != askew).any(-1).mean() < 0.3 < (ahead != other).any(-1).mean()
    orange = (ahead[..., 0] > 180) & (ahead[..., 1] < 90) & (ahead[..., 2] < 60)
    assert orange.sum() > 20, "the gate"


def test_the_camera_turns_to_the_next_gate_with_a_delay(view, monkeypatch) -> None:
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(view, "_film", lambda position, attitude, heading, out: drawn.append(heading.copy()))
    for gate, time in ((0, 0.0), (1, 0.02), (1, 0.02), *((1, 0.02 * row) for row in range(2, 200)), (0, 0.0)):
        view.draw(start(), LEVEL, np.array([gate]), np.array([time]))
    aims = [view._aims[gate] - start()[0, :2] for gate in (0, 1)]
    first, second = (aim / np.linalg.norm(aim) for aim in aims)
    share = 1 - math.exp(-0.02 / chase.TURNING_TIME)
    part = (1 - share) * first + share * second
    assert np.allclose(drawn[0], first)
    assert np.allclose(drawn[1], part / np.linalg.norm(part))
    assert np.allclose(drawn[2], drawn[1]), "asked twice at the same time, it shows the same"
    assert np.allclose(drawn[-2], second, atol=1e-3)
    assert np.allclose(drawn[-1], first), "an episode begins"
    steps = np.linalg.norm(np.diff(drawn[:-1], axis=0), axis=1)
    assert steps.max() < 2 * share


def test_the_eye_stays_in_the_hall(view) -> None:
    track, eyes = load_track("circle"), []
    view._scene.draw = lambda eye, *_: eyes.append(eye.copy())  # type: ignore[method-assign]
    for corner in ((track.bounds_low[0], track.bounds_low[1], 0.0), (track.bounds_high[0], track.bounds_high[1], 9.0)):
        for gate in range(track.num_gates):
            view.draw(np.array([corner]), LEVEL, np.array([gate]), BEGINNING)
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    assert len(eyes) == 2 * track.num_gates and all((low < eye).all() and (eye < high).all() for eye in eyes)


def test_each_drone_has_a_picture_of_its_own(view) -> None:
    both = view_of_circle(num_envs=2)
    places = np.concatenate((start(), np.add(start(), (1.0, 1.0, 0.0))))
    pictures = both.draw(places, LEVEL.repeat(2, 0), np.array([0, 1]), np.zeros(2))
    both.close()
    assert np.array_equal(pictures[0], view.draw(start(), LEVEL, GATE, BEGINNING)[0])
    assert np.array_equal(pictures[1], view.draw(places[1:], LEVEL, GATE + 1, BEGINNING)[0])


def test_beside_it_stands_what_the_drone_sees(view) -> None:
    trajectory = flight_of(2, image_size=20)
    frames = chase_beside_onboard(view, trajectory)
    outside = chase_beside_onboard(view, replace(trajectory, pixels=None))
    assert outside.shape == (2, 64, 64, 3) and frames.shape == (2, 64, 64 + 8 + 60, 3)
    assert np.array_equal(frames[:, :, :64], outside)
    assert (frames[:, 2:62, 72:] == 100).all() and (frames[:, :2, 64:] == 255).all()
    assert chase_beside_onboard(view, flight_of(1, image_size=100)).shape == (1, 64, 64 + 8 + 50, 3)


def test_a_flight_is_filmed_up_to_its_first_non_finite_state(view) -> None:
    trajectory = flight_of(3)
    trajectory.position[1:] = torch.nan
    frames = chase_beside_onboard(view, replace(trajectory, pixels=None))
    assert frames[0].any() and not frames[1:].any()


def test_without_opengl_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(backend: str, *_: object) -> None:
        raise RendererUnavailableError(f"{backend} needs a library, which is not installed.")

    monkeypatch.setattr(chase, "open_scene", missing)
    with pytest.raises(RendererUnavailableError, match=r"Only OpenGL can .* egl needs a .* osmesa needs a library"):
        view_of_circle()
