"""Weights in a safetensors file: the bytes by hand, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from dreamer_racing.export.weights_file import read_weights, write_weights

WEIGHTS = {"b": torch.tensor([[1.0, -2.0], [0.5, 3e-8]]), "a": torch.tensor(7.0), "empty": torch.zeros(0, 3)}


def test_the_bytes_by_hand(tmp_path: Path) -> None:
    extents = write_weights(tmp_path / "weights", WEIGHTS)
    content = (tmp_path / "weights").read_bytes()
    first = 8 + int.from_bytes(content[:8], "little")
    assert first % 8 == 0 and json.loads(content[8:first]) == {
        "a": {"dtype": "F32", "shape": [], "data_offsets": [0, 4]},
        "b": {"dtype": "F32", "shape": [2, 2], "data_offsets": [4, 20]},
        "empty": {"dtype": "F32", "shape": [0, 3], "data_offsets": [20, 20]},
    }
    assert content[first:] == np.array([7, 1, -2, 0.5, 3e-8], "<f4").tobytes()
    assert extents == {"a": (first, 4), "b": (first + 4, 16), "empty": (first + 20, 0)}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    transposed = {**WEIGHTS, "c": torch.arange(6.0).reshape(2, 3).T}
    write_weights(tmp_path / "weights", transposed)
    read = read_weights(tmp_path / "weights")
    assert read.keys() == transposed.keys()
    assert all(torch.equal(read[name], value) for name, value in transposed.items())
    read["a"] += 1.0  # the memory is its own


def test_other_types_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="half is torch.float16: only float32"):
        write_weights(tmp_path / "weights", {"half": torch.zeros(1, dtype=torch.float16)})
    text = b'{"x":{"dtype":"F16","shape":[1],"data_offsets":[0,2]}}'
    (tmp_path / "half").write_bytes(len(text).to_bytes(8, "little") + text + b"00")
    with pytest.raises(ValueError, match=r"half is no complete safetensors file .*F16"):
        read_weights(tmp_path / "half")


@pytest.mark.parametrize("keep", [0, 6, 40, -1], ids=["nothing", "length", "header", "tensors"])
def test_a_file_that_was_cut_off_is_refused(keep: int, tmp_path: Path) -> None:
    write_weights(tmp_path / "weights", WEIGHTS)
    (tmp_path / "weights").write_bytes((tmp_path / "weights").read_bytes()[:keep])
    with pytest.raises(ValueError, match="weights is no complete safetensors file"):
        read_weights(tmp_path / "weights")
