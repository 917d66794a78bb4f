"""How much a learner with a replay trains."""

from __future__ import annotations

import logging
from typing import Any

logger = logging.getLogger(__name__)


class ReplayRatio:
    """So many records trained on per environment step made since the prefill.

    A run that goes on with another ratio makes the updates that the one before asked for until there, no more and no
    less.

    Args:
        ratio: records trained on per environment step.
        records: that an update trains on.
        prefill: env_steps collected before the first update.

    Example:
        >>> ratio = ReplayRatio(ratio=4.0, records=64, prefill=100)
        >>> ratio.updates_due(env_steps=180), ratio.updates_due(env_steps=180, made=2)
        (5, 3)
    """

    def __init__(self, ratio: float, records: int, prefill: int = 0) -> None:
        self.ratio, self.records, self.prefill = ratio, records, prefill
        self._env_steps = 0  # when it was last asked
        self._since, self._before = 0, 0  # env_steps from which it holds, and updates that were asked for until there

    def updates(self, env_steps: int) -> int:
        """Return the updates to make from the run's beginning until so many env_steps."""
        steps = env_steps - max(self.prefill, self._since)
        return self._before + max(0, int(steps * self.ratio / self.records))

    def updates_due(self, env_steps: int, made: int = 0) -> int:
        """Return the updates to make at so many env_steps, where some are made already."""
        self._env_steps = env_steps
        return max(0, self.updates(env_steps) - made)

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the ratio, since when it holds, and how far the run is."""
        return {
            "ratio": self.ratio,
            "records": self.records,
            "prefill": self.prefill,
            "since": self._since,
            "before": self._before,
            "env_steps": self._env_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where a run was saved; another ratio than there holds from there on, which is logged."""
        saved = ReplayRatio(state["ratio"], state["records"], state["prefill"])
        saved._since, saved._before = state["since"], state["before"]
        self._env_steps = state["env_steps"]
        if (saved.ratio, saved.records, saved.prefill) == (self.ratio, self.records, self.prefill):
            self._since, self._before = saved._since, saved._before
            return
        self._since, self._before = self._env_steps, saved.updates(self._env_steps)
        logger.info("updates: from here on by a replay ratio of %g, %d records each", self.ratio, self.records)
