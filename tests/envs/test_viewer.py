"""Windows on the race, without one: what a viewer is given, and what is said where none can open."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import mujoco
import numpy as np
import pytest

from dreamer_racing.envs import viewer
from dreamer_racing.envs.torchrl_env import DroneRacingEnv

# What MuJoCo's handle has, and what its stand-in keeps.
HANDLE = ["cam", "viewport", "is_running", "lock", "set_texts", "set_images", "sync", "close", "model", "poses"]


@pytest.fixture
def handle(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """In place of the handle of MuJoCo's viewer: keeps what it is given, and is closed after four pictures."""
    handle = MagicMock(spec=HANDLE, cam=mujoco.MjvCamera(), poses=[], viewport=mujoco.MjrRect(0, 0, 800, 600))
    handle.is_running.side_effect = lambda: handle.sync.call_count < 4

    def launch_passive(model: mujoco.MjModel, data: mujoco.MjData, **hidden: bool) -> MagicMock:
        assert hidden == {"show_left_ui": False, "show_right_ui": False}
        handle.model = model
        handle.sync.side_effect = lambda: handle.poses.append(data.qpos.copy())
        return handle

    stand_in = SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", stand_in)
    monkeypatch.setattr(mujoco, "viewer", stand_in, raising=False)
    monkeypatch.setattr(viewer, "check_window", lambda: None)
    return handle


def test_window_shows_the_drone_its_race_and_what_its_camera_sees(handle: MagicMock) -> None:
    env = DroneRacingEnv("circle", num_envs=1, evaluation=True, seed=0)
    window = viewer.RaceWindow(env.worlds)
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
    np.testing.assert_allclose(handle.poses[-1], np.concatenate((state["position"][0], state["attitude"][0])))
    speed = state["linear_velocity"].norm()
    (texts,), ((place, image),) = handle.set_texts.call_args.args, handle.set_images.call_args.args
    assert texts[2:] == ("lap\ngate\nspeed", f"1/3\n1/4\n{speed:.1f} m/s")
    assert (place.left + place.width, place.bottom, image.shape) == (800 - 8, 8, (192, 192, 3))
    np.testing.assert_array_equal(image[1::3, 1::3], shown["pixels"][0].numpy())
    model = handle.model
    assert handle.close.called and handle.cam.trackbodyid == model.body("drone").id
    groups = {model.geom(index).name: model.geom_group[index] for index in range(model.ngeom)}
    assert groups["ceiling"] == groups["wall_x+"] == 4 and groups["floor"] == groups["gate_0"] == 0


def test_window_that_is_closed_while_it_takes_texts_is_not_asked_for_its_size(handle: MagicMock) -> None:
    env = DroneRacingEnv("circle", num_envs=1, evaluation=True, seed=0)
    window = viewer.RaceWindow(env.worlds)
    handle.is_running.side_effect = lambda: not handle.set_texts.called
    del handle.viewport  # MuJoCo's is a segmentation fault
    with pytest.raises(viewer.WindowClosedError):
        window.show(env.reset())
    assert not handle.set_images.called
    env.close()


def test_window_on_a_flight_by_numbers_has_no_inset(handle: MagicMock) -> None:
    env = DroneRacingEnv("circle", num_envs=1, from_pixels=False, evaluation=True, seed=0)
    viewer.RaceWindow(env.worlds).show(env.reset())
    assert len(handle.poses) == 1 and not handle.set_images.called


def test_viewer_without_display_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    with pytest.raises(viewer.ViewerUnavailableError, match="no display.*ssh -X") as caught:
        viewer.check_window({})
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(viewer, "loads", lambda library: False)
    with pytest.raises(viewer.ViewerUnavailableError, match="no OpenGL library libGL"):
        viewer.check_window({"DISPLAY": ":0"})
