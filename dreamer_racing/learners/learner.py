"""What every learner offers, and every policy that can be flown."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol

import torch

Timer = Callable[[str], AbstractContextManager]
"""Context manager by the name of an activity, as ``RunClock.timed``."""


class Flyer(Protocol):
    """What can be evaluated: every learner, and a `ShippedAgent`."""

    device: torch.device

    def evaluation_policy(self, deterministic: bool = False) -> Any:
        """Return the acting step to evaluate, which may be one of averaged weights."""
        ...


class Learner(Flyer, Protocol):
    """What every learner offers to recipes and evaluations: `DreamerLearner`, `PPOLearner` and `SACLearner` do."""

    updates: int

    def policy(self, deterministic: bool = False) -> Any:
        """Return the acting step that is trained, which shares the learner's parameters."""
        ...

    def check_finite(self) -> None:
        """Raise ``NonFiniteLossError`` if an update was not finite."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, but for the global random generators."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        ...


def untimed(activity: str) -> AbstractContextManager:
    """Measure nothing."""
    return nullcontext()


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw initial weights by a seed, without a trace in the global generator; None draws them from that."""
    with torch.random.fork_rng(devices=[], enabled=seed is not None):
        if seed is not None:
            torch.manual_seed(seed)
        yield
