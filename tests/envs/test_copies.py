"""What is copied or pickled works as the original does, or is refused at once, in words."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
import torch

from dreamer_racing.envs import ControlSuiteEnv, DroneRacingEnv, load
from dreamer_racing.envs.tracks import load_track

ENVIRONMENTS: dict[str, Callable[[], Any]] = {
    "DroneRacingEnv": lambda: DroneRacingEnv("circle", from_pixels=False),
    "gymnasium": lambda: gymnasium.make("dreamer_racing/Circle-v0", observation="vector"),
    "make_vec": lambda: gymnasium.make_vec("dreamer_racing/Circle-v0", num_envs=2, observation="vector"),
    "dm_control": lambda: load("circle", random=0),
    "physics": lambda: load("circle", random=0).physics,
}


@pytest.mark.parametrize("way", [copy.deepcopy, pickle.dumps], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_race_is_refused_in_words(name: str, way: Callable[[Any], Any]) -> None:
    with pytest.raises(TypeError, match=r"cannot be copied or pickled: make (another|others)"):
        way(ENVIRONMENTS[name]())


def test_so_is_the_copy_that_dm_control_offers() -> None:
    with pytest.raises(TypeError, match="cannot be copied or pickled: make another by load"):
        load("circle", random=0).physics.copy()


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
