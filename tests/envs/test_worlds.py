"""The worlds themselves, and their options that every environment hands on."""

from __future__ import annotations

import gc
import inspect
import os
import signal
import traceback
from collections.abc import Callable

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

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


def test_changes_of_action_cost_what_they_are_weighed_with_but_not_over_a_reset() -> None:
    weight, actions = 0.1, 0.5 * torch.rand(4, 2, 4, generator=torch.Generator().manual_seed(0)) - 0.5
    plain, weighed = (
        RaceWorlds("circle", 2, from_pixels=False, seed=0, action_change_weight=value) for value in (0.0, weight)
    )
    plain.reset()
    weighed.reset()
    for step, action in enumerate(actions):
        expected = plain.step(action).reward_base
        if step:
            expected = expected - weight * (action - actions[step - 1]).square().sum(1)
        torch.testing.assert_close(weighed.step(action).reward_base, expected)
    mask = torch.tensor([True, False])
    plain.reset(mask)
    weighed.reset(mask)
    lost = plain.step(actions[0]).reward_base - weighed.step(actions[0]).reward_base
    torch.testing.assert_close(
        lost, torch.stack((torch.zeros(()), weight * (actions[0, 1] - actions[3, 1]).square().sum()))
    )
    other = RaceWorlds("circle", 2, from_pixels=False, seed=1, action_change_weight=weight)
    other.load_state_dict(weighed.state_dict())
    assert torch.equal(other.step(actions[1]).reward_base, weighed.step(actions[1]).reward_base)
    assert (
        RaceWorlds("circle", from_pixels=False, evaluation=True, action_change_weight=1.0).action_change_weight == 0.0
    )


@pytest.mark.parametrize(("lives", "acts"), [("cuda:0", "cuda:1"), ("cuda:0", "cpu"), ("cpu", "cuda:0")])
def test_an_action_on_another_device_is_refused(lives: str, acts: str) -> None:
    worlds = RaceWorlds("circle", 2, from_pixels=False, seed=0)
    worlds.reset()
    worlds.device = torch.device(lives)
    with FakeTensorMode():
        action = torch.zeros(2, 4, device=acts)
        with pytest.raises(ValueError, match=f"Action on {acts}: these worlds live on {lives}"):
            worlds.step(action)


def in_a_fork(work: Callable[[], None]) -> bool:
    """Whether a forked process did its work, without an error and in less than 20 s."""
    if child := os.fork():
        return os.waitpid(child, 0)[1] == 0
    signal.alarm(20)
    try:
        work()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.parametrize("from_pixels", [False, True])
def test_a_forked_process_is_told_instead_of_waiting_for_ever(from_pixels: bool) -> None:
    made = [RaceWorlds("circle", 2, from_pixels=from_pixels, renderer="warp", num_threads=2, seed=0)]
    made[0].reset()

    def told() -> None:
        for work in (made[0].reset, made[0].render, lambda: made[0].step(torch.zeros(2, 4))):
            with pytest.raises(RuntimeError, match="was forked from it.*by multiprocessing's 'spawn'"):
                work()

    def freed() -> None:
        made.clear()
        gc.collect()

    for work in (told, lambda: made[0].close(), freed):
        assert in_a_fork(work)
    made[0].step(torch.zeros(2, 4))
    made[0].close()
