"""Environments that are copied, saved and restored, or never closed."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.envs import Camera, ControlSuiteEnv, DroneRacingEnv, load
from dreamer_racing.envs.tracks import load_track
from tests.running_recipes import python

SMALL = Camera(16, 16)
ENVIRONMENTS: dict[str, Callable[[], Any]] = {
    "DroneRacingEnv": lambda: DroneRacingEnv("circle", from_pixels=False),
    "gymnasium": lambda: gymnasium.make("dreamer_racing/Circle-v0", observation="vector"),
    "make_vec": lambda: gymnasium.make_vec("dreamer_racing/Circle-v0", num_envs=2, observation="vector"),
    "dm_control": lambda: load("circle", random=0),
    "physics": lambda: load("circle", random=0).physics,
}


@pytest.mark.parametrize("way", [copy.deepcopy, pickle.dumps], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_copying_a_race_is_refused(name: str, way: Callable[[Any], Any]) -> None:
    with pytest.raises(TypeError, match=r"cannot be copied or pickled: make (another|new ones)"):
        way(ENVIRONMENTS[name]())


@pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
def test_a_copy_of_the_control_suite_goes_on_as_the_original_does(way: Callable[[Any], Any]) -> None:
    env = ControlSuiteEnv("cartpole_swingup", num_envs=1, from_pixels=False, seed=0)
    env.reset()
    action = torch.full((1, 1), 0.5)
    flown = [world.rollout(5, policy=lambda vector: action)["next", "vector"] for world in (way(env), env)]
    torch.testing.assert_close(*flown)


def test_a_track_is_copied() -> None:
    track = load_track("kidney")
    assert copy.deepcopy(track) == pickle.loads(pickle.dumps(track)) == track


# An environment restored from its state goes on exactly as the one it was taken from.


def through_a_file(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    "settings",
    [
        {"preset": "easy", "from_pixels": False},
        {"preset": "faithful", "from_pixels": False},
        {"preset": "faithful", "looks": "randomised"},
        {"preset": "faithful", "camera_rate": 12.5},  # saved between two frames
        {"preset": "faithful", "imu": "noisy"},
    ],
    ids=str,
)
def test_restored_worlds_go_on_bit_for_bit(settings: dict[str, Any]) -> None:
    def make(seed: int) -> DroneRacingEnv:
        return DroneRacingEnv("circle", 6, camera=SMALL, seed=seed, episode_steps=30, **settings)

    torch.manual_seed(0)
    env, other = make(1), make(2)
    env.rollout(25, break_when_any_done=False)
    other.rollout(3, break_when_any_done=False)
    env.body_rate_weight = 0.004
    other.load_state_dict(through_a_file(env.state_dict()))
    assert other.body_rate_weight == 0.004
    root = TensorDict({}, [6])  # neither is observed here: images have noise from the generator
    for _ in range(60):  # past the end of every episode: resets draw from the restored generator
        action = torch.rand(6, 4) * 2 - 1
        steps = [each.step(root.clone().set("action", action))["next"] for each in (env, other)]
        assert (steps[0] == steps[1]).all()
        if steps[0]["done"].any():
            resets = [each.reset(root.clone().set("_reset", steps[0]["done"])) for each in (env, other)]
            assert (resets[0] == resets[1]).all()


@pytest.mark.parametrize(
    ("saved", "here", "words"),
    [
        ({}, {"num_envs": 3}, "2 worlds, but there are 3 here: resume with num_envs=2"),
        ({"camera_rate": 25.0}, {}, "another camera_rate"),
        ({"imu": "exact"}, {}, "another imu"),
    ],
    ids=str,
)
def test_a_state_of_other_worlds_is_refused(saved: dict[str, Any], here: dict[str, Any], words: str) -> None:
    env, other = (
        DroneRacingEnv(**{"track": "circle", "num_envs": 2, "camera": SMALL, **each}) for each in (saved, here)
    )
    with pytest.raises(ValueError, match=words):
        other.load_state_dict(env.state_dict())
    for each in (env, other):
        each.close()


def test_a_state_of_another_device_is_refused() -> None:
    env = DroneRacingEnv("circle", 2, from_pixels=False, seed=0)
    state = env.state_dict()
    state["worlds"]["generator"] = torch.zeros(16, dtype=torch.uint8)  # as a CUDA generator's
    with pytest.raises(ValueError, match="worlds were on cuda, these are on cpu.*env.device=cuda"):
        env.load_state_dict(state)


# Programs that end without closing their environments end well.


PROGRAM = """
import os
import sys

import gymnasium
import torch  # what takes long is imported once, before the processes part

import dreamer_racing.envs.gym_vector_env
import dreamer_racing.envs.sb3_env
from dreamer_racing.envs import DroneRacingEnv

for number in range(20):
    child = os.fork()
    if not child:
        break
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status:
        sys.exit(f"process {number} ended with {status}")
else:
    sys.exit()
KINDS = (
    lambda: gymnasium.make("dreamer_racing/Circle-v0"),
    lambda: gymnasium.make_vec("dreamer_racing/Circle-v0", num_envs=2),
    lambda: dreamer_racing.envs.sb3_env.DroneRaceVecEnv("circle", 2),
    lambda: DroneRacingEnv("circle", 2),
)
envs = [KINDS[kind % 4]() for kind in range(number, number + 1 + (number < 4))]  # two kinds at once, or one
for env in envs:
    env.reset()
    print("drawn")
"""


@pytest.mark.slow
def test_twenty_processes_that_close_nothing_end_with_status_zero() -> None:
    pytest.importorskip("stable_baselines3")
    done = python("-c", PROGRAM, timeout=900, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["drawn"] * 24
