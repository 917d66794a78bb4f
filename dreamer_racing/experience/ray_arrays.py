"""TensorDicts as NumPy arrays, whose memory Ray's object store takes as it is; tensors are pickled one by one.

Shapes: N worlds, of one worker where it packs and of all of them where their rollouts are unpacked; T steps a rollout;
F = first steps, of the N rollouts and of episodes that begin within them.
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


def as_tensors(arrays: Arrays) -> TensorDict:
    """Copy arrays into a TensorDict."""
    entries = {key: torch.from_numpy(value.copy()) for key, value in arrays.entries.items()}
    return TensorDict(entries, arrays.batch_size)


def pack_rollout(rollout: TensorDictBase) -> Arrays:
    """Take a collector's rollout ``[N, T]`` for arrays, in which nothing is sent twice.

    What is observed before a step is what was observed after the last one, unless an episode begins. So of entries that
    are there before steps and after, those before are sent of first steps only: ``(F, ...)`` for ``(N, T, ...)``.
    """
    arrays = as_arrays(rollout)
    first = _first_steps(arrays)
    for key, _ in _observed_twice(arrays):
        arrays.entries[key] = arrays.entries[key][first]
    return arrays


def unpack_rollout(*parts: Arrays) -> TensorDict:
    """Make one rollout ``[N, T]`` of those that workers packed, side by side in memory of its own."""
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
    """Return where a rollout or an episode begins, bool ``(N, T)``."""
    first: np.ndarray = arrays.entries["is_init"][..., 0].copy()
    first[:, 0] = True
    return first


def _observed_twice(arrays: Arrays) -> list[tuple[NestedKey, NestedKey]]:
    """List the keys of what is observed before steps and after them, but for `is_init`, by which the two differ."""
    pairs = [(key, ("next", *(key if isinstance(key, tuple) else (key,)))) for key in arrays.entries]
    return [(before, after) for before, after in pairs if after in arrays.entries and before != "is_init"]
