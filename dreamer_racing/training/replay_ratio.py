"""How much a learner with a replay trains."""

from typing import NamedTuple


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

    def updates(self, env_steps: int) -> int:
        """Updates in a run of so many env_steps."""
        return max(0, int((env_steps - self.prefill) * self.ratio / self.records))
