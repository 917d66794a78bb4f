"""Rollouts that are collected while those before them are learned from."""

from abc import abstractmethod
from collections.abc import Callable, Iterator

from tensordict import TensorDictBase


class WorkerError(RuntimeError):
    """Who flies failed, or is gone and does not come back: what is under way is given up, all before was delivered."""


class RolloutsAhead(Iterator[TensorDictBase]):
    """Rollouts ``[N, T]``, of which after each ``next()`` one more is under way.

    Who takes them learns from what was delivered before the next ``next()``.

    Attributes:
        has_worlds: Whether the worlds that are flown live in this process, and are saved with the run.
        stopping: Whether the run is to end: what is under way may be given up if it takes long; settable.
    """

    has_worlds = True
    stopping: Callable[[], bool] = staticmethod(lambda: False)

    def metrics(self) -> dict[str, float]:
        """Return what is to be said of the rollout that was delivered last."""
        return {}

    def begin_at(self, env_steps: int) -> None:
        """Go on with a run that has made so many env_steps."""

    def wait(self) -> None:
        """Wait until nothing under way draws from this process's random numbers; it is delivered as ever."""

    @abstractmethod
    def drain(self) -> TensorDictBase | None:
        """Return the rollout under way, if there is one, and begin no other: nothing moves until the next ``next()``.

        What a checkpoint holds of replay, environment and collector then belongs together.
        """

    @abstractmethod
    def close(self) -> None:
        """End collection; a rollout under way is not delivered any more."""
