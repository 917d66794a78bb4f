"""What flies in a process of its own, on a Ray cluster.

Shapes: N worlds of all W workers, T steps a rollout.
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
    """All that a rollout depends on, but for the worlds that fly it.

    Attributes:
        round: Its number in the run, from 0.
        weights: Where the policy's weights are in Ray's object store, as `Arrays`: a list of one reference, which is
            not fetched with the request but by who does not have them yet.
        taken_at: env_steps that the learner had learned from when it took those weights.
        settings: Values for attributes of the environment, by dotted name.
    """

    round: int
    weights: list[Any]
    taken_at: int
    settings: Mapping[str, Any]


class Flight(NamedTuple):
    """What a worker answers.

    Attributes:
        rollout: ``[N/W, T]``, packed.
        began: whether it is the worker's first, of worlds that begin anew.
        process: host and process id.
        seconds: that it took, of the worker's time.
    """

    rollout: Arrays
    began: bool
    process: tuple[str, int]
    seconds: float


class RayWorker(Collector):
    """A TorchRL collector that flies one rollout when asked.

    It does not seed itself before its first rollout, by the round that this is: so a worker that takes the place of
    another does not fly what that one flew.

    Args:
        args: Of `Collector`.
        seed: Of what it draws, plus the number of the round it begins with.
        kwargs: Of `Collector`.
    """

    def __init__(self, *args: Any, seed: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._seed = seed
        self._taken_at: int | None = None
        self._flown: tuple[int, Flight] | None = None  # the last round

    def fly(self, request: Request) -> Flight:
        """Fly a rollout; one that was flown already, whose answer Ray lost and asks for again, is given again."""
        if self._flown is not None and self._flown[0] == request.round:
            return self._flown[1]
        start = time.perf_counter()
        for name, value in request.settings.items():
            *path, attribute = name.split(".")
            setattr(attrgetter(".".join(path))(self.env.base_env) if path else self.env.base_env, attribute, value)
        began = self._taken_at is None
        if began:
            self._begin((self._seed + request.round) % 2**32)
        if request.taken_at != self._taken_at:
            import ray

            self.update_policy_weights_(as_tensors(ray.get(request.weights[0])))
            self._taken_at = request.taken_at
        rollout, process = self.next(), (socket.gethostname(), os.getpid())
        flight = Flight(pack_rollout(rollout), began, process, time.perf_counter() - start)
        self._flown = request.round, flight
        return flight

    def _begin(self, seed: int) -> None:
        """Let all worlds begin anew; the process is this worker's own, and so is its generator."""
        torch.manual_seed(seed)
        self.set_seed(seed)
        self.reset()

    def __bool__(self) -> bool:
        """Answer Ray, which asks before it reports an error, in place of TorchRL's ``__len__``, which would fail then.

        Ray would take that for the death of the process, and begin it anew, again and again.
        """
        return True

    def __repr__(self) -> str:
        """Name the worker, as Ray does before each line that it prints."""
        return f"worker {self.worker_idx}"


def versions() -> dict[str, str | None]:
    """Return what must be the same wherever one agent flies: Python, packages, and this project's commit or version."""
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in (*PACKAGES, "ray")},
        "dreamer_racing": git_commit(Path(__file__).parent) or importlib.metadata.version("dreamer_racing"),
    }
