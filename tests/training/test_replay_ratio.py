"""Updates that are due, by hand."""

import pytest

from dreamer_racing.training.replay_ratio import ReplayRatio


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(0, 0), (100, 0), (115, 0), (116, 1), (180, 5), (260, 10), (1700, 100)]
)
def test_updates_follow_the_steps_after_the_prefill(env_steps: int, updates: int) -> None:
    assert ReplayRatio(4.0, 64, 100, "model.replay_ratio").updates(env_steps) == updates
