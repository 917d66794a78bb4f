"""Cameras slower than control, by every front door: one frame for so many control steps, and none drawn in between."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from dreamer_racing.envs.dm_control_env import load
from dreamer_racing.envs.simulator.scene import Camera, frame_interval
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.worlds import RaceWorlds
from tests.interfaces import flights

STEPS, EVERY = 7, 4
ACTION = np.array([-0.1, 0.1, -0.1, 0.2], np.float32)
OPTIONS = {"preset": "faithful", "control_rate": 100.0, "camera": Camera(32, 32), "seed": 3}
CUDA = pytest.param("cuda", marks=pytest.mark.gpu)


def flown(num_envs: int, **arguments) -> Tensor:
    """Images (T, N, H, W, 3) of a reset and the control steps after it."""
    worlds = RaceWorlds("circle", num_envs, **{**OPTIONS, **arguments})
    worlds.reset()
    images = [worlds.render()]
    for _ in range(STEPS):
        worlds.step(torch.from_numpy(ACTION).expand(num_envs, 4).to(worlds.device))
        images.append(worlds.render())
    worlds.close()
    return torch.stack(images).cpu()


def held(images: Tensor) -> Tensor:
    """What a camera shows that takes every fourth of such images."""
    return torch.stack([images[step - step % EVERY] for step in range(len(images))])


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_frame_is_shown_until_the_next_one(device: str) -> None:
    fast = flown(3, device=device)
    assert not any(torch.equal(one, other) for one, other in pairwise(fast))
    assert torch.equal(flown(3, device=device, camera_rate=25.0), held(fast))
    assert torch.equal(flown(3, device=device, camera=Camera(32, 32, rate=25.0)), held(fast))
    assert torch.equal(flown(3, device=device, camera_rate=100.0), fast)


def test_what_is_not_shown_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    env = DroneRacingEnv("circle", 3, camera_rate=25.0, **OPTIONS)
    drawn: list[int] = []
    draw = env.worlds.simulator.render
    monkeypatch.setattr(env.worlds.simulator, "render", lambda rows: drawn.append(1) or draw(rows))
    env.rollout(2 * EVERY)
    env.close()
    assert len(drawn) == 1 + 2


def test_a_new_episode_begins_with_a_frame_of_its_own_and_the_others_keep_theirs() -> None:
    env = DroneRacingEnv("circle", 3, camera_rate=25.0, **OPTIONS)
    data = env.reset()
    action = torch.from_numpy(ACTION).expand(3, 4).clone()
    for _ in range(EVERY + 1):
        data = env.step(data.set("action", action))["next"].exclude("reward")
    before = data["pixels"].clone()
    data["done"][1] = True
    begun = env.maybe_reset(data)["pixels"]
    assert torch.equal(begun[[0, 2]], before[[0, 2]])
    assert not torch.equal(begun[1], before[1])
    assert torch.equal(begun[1], env.worlds.simulator.render()[1])
    # the next frame is of all cameras
    for expected in (False, False, True):
        shown = env.step(data.set("action", action))["next", "pixels"]
        assert torch.equal(shown, env.worlds.simulator.render()) is expected
    env.close()


def test_the_randomised_noise_of_a_frame_is_held_too() -> None:
    images = flown(2, camera_rate=25.0, looks="randomised")
    assert torch.equal(images, held(images))


def test_every_interface_gives_the_same_frames() -> None:
    expected = held(flown(1))[:, 0].numpy()
    for name, seen in flights(ACTION, STEPS, "pixels", **OPTIONS, camera_rate=25.0).items():
        assert np.array_equal(seen, expected), name


def test_dm_control_holds_its_frames() -> None:
    def images(camera_rate: float | None) -> np.ndarray:
        env = load("circle", "faithful", random=0, from_pixels=True, control_rate=100.0, camera_rate=camera_rate)
        seen = [env.reset(), *(env.step(ACTION) for _ in range(STEPS))]
        return np.stack([step.observation["pixels"] for step in seen])

    fast = images(None)
    assert not np.array_equal(fast[0], fast[1])
    assert np.array_equal(images(25.0), held(torch.from_numpy(fast)).numpy())


@pytest.mark.parametrize(
    ("camera_rate", "control_rate", "steps"), [(25, 50, 2), (30, 60, 2), (None, 50, 1), (50, 50, 1), (100 / 3, 100, 3)]
)
def test_frames_fall_on_control_steps(camera_rate: float | None, control_rate: float, steps: int) -> None:
    assert frame_interval(Camera(rate=camera_rate), control_rate) == steps


@pytest.mark.parametrize(
    ("camera_rate", "words"),
    [
        (30, "camera_rate=30 Hz: must be control_rate=50 divided by a whole number.*: 25 or 50 are the nearest"),
        (60, "camera_rate=60 Hz: must be at most control_rate=50"),
        ("25", "camera_rate='25': must be a number"),
        (float("nan"), "camera_rate=nan: must be above 0"),
    ],
)
def test_other_rates_are_refused(camera_rate: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        DroneRacingEnv("circle", 1, camera_rate=camera_rate)
    with pytest.raises(ValueError, match=words):
        load("circle", from_pixels=True, camera_rate=camera_rate)


def test_a_camera_rate_without_images_is_refused() -> None:
    for make in (DroneRacingEnv, load):
        with pytest.raises(ValueError, match="camera_rate=25: needs images, but from_pixels=False"):
            make("circle", from_pixels=False, camera_rate=25)
