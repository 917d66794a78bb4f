"""Substitutes, in processes of rank above 0, for objects that write files in rank 0 (`parallel`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from torch import Tensor
from torchrl.record.loggers import Logger


class LockHeldByFirst:
    """Substitute for the `RunLock`, which rank 0 holds.

    Args:
        directory: Run directory.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def release(self) -> None:
        """Do nothing."""

    def abandon(self) -> None:
        """Do nothing."""


class UnwrittenMetrics:
    """Substitute for the `MetricsLog` that drops all metrics."""

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
    """Substitute for the evaluator, because only rank 0 evaluates."""

    on_episode: Callable[[int, int], None] | None = None
    attempt: Callable[[str], AbstractContextManager] = nullcontext

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Raise ``RuntimeError``: only rank 0 may call this."""
        raise RuntimeError("Only the first process evaluates.")

    def close(self) -> None:
        """Do nothing."""
