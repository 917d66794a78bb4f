"""TensorDicts as NumPy arrays, which Ray's object store takes without copying, while it pickles tensors one by one.

Shapes: N environments, of one worker when packing and of all workers when unpacking; T steps per rollout; F first
steps, of the N rollouts and of episodes that begin within them.
"""

from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey


class Arrays(NamedTuple):
    """Entries of a TensorDict as arrays; names of its dimensions are lost.

    Attributes:
        batch_size: Batch size of the TensorDict.
        entries: Arrays by key; keys of nested TensorDicts are tuples.
    """

    batch_size: tuple[int, ...]
    entries: dict[NestedKey, np.ndarray]


def as_arrays(data: TensorDictBase) -> Arrays:
    """Convert the tensors of a TensorDict to arrays, which share the memory of contiguous CPU tensors.

    Raises:
        TypeError: A tensor has a type that NumPy does not have, such as bfloat16.
    """
    tensors = data.data.to("cpu").items(include_nested=True, leaves_only=True)
    return Arrays(tuple(data.batch_size), {key: value.contiguous().numpy() for key, value in tensors})


def as_tensors(arrays: Arrays) -> TensorDict:
    """Copy arrays into a TensorDict."""
    entries = {key: torch.from_numpy(value.copy()) for key, value in arrays.entries.items()}
    return TensorDict(entries, arrays.batch_size)


def pack_rollout(rollout: TensorDictBase) -> Arrays:
    """Convert a collector's rollout ``[N, T]`` to arrays without duplicate observations.

    The observation before a step equals the one after the step before, unless an episode begins. So root entries that
    also exist under "next" are only kept for first steps: ``(F, ...)`` instead of ``(N, T, ...)``.
    """
    arrays = as_arrays(rollout)
    first = _first_steps(arrays)
    for key, _ in _observed_twice(arrays):
        arrays.entries[key] = arrays.entries[key][first]
    return arrays


def unpack_rollout(*parts: Arrays) -> TensorDict:
    """Make one rollout ``[N, T]`` from the packed rollouts of workers, as a copy."""
    batch_size = (sum(part.batch_size[0] for part in parts), *parts[0].batch_size[1:])
    arrays = Arrays(
        batch_size, {key: np.concatenate([part.entries[key] for part in parts]) for key in parts[0].entries}
    )
    first = _first_steps(arrays)
    for before, after in _observed_twice(arrays):
        begins, arrived = arrays.entries[before], arrays.entries[after]
        observed = np.empty_like(arrived)
        observed[:, 1:] = arrived[:, :-1]
        observed[first] = begins
        arrays.entries[before] = observed
    return TensorDict({key: torch.from_numpy(value) for key, value in arrays.entries.items()}, batch_size)


def _first_steps(arrays: Arrays) -> np.ndarray:
    """Return the mask of steps at which a rollout or an episode begins, bool ``(N, T)``."""
    first: np.ndarray = arrays.entries["is_init"][..., 0].copy()
    first[:, 0] = True
    return first


def _observed_twice(arrays: Arrays) -> list[tuple[NestedKey, NestedKey]]:
    """List the pairs of keys that exist at the root and under "next", except `is_init`, which really differs."""
    pairs = [(key, ("next", *(key if isinstance(key, tuple) else (key,)))) for key in arrays.entries]
    return [(before, after) for before, after in pairs if after in arrays.entries and before != "is_init"]
