"""Notices when a world model no longer knows the states that its policy has come to."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

MEMORY = 0.8
"""Weight of what was measured before, at each measurement [choice]: some five of them count."""


class ModelLag:
    """Compares a world model's error on fresh records, not yet trained on, with that on those it is trained on.

    A policy that improves faster than its model flies where the model errs, and finds those of its errors that promise
    most. Then the fresh records' error stands above the other, and the policy should wait.

    Fresh are the newest records of all worlds: those of one that is held out follow single odd flights. Their windows
    begin with latents that no update has refreshed, so a ratio somewhat above one is no lag yet.

    Args:
        limit: Ratio of the two above which the policy waits; None: it never does.

    Attributes:
        waits: Whether the policy should wait.
        periods: How many periods of a run have been measured, for whoever keeps time; saved with the rest.

    Example:
        >>> import torch
        >>> lag = ModelLag(limit=1.2)
        >>> lag.trained(torch.tensor(0.01))
        >>> lag.measured(torch.tensor(0.02))
        2.0
        >>> lag.waits
        True
    """

    def __init__(self, limit: float | None) -> None:
        self.limit = limit
        self.waits = False
        self.periods = 0
        self._sum: Tensor | float = 0.0  # of the errors of updates since the last measurement
        self._count = 0
        self._trained: float | None = None  # running means
        self._fresh: float | None = None

    def trained(self, error: Tensor) -> None:
        """Take note of an update's error, a scalar; nothing waits for its device."""
        self._sum = self._sum + error.detach()
        self._count += 1

    def measured(self, fresh: Tensor | float) -> float:
        """Take note of the error on fresh records, a scalar; return the ratio, and decide."""
        if self._count:
            self._trained = _moved(self._trained, float(self._sum) / self._count)
            self._sum, self._count = 0.0, 0
        self._fresh = _moved(self._fresh, float(fresh))
        ratio = self._fresh / self._trained if self._trained else math.nan
        if self.limit is not None and not math.isnan(ratio):
            self.waits = ratio > self.limit
        return ratio

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "waits": self.waits,
            "periods": self.periods,
            "sum": float(self._sum),
            "count": self._count,
            "trained": self._trained,
            "fresh": self._fresh,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.waits, self.periods = state_dict["waits"], state_dict["periods"]
        self._sum, self._count = torch.tensor(state_dict["sum"]), state_dict["count"]
        self._trained, self._fresh = state_dict["trained"], state_dict.get("fresh")  # not saved by older versions


def _moved(mean: float | None, value: float) -> float:
    """Return a running mean after one more value."""
    return value if mean is None else MEMORY * mean + (1.0 - MEMORY) * value
