"""What a run learns from: rollouts, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from tensordict import TensorDictBase


class WorkerError(RuntimeError):
    """Who flies failed, or is gone and does not come back: what is under way is given up, all before was delivered."""


class Rollouts(Iterator[TensorDictBase]):
    """Rollouts ``[N, T]`` of a collector, each flown when it is asked for; subclasses have the next one under way then.

    Who takes them learns from what was delivered before the next ``next()``.

    Args:
        collector: What flies, e.g. a TorchRL collector.

    Attributes:
        has_worlds: Whether the worlds that are flown live in this process, and are saved with the run.
        stopping: Whether the run is to end: what is under way may be given up if it takes long; settable.
    """

    has_worlds = True
    stopping: Callable[[], bool] = staticmethod(lambda: False)

    def __init__(self, collector: Any) -> None:
        self.collector = collector
        self._rollouts = iter(collector)

    def __next__(self) -> TensorDictBase:
        """Return the next rollout."""
        return next(self._rollouts)

    def metrics(self) -> dict[str, float]:
        """Return what is to be said of the rollout that was delivered last."""
        return {}

    def begin_at(self, env_steps: int) -> None:
        """Go on with a run that has made so many env_steps."""

    def wait(self) -> None:
        """Wait until nothing under way draws from this process's random numbers; it is delivered as ever."""

    def drain(self) -> TensorDictBase | None:
        """Return the rollout under way, if there is one, and begin no other: nothing moves until the next ``next()``.

        What a checkpoint holds of replay, environment and collector then belongs together.
        """
        return None

    def close(self) -> None:
        """End what is under way; it is not delivered any more."""
