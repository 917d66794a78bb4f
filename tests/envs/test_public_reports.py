"""Faults that users of other projects reported, as they would show here; the table is in docs/reliability.md."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

import dreamer_racing  # noqa: F401 - registers
from dreamer_racing.envs import DroneRacingEnv

NAME = "dreamer_racing/Circle-v0"
ACTION = np.array([[0.3, 0.2, 0.1, 0.5]] * 2, np.float32)


@pytest.fixture
def worlds():
    """Two of them, seen as numbers."""
    made = gymnasium.make_vec(NAME, num_envs=2, observation="vector")
    yield made
    made.close()


@pytest.mark.parametrize("observation", ["pixels", "vector"])
def test_what_was_seen_is_not_overwritten_by_the_next_step(observation: str) -> None:
    """google-deepmind/dm_control#34."""
    env = gymnasium.make(NAME, observation=observation)
    seen = [env.reset(seed=0)[0]]
    copies = [seen[0].copy()]
    for _ in range(3):
        seen.append(env.step(ACTION[0])[0])
        copies.append(seen[-1].copy())
    env.close()
    assert all(np.array_equal(one, copy) for one, copy in zip(seen, copies, strict=True))
    assert not np.array_equal(copies[1], copies[3])  # else nothing could have been noticed


def test_what_torchrl_saw_is_not_overwritten_by_the_next_step() -> None:
    """google-deepmind/dm_control#34, in tensors."""
    env = DroneRacingEnv(track="circle", num_envs=2, from_pixels=True)
    seen, copies, tensordict = [], [], env.reset()
    for _ in range(3):
        seen.append(tensordict["pixels"])
        copies.append(seen[-1].clone())
        tensordict = env.step(tensordict.set("action", torch.from_numpy(ACTION)))["next"].clone(recurse=False)
    env.close()
    assert all(map(torch.equal, seen, copies)) and not torch.equal(copies[0], copies[2])


def test_neighbouring_seeds_share_no_world() -> None:
    """DLR-RM/stable-baselines3#2268."""
    starts = []
    for seed in (0, 1):
        env = DroneRacingEnv(track="circle", num_envs=4, from_pixels=False, seed=seed, start_noise=1.0)
        starts += [tuple(place.tolist()) for place in env.reset()["privileged", "position"]]
        env.close()
    assert len(set(starts)) == 8


def test_float64_flies_as_float32_and_the_caller_s_array_is_left_alone(worlds) -> None:
    """Farama-Foundation/PettingZoo#1000, openai/gym#2188."""
    flown = []
    for kind in (np.float32, np.float64):
        worlds.reset(seed=1)
        given = (10 * ACTION).astype(kind)  # three of four beyond the bounds
        kept = given.copy()
        flown.append(worlds.step(given)[0])
        assert np.array_equal(given, kept)
    worlds.reset(seed=1)
    flown.append(worlds.step(np.clip(10 * ACTION, -1.0, 1.0))[0])
    assert np.array_equal(flown[0], flown[1]) and np.array_equal(flown[0], flown[2])


def test_a_seed_forgets_what_was_flown_before_it(worlds) -> None:
    """google-deepmind/lab#133."""
    begins = []
    for steps in (1, 4):
        worlds.reset(seed=5)
        for _ in range(steps):
            worlds.step(ACTION)
        begins.append(worlds.reset(seed=5)[0])
    assert np.array_equal(*begins)


def test_seeding_does_not_disturb_the_flight() -> None:
    """DLR-RM/stable-baselines3#1481."""
    pytest.importorskip("stable_baselines3")
    from dreamer_racing.envs.sb3_env import DroneRaceVecEnv

    flown = []
    for seeded in (False, True):
        env = DroneRaceVecEnv(track="circle", num_envs=2, observation="vector", seed=3)
        env.reset()
        env.step(ACTION)
        if seeded:
            env.seed(7)
        flown.append(env.step(ACTION)[0])
        env.close()
    assert np.array_equal(*flown)


def test_every_number_of_the_state_tells_something() -> None:
    """google-deepmind/dm_control#23."""
    env = DroneRacingEnv(track="circle", num_envs=8, from_pixels=False, seed=0)
    torch.manual_seed(0)
    seen = env.rollout(60, break_when_any_done=False)["vector"].flatten(0, 1)
    env.close()
    assert (seen.std(0) > 0.01).all()
