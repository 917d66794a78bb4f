"""Worker process that collects rollouts on a Ray cluster, and the arrays in which rollouts and weights are sent.

Ray's object store takes NumPy arrays without copying, while it pickles tensors one by one.

Shapes: N environments of all W workers, or of one in what it packs; T steps per rollout; F first steps, of the N
rollouts and of episodes that begin within them.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import socket
import time
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.collectors import Collector

from dreamer_racing.machine import PACKAGES, git_commit


class Arrays(NamedTuple):
    """Entries of a TensorDict as arrays by key; names of its dimensions are lost."""

    batch_size: tuple[int, ...]
    entries: dict[NestedKey, np.ndarray]


def as_arrays(data: TensorDictBase) -> Arrays:
    """Convert the tensors of a TensorDict to arrays, which share the memory of contiguous CPU tensors."""
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


class Request(NamedTuple):
    """Request for a rollout: everything that it depends on, except the worker's environments.

    Attributes:
        round: Number of the round in the run, from 0.
        weights: Reference to the policy's weights in Ray's object store, as `Arrays`; it is in a list so that Ray does
            not fetch it with the request, but only workers that do not have these weights yet do.
        taken_at: env_steps that the learner had learned from when it took those weights.
        settings: Values for attributes of the environment, by dotted name.
    """

    round: int
    weights: list[Any]
    taken_at: int
    settings: Mapping[str, Any]


class WorkerResult(NamedTuple):
    """Answer of a worker: packed rollout ``[N/W, T]``, whether it is its first, host and process ID, and time it took.

    At its first rollout a worker resets all environments.
    """

    rollout: Arrays
    is_first: bool
    process: tuple[str, int]
    seconds: float


class RayWorker(Collector):
    """TorchRL collector that collects one rollout on request.

    It is seeded at its first rollout by ``seed`` plus the number of that round, so that a restarted worker does not
    repeat the rollouts of the one that it replaces. All other arguments are those of `Collector`.
    """

    def __init__(self, *args: Any, seed: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._seed = seed
        self._taken_at: int | None = None
        self._flown: tuple[int, WorkerResult] | None = None  # number and answer of the last round

    def collect_rollout(self, request: Request) -> WorkerResult:
        """Collect a rollout; if Ray lost the answer and repeats the request, return the same answer again."""
        if self._flown is not None and self._flown[0] == request.round:
            return self._flown[1]
        start = time.perf_counter()
        for name, value in request.settings.items():
            *path, attribute = name.split(".")
            setattr(attrgetter(".".join(path))(self.env.base_env) if path else self.env.base_env, attribute, value)
        is_first = self._taken_at is None
        if is_first:
            seed = (self._seed + request.round) % 2**32
            torch.manual_seed(seed)  # the global generator is this worker's alone, like its process
            self.set_seed(seed)
            self.reset()
        if request.taken_at != self._taken_at:
            import ray

            self.update_policy_weights_(as_tensors(ray.get(request.weights[0])))
            self._taken_at = request.taken_at
        rollout, process = self.next(), (socket.gethostname(), os.getpid())
        result = WorkerResult(pack_rollout(rollout), is_first, process, time.perf_counter() - start)
        self._flown = request.round, result
        return result

    def __bool__(self) -> bool:
        """Return True, because Ray evaluates it before it reports an error, when TorchRL's ``__len__`` would fail.

        Ray would take that failure for the death of the process, and restart it again and again.
        """
        return True

    def __repr__(self) -> str:
        """Return the name of the worker, which Ray prints before each line of its output."""
        return f"worker {self.worker_idx}"


def versions() -> dict[str, str | None]:
    """Return the versions that must be equal on all nodes: Python, packages, and this project's commit or version."""
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in (*PACKAGES, "ray")},
        "dreamer_racing": git_commit(Path(__file__).parent) or importlib.metadata.version("dreamer_racing"),
    }
