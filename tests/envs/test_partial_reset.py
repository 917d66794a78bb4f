"""Partial resets: what is seen after them is what TorchRL's own merge gives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.partial_reset import TransformedPixelEnv


class StockSteps(DroneRacingEnv):
    """The environment with TorchRL's steps and resets."""

    step_and_maybe_reset = EnvBase.step_and_maybe_reset


def make(kind: type[DroneRacingEnv] = DroneRacingEnv, **settings: Any) -> DroneRacingEnv:
    return kind("kidney", 4, seed=3, **{"privileged": False, "renderer": "warp", "num_threads": 1, **settings})


def flight(env: EnvBase, steps: int = 12) -> list[TensorDict]:
    """Step with partial resets, from the same seed."""
    torch.manual_seed(0)
    data, flown = env.reset(), []
    for _ in range(steps):
        data.set("action", torch.rand(4, 4) * 2 - 1)
        step, data = env.step_and_maybe_reset(data)
        flown += [step.clone(), data.clone()]
    return flown


def assert_same_flights(ours: EnvBase, stock: EnvBase) -> None:
    partial = 0
    for one, other in zip(flight(ours, 60), flight(stock, 60), strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        assert (one == other).all()
        done = one.get(("next", "done"), torch.zeros(4, 1, dtype=torch.bool))
        partial += bool(done.any() and not done.all())
    assert partial
    ours.close()
    stock.close()


@pytest.mark.parametrize("settings", [{"from_pixels": False}, {"from_pixels": False, "privileged": True}, {}], ids=str)
def test_steps_are_those_of_torchrl(settings: dict[str, Any]) -> None:
    assert_same_flights(make(**settings), make(StockSteps, **settings))


def test_images_are_those_of_torchrls_merge() -> None:
    assert_same_flights(TransformedPixelEnv(make(), InitTracker()), TransformedEnv(make(), InitTracker()))


@pytest.mark.parametrize("transformed", [False, True])
def test_the_step_before_keeps_its_images(transformed: bool) -> None:
    env = TransformedPixelEnv(make(), InitTracker()) if transformed else make()
    step = env.rand_step(env.reset())
    kept = step["next", "pixels"].clone()
    root = step["next"].clone(False).set("_reset", torch.tensor([[True], [False], [True], [False]]))
    merged = env.reset(root)["pixels"]
    assert torch.equal(step["next", "pixels"], kept)
    assert torch.equal(merged[1::2], kept[1::2])
    assert (merged[::2] != kept[::2]).flatten(1).any(1).all()
    env.close()
