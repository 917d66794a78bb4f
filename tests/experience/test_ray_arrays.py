"""What goes over Ray is what was sent, byte for byte."""

from __future__ import annotations

import pickle
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from dreamer_racing.experience.ray_arrays import as_arrays, as_tensors


def sent(arrays: Any) -> Any:
    """Return what another process gets: arrays in memory that is not to be written."""
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(arrays, protocol=5, buffer_callback=buffers.append)
    assert len(buffers) == len(arrays.entries), "each in memory of its own, not within the pickle"
    return pickle.loads(data, buffers=[memoryview(buffer).toreadonly() for buffer in buffers])


def test_rollouts_of_several_workers_arrive_side_by_side() -> None:
    rollouts = [
        TensorDict(
            {
                "pixels": torch.randint(256, (worlds, 3, 4, 4, 3), dtype=torch.uint8),
                "next": {"done": torch.rand(worlds, 3, 1) > 0.5, "race": {"crash": torch.arange(3).expand(worlds, 3)}},
                "belief": torch.randn(worlds, 5, 3, 1).transpose(1, 2).half(),  # not contiguous
            },
            [worlds, 3],
        )
        for worlds in (2, 1)
    ]
    for given in (rollouts, rollouts[:1]):
        arrived, expected = as_tensors(*(sent(as_arrays(rollout)) for rollout in given)), torch.cat(given)
        assert arrived.batch_size == expected.batch_size and set(arrived.keys(True)) == set(expected.keys(True))
        for key, value in expected.items(True, True):
            assert arrived[key].dtype == value.dtype and torch.equal(arrived[key], value), key
        arrived["pixels"].zero_()  # memory of its own


def test_weights_arrive_in_another_module() -> None:
    one, other = (nn.Sequential(nn.Linear(3, 4), nn.Sequential(nn.BatchNorm1d(4))) for _ in range(2))
    TensorDict.from_module(other).data.update_(as_tensors(sent(as_arrays(TensorDict.from_module(one)))))
    for key, value in one.state_dict().items():
        assert torch.equal(other.state_dict()[key], value), key
