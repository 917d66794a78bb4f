"""The view from outside: the drone is in it, the camera stays behind it and in the hall, and no display is needed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamer_racing.envs.drone.parameters import load_preset
from dreamer_racing.envs.simulator import chase
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.chase import chase_beside_onboard, chase_frames

LEVEL = np.array([[1.0, 0.0, 0.0, 0.0]])
GATE, BEGINNING = np.array([0]), np.array([0.0])


def view_of_circle(size: int = 64, num_envs: int = 1) -> ChaseView:
    return ChaseView(load_track("circle"), load_preset("easy"), num_envs, size)


def start() -> np.ndarray:
    return np.add([load_track("circle").start_position], (0.0, 0.0, 0.5))


def flight(rows: int, image_size: int = 16) -> Trajectory:
    """A drone that hovers at the start of Circle; its images are grey."""
    position = torch.tensor(start(), dtype=torch.float32).expand(rows, 3).clone()
    attitude = torch.tensor(LEVEL, dtype=torch.float32).expand(rows, 4)
    gate = torch.zeros(rows, dtype=torch.int64)
    pixels = torch.full((rows, image_size, image_size, 3), 100, dtype=torch.uint8)
    return Trajectory(position, attitude, torch.zeros(rows, 3), gate, torch.zeros(rows - 1, 4), pixels, 0.02, None)


def test_the_drone_is_below_the_middle_of_the_picture_and_large_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    view = view_of_circle()
    (frame,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    monkeypatch.setattr(chase, "DRONE_GROUP", chase.HALL_GROUP)
    (empty,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    view.close()
    rows, columns = np.nonzero((frame != empty).any(-1))
    assert 60 < len(rows) < 800, "the drone, and nothing but it: some percent of 64 × 64 pixels"
    assert abs(columns.mean() - 31.5) < 2 and 32 < rows.mean() < 50
    assert np.ptp(columns) > 10


def test_it_looks_towards_the_next_gate_whatever_the_drone_does() -> None:
    """The same picture of the hall for a drone that has turned; another for another gate."""
    view = view_of_circle()
    turned = np.array([[math.cos(1.0), 0.0, 0.0, math.sin(1.0)]])
    (ahead,) = view.draw(start(), LEVEL, GATE, BEGINNING)
    (askew,) = view.draw(start(), turned, GATE, BEGINNING)
    (other,) = view.draw(start(), LEVEL, GATE + 2, BEGINNING)
    view.close()
    assert 0.0 < (ahead != askew).any(-1).mean() < 0.3 < (ahead != other).any(-1).mean()
    orange = (ahead[..., 0] > 180) & (ahead[..., 1] < 90) & (ahead[..., 2] < 60)
    assert orange.sum() > 20, "the gate"


def test_the_camera_turns_to_the_next_gate_with_a_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    view = view_of_circle()
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(view, "_film", lambda position, attitude, heading, out: drawn.append(heading.copy()))
    for gate, time in ((0, 0.0), (1, 0.02), (1, 0.02), *((1, 0.02 * row) for row in range(2, 200)), (0, 0.0)):
        view.draw(start(), LEVEL, np.array([gate]), np.array([time]))
    view.close()
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


def test_the_eye_stays_in_the_hall() -> None:
    track = load_track("circle")
    view, eyes = view_of_circle(), []
    view._scene.draw = lambda eye, *_: eyes.append(eye.copy())  # type: ignore[method-assign]
    for corner in ((track.bounds_low[0], track.bounds_low[1], 0.0), (track.bounds_high[0], track.bounds_high[1], 9.0)):
        for gate in range(track.num_gates):
            view.draw(np.array([corner]), LEVEL, np.array([gate]), BEGINNING)
    view.close()
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    assert len(eyes) == 2 * track.num_gates and all((low < eye).all() and (eye < high).all() for eye in eyes)


def test_each_drone_has_a_picture_of_its_own() -> None:
    view, alone = view_of_circle(num_envs=2), view_of_circle()
    places = np.concatenate((start(), np.add(start(), (1.0, 1.0, 0.0))))
    pictures = view.draw(places, LEVEL.repeat(2, 0), np.array([0, 1]), np.zeros(2))
    assert np.array_equal(pictures[0], alone.draw(start(), LEVEL, GATE, BEGINNING)[0])
    assert np.array_equal(pictures[1], alone.draw(places[1:], LEVEL, GATE + 1, BEGINNING)[0])
    view.close()
    alone.close()


def test_beside_it_stands_what_the_drone_sees() -> None:
    trajectory = flight(2)
    view = view_of_circle(size=60)
    frames = chase_beside_onboard(view, trajectory)
    outside = chase_frames(view, trajectory)
    assert frames.shape == (2, 60, 60 + 8 + 48, 3)
    assert np.array_equal(frames[:, :, :60], outside)
    assert (frames[:, 6:54, 68:] == 100).all() and (frames[:, :6, 60:] == 255).all()
    large = chase_beside_onboard(view, flight(1, image_size=100))
    assert large.shape == (1, 60, 60 + 8 + 50, 3)
    assert np.array_equal(chase_beside_onboard(view, replace(trajectory, pixels=None)), outside)
    view.close()


def test_a_flight_that_ends_with_numbers_that_are_none_is_filmed_as_far_as_it_goes() -> None:
    trajectory = flight(3)
    trajectory.position[1:] = torch.nan
    view = view_of_circle(size=32)
    frames = chase_frames(view, trajectory)
    view.close()
    assert frames[0].any() and not frames[1:].any()


def test_without_opengl_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(backend: str) -> None:
        raise RendererUnavailableError(f"{backend} needs a library, which is not installed.")

    monkeypatch.setattr(chase, "require_library", missing)
    with pytest.raises(RendererUnavailableError, match=r"by OpenGL alone, .* egl needs a .* osmesa needs a library"):
        view_of_circle()
