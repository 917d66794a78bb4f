"""What goes over Ray is what was sent, byte for byte."""

from __future__ import annotations

import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from dreamer_racing.experience.ray_arrays import as_arrays, as_tensors, pack_rollout, unpack_rollout


def sent(arrays: Any) -> Any:
    """Return what another process gets: arrays in memory that is not to be written."""
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(arrays, protocol=5, buffer_callback=buffers.append)
    assert len(buffers) == len(arrays.entries), "each in memory of its own, not within the pickle"
    return pickle.loads(data, buffers=[memoryview(buffer).toreadonly() for buffer in buffers])


def flown(worlds: int, steps: int) -> TensorDict:
    """A rollout as a collector makes it: observed before a step is what came of the last, or an episode begins."""
    after, begins = TensorDict(_observed(worlds, steps), [worlds, steps]), torch.rand(worlds, steps, 1) > 0.6
    before = TensorDict(_observed(worlds, steps), [worlds, steps])
    before[:, 1:] = torch.where(begins[:, 1:, 0], before[:, 1:], after[:, :-1])
    after.update({"reward": torch.randn(worlds, steps, 1), "is_init": torch.zeros_like(begins)})
    return before.update({"action": torch.randn(worlds, steps, 4), "is_init": begins, "next": after})


def _observed(worlds: int, steps: int) -> dict[str, Any]:
    return {
        "pixels": torch.randint(256, (worlds, steps, 4, 4, 3), dtype=torch.uint8),
        "race": TensorDict({"crash": torch.randint(9, (worlds, steps))}, [worlds, steps]),
        "belief": torch.randn(worlds, 5, steps).transpose(1, 2).half(),  # not contiguous
    }


@pytest.mark.parametrize("steps", [1, 4])
def test_rollouts_of_several_workers_arrive_side_by_side(steps: int) -> None:
    rollouts = [flown(worlds, steps) for worlds in (2, 3)]
    for given in (rollouts, rollouts[:1]):
        packed, expected = [sent(pack_rollout(rollout)) for rollout in given], torch.cat(given)
        arrived = unpack_rollout(*packed)
        assert arrived.batch_size == expected.batch_size and set(arrived.keys(True)) == set(expected.keys(True))
        for key, value in expected.items(True, True):
            assert arrived[key].dtype == value.dtype and torch.equal(arrived[key], value), key
        arrived.zero_()  # memory of its own


def test_each_observation_goes_once() -> None:
    """After its step; before it, too, where a rollout or an episode begins."""
    rollout = flown(worlds=3, steps=4)
    begins = rollout["is_init"][..., 0].clone()
    begins[:, 0] = True
    packed = pack_rollout(rollout).entries
    for key in ("pixels", ("race", "crash"), "belief"):
        assert len(packed[key]) == begins.sum() < rollout.numel()
    assert packed["next", "pixels"].shape[:2] == packed["action"].shape[:2] == (3, 4)


def test_weights_arrive_in_another_module() -> None:
    one, other = (nn.Sequential(nn.Linear(3, 4), nn.Sequential(nn.BatchNorm1d(4))) for _ in range(2))
    TensorDict.from_module(other).data.update_(as_tensors(sent(as_arrays(TensorDict.from_module(one)))))
    for key, value in one.state_dict().items():
        assert torch.equal(other.state_dict()[key], value), key
