"""TensorDicts as NumPy arrays, whose memory Ray's object store takes as it is; tensors are pickled one by one.

To pack and unpack rollouts takes a seventh of the time, weights a third (`benchmarks/ray_arrays.py`).
"""

from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey


class Arrays(NamedTuple):
    """Entries of a TensorDict; names of its dimensions are lost.

    Attributes:
        batch_size: As of the TensorDict.
        entries: Arrays by key, those of nested TensorDicts by tuples of keys.
    """

    batch_size: tuple[int, ...]
    entries: dict[NestedKey, np.ndarray]


def as_arrays(data: TensorDictBase) -> Arrays:
    """Take the tensors of a TensorDict for arrays, which on the CPU share their memory where that is contiguous.

    Raises:
        TypeError: One is of a type that NumPy does not have, such as bfloat16.
    """
    tensors = data.data.to("cpu").items(include_nested=True, leaves_only=True)
    return Arrays(tuple(data.batch_size), {key: value.contiguous().numpy() for key, value in tensors})


def as_tensors(first: Arrays, *others: Arrays) -> TensorDict:
    """Copy arrays into a TensorDict; those of others follow along the first dimension."""
    if not others:
        entries = {key: torch.from_numpy(value.copy()) for key, value in first.entries.items()}
        return TensorDict(entries, first.batch_size)
    parts = (first, *others)
    entries = {key: torch.from_numpy(np.concatenate([part.entries[key] for part in parts])) for key in first.entries}
    return TensorDict(entries, (sum(part.batch_size[0] for part in parts), *first.batch_size[1:]))
