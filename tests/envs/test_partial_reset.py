"""Images merged by row are those that TorchRL's own merge gives."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.partial_reset import MergesImagesByRow, TransformedPixelEnv


class StockMerge(DroneRacingEnv):
    """The environment with TorchRL's merge."""

    _reset_proc_data = EnvBase._reset_proc_data


def flight(env: EnvBase, steps: int = 12) -> list[TensorDict]:
    """Step with partial resets, from the same seed."""
    torch.manual_seed(0)
    data, flown = env.reset(), []
    for _ in range(steps):
        data.set("action", torch.rand(4, 4) * 2 - 1)
        step, data = env.step_and_maybe_reset(data)
        flown += [step.clone(), data.clone()]
    return flown


@pytest.mark.parametrize("transformed", [False, True])
def test_images_are_those_of_torchrls_merge(transformed: bool) -> None:
    def make(kind: type[DroneRacingEnv], wrapper: type[TransformedEnv]) -> EnvBase:
        env = kind("kidney", 4, seed=3, privileged=False, renderer="warp", num_threads=1)
        return wrapper(env, InitTracker()) if transformed else env

    ours, stock = make(DroneRacingEnv, TransformedPixelEnv), make(StockMerge, TransformedEnv)
    partial = 0
    for one, other in zip(flight(ours, 60), flight(stock, 60), strict=True):
        assert (one == other).all()
        done = one.get(("next", "done"), torch.zeros(4, 1, dtype=torch.bool))
        partial += bool(done.any() and not done.all())
    assert partial
    ours.close()
    stock.close()


def test_the_step_before_keeps_its_images() -> None:
    env = DroneRacingEnv("kidney", 4, seed=3, privileged=False, renderer="warp", num_threads=1)
    step = env.rand_step(env.reset())
    kept = step["next", "pixels"].clone()
    root = step["next"].clone(False).set("_reset", torch.tensor([[True], [False], [True], [False]]))
    merged = env.reset(root)["pixels"]
    assert torch.equal(step["next", "pixels"], kept)
    assert torch.equal(merged[1::2], kept[1::2])
    assert (merged[::2] != kept[::2]).flatten(1).any(1).all()
    assert issubclass(type(env), MergesImagesByRow)
    env.close()
