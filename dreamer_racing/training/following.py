"""What a process has in place of what the first one writes, where several train together (`parallel`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from torch import Tensor
from torchrl.record.loggers import Logger


class LockHeldByFirst:
    """A run directory that the first process holds.

    Args:
        directory: of the run.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def release(self) -> None:
        """Do nothing."""

    def abandon(self) -> None:
        """Do nothing."""


class UnwrittenMetrics:
    """Takes metrics, and keeps none."""

    def __init__(self) -> None:
        self.loggers: list[Logger] = []

    def push(self, metrics: Mapping[str, Tensor | float], count: int = 1) -> None:
        """Do nothing."""

    def close_row(self, env_steps: int) -> dict[str, float]:
        """Return nothing."""
        return {}

    def flush(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class NoReport:
    """An evaluation that the first process makes."""

    on_episode: Callable[[int, int], None] | None = None
    attempt: Callable[[str], AbstractContextManager] = nullcontext

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Refuse: whoever asks has not looked which process this is."""
        raise RuntimeError("The first process alone evaluates.")

    def close(self) -> None:
        """Do nothing."""
