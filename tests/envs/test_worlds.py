"""The worlds themselves, and their options that every environment hands on."""

from __future__ import annotations

import inspect

import pytest
import torch

from dreamer_racing.envs.worlds import RaceWorlds, WorldOptions

OF_ADAPTERS = {"self", "track", "num_envs", "preset", "from_pixels"}


def test_every_option_of_the_worlds_is_handed_on():
    parameters = inspect.signature(RaceWorlds.__init__).parameters
    assert set(parameters) - OF_ADAPTERS == set(WorldOptions.__annotations__)


@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_no_gradient_goes_back_to_the_action(preset: str) -> None:
    worlds = RaceWorlds("circle", 2, preset, from_pixels=False, seed=0)
    worlds.reset()
    leaf = torch.zeros(2, 4, requires_grad=True)
    for _ in range(3):
        outcome = worlds.step(torch.tanh(leaf))
    simulator = worlds.simulator
    kept = [
        *vars(outcome).values(),
        *vars(simulator.state).values(),
        *worlds.race.state_dict().values(),
        simulator.quadrotor.setpoints,
        simulator.quadrotor.rotor_speed,
    ]
    assert not any(tensor.requires_grad for tensor in kept)
