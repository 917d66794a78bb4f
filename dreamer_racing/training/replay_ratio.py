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
        >>> owed = UpdatesOwed(ReplayRatio(4.0, 64, 100, "model.replay_ratio"))
        >>> resumed = UpdatesOwed(ReplayRatio(8.0, 64, 100, "model.replay_ratio"))
        >>> resumed.load_state_dict(owed.state_dict())
        >>> resumed.go_on(env_steps=180)
        True
        >>> resumed.until(180), resumed.until(196)
        (5, 7)
    """

    def __init__(self, ratio: ReplayRatio) -> None:
        self.ratio = ratio
        self._since, self._before = 0, 0  # env_steps from which it holds, and updates that were asked for until there
        self._earlier: UpdatesOwed | None = None

    def until(self, env_steps: int) -> int:
        """Updates that are to be made until then, from the run's beginning."""
        return self._before + self.ratio.updates(env_steps, self._since)

    def go_on(self, env_steps: int) -> bool:
        """Let the ratio hold from here on, if it is another one than was saved; return whether it is."""
        if self._earlier is None:
            return False
        self._since, self._before, self._earlier = env_steps, self._earlier.until(env_steps), None
        return True

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the ratio, and since when it holds."""
        ratio, records, prefill, _ = self.ratio
        return {"ratio": ratio, "records": records, "prefill": prefill, "since": self._since, "before": self._before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over since when it holds, or if it is another ratio, what was asked for by that one."""
        saved = UpdatesOwed(ReplayRatio(state["ratio"], state["records"], state["prefill"], self.ratio.setting))
        saved._since, saved._before = state["since"], state["before"]
        if saved.ratio == self.ratio:
            self._since, self._before = saved._since, saved._before
        else:
            self._earlier = saved
