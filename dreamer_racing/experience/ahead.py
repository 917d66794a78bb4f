"""Rollouts that are collected while those before them are learned from."""

from abc import abstractmethod
from collections.abc import Iterator

from tensordict import TensorDictBase


class RolloutsAhead(Iterator[TensorDictBase]):
    """Rollouts ``[N, T]``, of which after each ``next()`` one more is under way."""

    @abstractmethod
    def drain(self) -> TensorDictBase | None:
        """Return the rollout under way, if there is one, and begin no other: nothing moves until the next ``next()``.

        What a checkpoint holds of replay, environment and collector then belongs together.
        """

    @abstractmethod
    def close(self) -> None:
        """End collection; a rollout under way is not delivered any more."""
