"""Flying by hand: what sticks ask for is what the drone is told, with or without a window."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.by_hand import (
    KEYBOARD_SHARE,
    FlightAbandonedError,
    HandPolicy,
    PygameSticks,
    StickPositions,
    axes_to_sticks,
    check_by_hand,
    keys_to_sticks,
)
from dreamer_racing.evaluation.evaluate import evaluate

IMAGE = np.zeros((8, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("sticks", "action"),
    [
        (StickPositions(), (-0.4, 0, 0, 0)),
        (StickPositions(roll=0.5, pitch=1.0, yaw=0.25), (-0.4, 0.5, 1.0, -0.25)),  # yaw right is −z
        (StickPositions(throttle=1.0), (1.0, 0, 0, 0)),
        (StickPositions(throttle=-1.0), (-1.0, 0, 0, 0)),
        (StickPositions(throttle=0.5), (0.3, 0, 0, 0)),  # half of the way from hovering to all
    ],
)
def test_sticks_are_actions(sticks, action):
    flown = HandPolicy(lambda image: sticks, -0.4)(TensorDict({"pixels": torch.zeros(1, 8, 8, 3)}, [1]))["action"]
    torch.testing.assert_close(flown, torch.tensor([action], dtype=torch.float32))


def test_keys_move_the_sticks_little_by_little_and_let_them_go():
    at = StickPositions()
    for _ in range(30):
        at = keys_to_sticks({"right": True, "down": True, "a": True, "w": True}, at)
    assert at == pytest.approx((KEYBOARD_SHARE, -KEYBOARD_SHARE, -KEYBOARD_SHARE, KEYBOARD_SHARE), rel=1e-3)
    assert 0 < keys_to_sticks({}, at).roll < at.roll
    assert keys_to_sticks({"left": True, "right": True}, StickPositions()) == StickPositions()


def test_a_gamepad_counts_forward_as_negative_and_trembles():
    assert axes_to_sticks({"roll": 0.5, "pitch": -1.0, "yaw": 0.01, "throttle": -0.25}) == (0.5, 1.0, 0.0, 0.25)


def test_a_script_flies_and_is_recorded_without_a_display():
    """Full throttle out of the hall: the camera's images arrive, and the flight is an episode like any other."""
    shown = []
    env = DroneRacingEnv("circle", 1, evaluation=True, renderer="warp", num_threads=1)

    def up(image: np.ndarray) -> StickPositions:
        shown.append(image)
        return StickPositions(throttle=1.0)

    result = evaluate(env, HandPolicy(up, env.worlds.parameters.hover_action), episodes=1)
    env.close()
    (flight,) = result.trajectories
    assert len(shown) == len(flight.action) > 5 and shown[0].shape == (64, 64, 3)
    assert flight.outcome == "out_of_bounds" and flight.position[-1, 2] > flight.position[0, 2] + 1.0
    assert (flight.action == torch.tensor([1.0, 0, 0, 0])).all()


def test_without_pygame_or_display_it_says_so(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match="pilot=keyboard needs a display"):
        check_by_hand("keyboard", {})
    check_by_hand("keyboard", {"DISPLAY": ":0"})
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pilot=gamepad needs the package pygame: .*pip install .*play"):
        check_by_hand("gamepad", {"DISPLAY": ":0"})


def test_a_window_shows_keeps_time_and_can_be_closed(monkeypatch):
    pygame = pytest.importorskip("pygame", reason="pip install 'dreamer_racing[play]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.raises(ValueError, match="there is no gamepad"):
        PygameSticks("gamepad", 0.02)
    sticks = PygameSticks("keyboard", control_dt=0.02)
    assert pygame.mixer.get_init() is None, "no sound, which many machines cannot play"
    assert sticks(IMAGE + 255) == StickPositions()
    assert pygame.display.get_surface().get_at((3, 3))[:3] == (255, 255, 255)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
    with pytest.raises(FlightAbandonedError):
        sticks(IMAGE)
    sticks.close()
