"""How much a learner with a replay trains."""

from __future__ import annotations

from typing import Any, NamedTuple


class ReplayRatio(NamedTuple):
    """So many records trained on per environment step made since the prefill.

    Args:
        ratio: records trained on per environment step.
        records: that an update trains on.
        prefill: env_steps collected before the first update.
        setting: name of the ratio in the configuration.

    Example:
        >>> ReplayRatio(ratio=4.0, records=64, prefill=100, setting="model.replay_ratio").updates(env_steps=180)
        5
    """

    ratio: float
    records: int
    prefill: int
    setting: str

    def updates(self, env_steps: int, since: int = 0) -> int:
        """Updates in a run of so many env_steps, for those since some number of them."""
        return max(0, int((env_steps - max(self.prefill, since)) * self.ratio / self.records))


class UpdatesOwed:
    """The updates that a replay ratio asks for, from where it began to hold.

    A run that goes on with another ratio owes what the one before asked for until there, no more and no less.

    Args:
        ratio: That holds now.

    Example:
        >>> before = ReplayRatio(4.0, 64, 100, "model.replay_ratio")
        >>> owed = UpdatesOwed(before._replace(ratio=8.0))
        >>> owed.go_on(180, before)
        True
        >>> owed.until(180), owed.until(196)
        (5, 7)
    """

    def __init__(self, ratio: ReplayRatio) -> None:
        self.ratio = ratio
        self._since, self._before = 0, 0  # env_steps from which it holds, and updates that were asked for until there
        self._saved: UpdatesOwed | None = None

    def until(self, env_steps: int) -> int:
        """Updates that are to be made until then, from the run's beginning."""
        return self._before + self.ratio.updates(env_steps, self._since)

    def go_on(self, env_steps: int, trained: ReplayRatio) -> bool:
        """Go on where a run was saved, after ``load_state_dict``; return whether another ratio holds from here on.

        Args:
            env_steps: Of the run until there.
            trained: By which it was trained, for a checkpoint of an older version, which does not say.
        """
        earlier, self._saved = self._saved or UpdatesOwed(trained), None
        if earlier.ratio[:3] == self.ratio[:3]:
            self._since, self._before = earlier._since, earlier._before
            return False
        self._since, self._before = env_steps, earlier.until(env_steps)
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the ratio, and since when it holds."""
        ratio, records, prefill, _ = self.ratio
        return {"ratio": ratio, "records": records, "prefill": prefill, "since": self._since, "before": self._before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take note of what ``state_dict`` returned."""
        self._saved = UpdatesOwed(ReplayRatio(state["ratio"], state["records"], state["prefill"], self.ratio.setting))
        self._saved._since, self._saved._before = state["since"], state["before"]
