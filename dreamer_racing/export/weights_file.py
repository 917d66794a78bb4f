"""Weights as a safetensors file, which torch can read and an ONNX file can use as external data.

Reading it executes no code. Reference: huggingface/safetensors, ``README.md``, section Format.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

_LENGTH = 8  # bytes of the length field; the header is padded with blanks to a multiple of it
_TYPE, _NUMPY = "F32", np.dtype("<f4")


class Extent(NamedTuple):
    """Offset and length of a tensor's bytes in the file."""

    offset: int
    length: int


def write_weights(path: str | Path, weights: Mapping[str, Tensor]) -> dict[str, Extent]:
    """Write float32 tensors, sorted by name; return the extent of each; raise ValueError for other types."""
    header: dict[str, dict[str, Any]] = {}
    buffers, end = [], 0
    for name, value in sorted(weights.items()):
        if value.dtype != torch.float32:
            raise ValueError(f"{name} is {value.dtype}: only float32 can be written.")
        buffers.append(value.detach().cpu().contiguous().numpy().astype(_NUMPY).tobytes())
        begin, end = end, end + len(buffers[-1])
        header[name] = {"dtype": _TYPE, "shape": list(value.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH)
    Path(path).write_bytes(len(text).to_bytes(_LENGTH, "little") + text + b"".join(buffers))
    first = _LENGTH + len(text)
    offsets = {name: entry["data_offsets"] for name, entry in header.items()}
    return {name: Extent(first + begin, end - begin) for name, (begin, end) in offsets.items()}


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read a file written by `write_weights`.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is of another kind or truncated, or holds types other than float32.
    """
    content = Path(path).read_bytes()
    first = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    try:
        header = json.loads(content[_LENGTH:first])
        entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
        return {name: _tensor(entry, content[first:]) for name, entry in entries.items()}
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path} is not a complete safetensors file of float32 weights ({error!r}).") from error


def _tensor(entry: Mapping[str, Any], data: bytes) -> Tensor:
    shape, (begin, end) = entry["shape"], entry["data_offsets"]
    if entry["dtype"] != _TYPE:
        raise ValueError(f"type {entry['dtype']}")
    if not 0 <= begin <= end <= len(data) or end - begin != math.prod(shape) * _NUMPY.itemsize:
        raise ValueError(f"{len(data)} bytes of tensors")
    return torch.from_numpy(np.frombuffer(data[begin:end], _NUMPY).astype(np.float32)).reshape(shape)
