"""Notices when a world model does not know the states that its policy has come to."""

from __future__ import annotations

import logging
import math
import statistics
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

ERRORS = ("privileged_error", "image_error", "loss_vector", "reward_error")
"""Metrics of a world model by which a lag is told, best first."""
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
        limit: Ratio of the two above which the policy waits; None: it never does, and nothing is measured.
        every: env_steps between two measurements.

    Example:
        >>> import torch
        >>> lag = ModelLag(limit=1.2)
        >>> lag.trained({"reward_error": torch.tensor(0.01)})
        >>> lag.measured({"reward_error": torch.tensor(0.02)})["lag/ratio"]
        2.0
        >>> lag.waits
        True
    """

    def __init__(self, limit: float | None, every: int = 1) -> None:
        self.limit = limit
        self._every = every
        self._periods = 0  # of the run, that were looked at
        self._sum: Tensor | float = 0.0  # of the errors of updates since the last measurement
        self._count = 0
        self._ratios = deque[float](maxlen=LOOKS)
        self._above = 0  # measurements without a break at which the median was above the limit

    @property
    def waits(self) -> bool:
        """Whether the policy should wait."""
        return self.limit is not None and 0 < self._above <= PATIENCE

    def due(self, env_steps: int) -> bool:
        """Return whether another period has passed, in which the newest records are to be measured."""
        periods = env_steps // self._every
        passed, self._periods = self.limit is not None and periods != self._periods, periods
        return passed

    def trained(self, metrics: Mapping[str, Tensor]) -> None:
        """Take note of the error in an update's metrics, a scalar; nothing waits for its device."""
        if self.limit is not None and (error := error_of(metrics)) is not None:
            self._sum = self._sum + error.detach()
            self._count += 1

    def measured(self, metrics: Mapping[str, Tensor]) -> dict[str, Tensor | float]:
        """Take note of the error on fresh records, and decide whether the policy waits, which is logged.

        Args:
            metrics: of the world model on these records, of which one is in `ERRORS`.

        Returns:
            Metrics; the ratio is a median of the last ones. None where no error was measured.
        """
        if (fresh := error_of(metrics)) is None:
            return {}
        trained = float(self._sum) / self._count if self._count else 0.0
        self._sum, self._count = 0.0, 0
        if trained:
            self._ratios.append(float(fresh) / trained)
        ratio = statistics.median(self._ratios) if self._ratios else math.nan
        waited = self.waits
        self._above = self._above + 1 if self.limit is not None and ratio > self.limit else 0
        if self.waits is not waited:
            reason = f"the model's error on the newest records is {ratio:.2f} times that in training"
            logger.info(
                "the actor %s: %s (wait_for_model=%g)", "waits" if self.waits else "goes on", reason, self.limit
            )
        return {"lag/error": fresh, "lag/ratio": ratio, "lag/actor_waits": float(self.waits)}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "periods": self._periods,
            "sum": float(self._sum),
            "count": self._count,
            "ratios": list(self._ratios),
            "above": self._above,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self._periods = state_dict["periods"]
        self._sum, self._count = torch.tensor(state_dict["sum"]), state_dict["count"]
        self._ratios = deque(state_dict["ratios"], maxlen=LOOKS)
        self._above = state_dict["above"]


def error_of(metrics: Mapping[str, Tensor]) -> Tensor | None:
    """Return the error by which a lag is told, of a world model's metrics; None if none of them was measured."""
    return next((metrics[name] for name in ERRORS if name in metrics), None)
