"""Worker process that collects rollouts on a Ray cluster.

Shapes: N environments of all W workers, T steps per rollout.
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

import torch
from torchrl.collectors import Collector

from dreamer_racing.experience.ray_arrays import Arrays, as_tensors, pack_rollout
from dreamer_racing.machine import PACKAGES, git_commit


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
    """Answer of a worker.

    Attributes:
        rollout: Packed rollout ``[N/W, T]``.
        is_first: Whether it is the worker's first one, with freshly reset environments.
        process: Host and process ID.
        seconds: Time that the worker took for it.
    """

    rollout: Arrays
    is_first: bool
    process: tuple[str, int]
    seconds: float


class RayWorker(Collector):
    """TorchRL collector that collects one rollout on request.

    It is seeded at its first rollout by ``seed`` plus the number of that round, so that a restarted worker does not
    repeat the rollouts of the one that it replaces.

    Args:
        args: Arguments of `Collector`.
        seed: Seed of the worker, to which the number of its first round is added.
        kwargs: Keyword arguments of `Collector`.
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
            self._begin((self._seed + request.round) % 2**32)
        if request.taken_at != self._taken_at:
            import ray

            self.update_policy_weights_(as_tensors(ray.get(request.weights[0])))
            self._taken_at = request.taken_at
        rollout, process = self.next(), (socket.gethostname(), os.getpid())
        result = WorkerResult(pack_rollout(rollout), is_first, process, time.perf_counter() - start)
        self._flown = request.round, result
        return result

    def _begin(self, seed: int) -> None:
        """Seed and reset all environments; the global generator is this worker's alone, like its process."""
        torch.manual_seed(seed)
        self.set_seed(seed)
        self.reset()

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
