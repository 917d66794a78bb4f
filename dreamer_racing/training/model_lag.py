"""Notices when a world model does not know the states that its policy has come to."""

from __future__ import annotations

import math
import statistics
from collections import deque
from typing import Any

import torch
from torch import Tensor

LOOKS = 5
"""Measurements of which the median counts, so that one of an odd flight does not [choice]."""
PATIENCE = 10
"""Measurements for which a policy waits at most; then the ratio has to fall below the limit first [choice]."""


class ModelLag:
    """Compares a world model's error on fresh records with that on those it is trained on.

    A policy that improves faster than its model flies where the model errs, and finds those of its errors that promise
    most. Then the fresh records' error stands above the other, and the policy should wait.

    Fresh are the newest records of all worlds: those of one that is held out follow single odd flights. They are harder
    than older ones where flights get faster, so a ratio somewhat above one is no lag yet.

    Args:
        limit: Ratio of the two above which the policy waits; None: it never does.

    Attributes:
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
        self.periods = 0
        self._sum: Tensor | float = 0.0  # of the errors of updates since the last measurement
        self._count = 0
        self._ratios = deque[float](maxlen=LOOKS)
        self._above = 0  # measurements without a break at which the median was above the limit

    @property
    def waits(self) -> bool:
        """Whether the policy should wait."""
        return self.limit is not None and 0 < self._above <= PATIENCE

    def trained(self, error: Tensor) -> None:
        """Take note of an update's error, a scalar; nothing waits for its device."""
        self._sum = self._sum + error.detach()
        self._count += 1

    def measured(self, fresh: Tensor | float) -> float:
        """Take note of the error on fresh records, a scalar; return the ratio, a median of the last, and decide."""
        trained = float(self._sum) / self._count if self._count else 0.0
        self._sum, self._count = 0.0, 0
        if trained:
            self._ratios.append(float(fresh) / trained)
        ratio = statistics.median(self._ratios) if self._ratios else math.nan
        self._above = self._above + 1 if self.limit is not None and ratio > self.limit else 0
        return ratio

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "periods": self.periods,
            "sum": float(self._sum),
            "count": self._count,
            "ratios": list(self._ratios),
            "above": self._above,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; what older versions kept of ratios is measured anew."""
        self.periods = state_dict["periods"]
        self._sum, self._count = torch.tensor(state_dict["sum"]), state_dict["count"]
        self._ratios = deque(state_dict.get("ratios", ()), maxlen=LOOKS)
        self._above = state_dict.get("above", 0)
