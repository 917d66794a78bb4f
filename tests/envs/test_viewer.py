"""Windows on the race, without one: what a viewer is given, and what is said where none can open."""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dreamer_racing.envs import viewer
from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.torchrl_env import DroneRacingEnv


class StandIn:
    """In place of the handle of MuJoCo's viewer: keeps what it is given, and is closed after so many pictures."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, pictures: int) -> None:
        self.model, self.data, self.left = model, data, pictures
        self.cam = mujoco.MjvCamera()
        self.poses: list[np.ndarray] = []
        self.texts: list[tuple] = []
        self.images: list[tuple[mujoco.MjrRect, np.ndarray]] = []
        self.closed = False

    @property
    def viewport(self) -> mujoco.MjrRect:
        assert self.is_running(), "MuJoCo's is a segmentation fault"
        return mujoco.MjrRect(0, 0, 800, 600)

    def is_running(self) -> bool:
        return self.left > 0

    def lock(self) -> nullcontext:
        return nullcontext()

    def set_texts(self, texts: tuple) -> None:
        self.texts.append(texts)

    def set_images(self, placed: tuple[mujoco.MjrRect, np.ndarray]) -> None:
        self.images.append(placed)

    def sync(self) -> None:
        self.poses.append(self.data.qpos.copy())
        self.left -= 1

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[StandIn]:
    """The windows that were opened; each is closed after four pictures."""
    opened: list[StandIn] = []

    def launch_passive(model: mujoco.MjModel, data: mujoco.MjData, **hidden: bool) -> StandIn:
        assert hidden == {"show_left_ui": False, "show_right_ui": False}
        opened.append(StandIn(model, data, pictures=4))
        return opened[-1]

    stand_in = SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", stand_in)
    monkeypatch.setattr(mujoco, "viewer", stand_in, raising=False)
    monkeypatch.setattr(viewer, "check_window", lambda: None)
    return opened


def test_window_shows_the_drone_its_race_and_what_its_camera_sees(windows: list[StandIn]) -> None:
    env = DroneRacingEnv("circle", num_envs=1, evaluation=True, seed=0)
    window = viewer.RaceWindow(env.worlds)
    (seen,) = windows
    begun, flight = time.monotonic(), env.reset()
    for _ in range(4):
        window.show(flight)
        shown = flight
        flight = env.step_mdp(env.rand_step(flight))
    assert time.monotonic() - begun > 3 * 0.02, "at the speed of time"
    with pytest.raises(viewer.WindowClosedError):
        window.show(flight)
    window.close()
    env.close()
    state = shown["privileged"]
    np.testing.assert_allclose(seen.poses[-1], np.concatenate((state["position"][0], state["attitude"][0])))
    speed = state["linear_velocity"].norm()
    assert seen.texts[-1][2:] == ("lap\ngate\nspeed", f"1/3\n1/4\n{speed:.1f} m/s")
    place, image = seen.images[-1]
    assert (place.left + place.width, place.bottom, image.shape) == (800 - 8, 8, (192, 192, 3))
    np.testing.assert_array_equal(image[1::3, 1::3], shown["pixels"][0].numpy())
    assert seen.closed and seen.cam.trackbodyid == seen.model.body("drone").id
    groups = {seen.model.geom(index).name: seen.model.geom_group[index] for index in range(seen.model.ngeom)}
    assert groups["ceiling"] == groups["wall_x+"] == 4 and groups["floor"] == groups["gate_0"] == 0


def test_window_that_is_closed_while_it_takes_texts_is_not_asked_for_its_size(windows: list[StandIn]) -> None:
    env = DroneRacingEnv("circle", num_envs=1, evaluation=True, seed=0)
    window = viewer.RaceWindow(env.worlds)
    windows[0].set_texts = lambda texts: setattr(windows[0], "left", 0)
    with pytest.raises(viewer.WindowClosedError):
        window.show(env.reset())
    assert windows[0].images == []
    env.close()


def test_window_on_a_flight_by_numbers_has_no_inset(windows: list[StandIn]) -> None:
    env = DroneRacingEnv("circle", num_envs=1, from_pixels=False, evaluation=True, seed=0)
    viewer.RaceWindow(env.worlds).show(env.reset())
    assert len(windows[0].poses) == 1 and windows[0].images == []


def test_viewer_without_display_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    with pytest.raises(viewer.ViewerUnavailableError, match="no display.*ssh -X") as caught:
        viewer.check_viewer({})
    assert "\n" not in str(caught.value)
    with pytest.raises(viewer.ViewerUnavailableError, match="MUJOCO_GL=egl selects rendering without a window"):
        viewer.check_viewer({"DISPLAY": ":0", "MUJOCO_GL": "egl"})


def test_viewer_without_opengl_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    monkeypatch.setattr(viewer, "loads", lambda library: False)
    with pytest.raises(viewer.ViewerUnavailableError, match="no OpenGL library libGL"):
        viewer.check_viewer({"DISPLAY": ":0"})


def test_viewer_gets_the_environment_and_a_hovering_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    launched = []
    monkeypatch.setattr(viewer, "check_viewer", lambda: None)
    monkeypatch.setattr("dm_control.viewer.launch", lambda env, policy: launched.append((env, policy)))
    viewer.view("circle", replace(PRESETS["easy"], physics_dt=0.004), random=0)
    env, policy = launched[0]
    time_step = env.reset()
    for _ in range(3):
        time_step = env.step(policy(time_step))
    assert not time_step.last()
