"""How much a learner with a replay trains."""

from typing import NamedTuple


class ReplayRatio(NamedTuple):
    """So many records trained on per environment step made since the prefill.

    Args:
        ratio: records trained on per environment step.
        records: that an update trains on.
        prefill: env_steps collected before the first update.
        setting: name of the ratio in the configuration.
        first_ratio: the same, of the first steps after the prefill: to see before it flies.
        first_steps: how many these are.

    Example:
        >>> ReplayRatio(ratio=4.0, records=64, prefill=100, setting="model.replay_ratio").updates(env_steps=180)
        5
    """

    ratio: float
    records: int
    prefill: int
    setting: str
    first_ratio: float = 0.0
    first_steps: int = 0

    def updates(self, env_steps: int) -> int:
        """Updates in a run of so many env_steps."""
        learned_from = max(0, env_steps - self.prefill)
        first = min(learned_from, self.first_steps)
        return int((first * self.first_ratio + (learned_from - first) * self.ratio) / self.records)
