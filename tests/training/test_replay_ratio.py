"""Updates that are due, by hand."""

import pytest

from dreamer_racing.training.replay_ratio import ReplayRatio


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(0, 0), (100, 0), (115, 0), (116, 1), (180, 5), (260, 10), (1700, 100)]
)
def test_updates_follow_the_steps_after_the_prefill(env_steps: int, updates: int) -> None:
    assert ReplayRatio(4.0, 64, 100, "model.replay_ratio").updates(env_steps) == updates


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(100, 0), (108, 1), (180, 10), (260, 20), (275, 20), (276, 21), (1860, 120)]
)
def test_the_first_steps_may_be_learned_from_more(env_steps: int, updates: int) -> None:
    """160 steps with a ratio of 8, which are 20 updates of 64 records; then one for each 16 steps."""
    assert ReplayRatio(4.0, 64, 100, "model.replay_ratio", 8.0, 160).updates(env_steps) == updates
