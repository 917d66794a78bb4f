"""Updates that are due, by hand."""

import pytest

from dreamer_racing.training.replay_ratio import ReplayRatio, UpdatesOwed


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(0, 0), (100, 0), (115, 0), (116, 1), (180, 5), (260, 10), (1700, 100)]
)
def test_updates_follow_the_steps_after_the_prefill(env_steps: int, updates: int) -> None:
    assert ReplayRatio(4.0, 64, 100, "model.replay_ratio").updates(env_steps) == updates


def owed_after(env_steps: int, *ratios: float, every: int = 1000) -> UpdatesOwed:
    """Of a run that was resumed every so many env_steps, with one ratio after the other."""
    owed = UpdatesOwed(ReplayRatio(ratios[0], 64, 100, "model.replay_ratio"))
    for number, ratio in enumerate(ratios[1:], 1):
        resumed = UpdatesOwed(ReplayRatio(ratio, 64, 100, "model.replay_ratio"))
        resumed.load_state_dict(owed.state_dict())
        assert resumed.go_on(number * every) is (ratio != ratios[number - 1])
        owed = resumed
    return owed


def test_another_ratio_counts_from_where_it_begins_whatever_was_owed_before() -> None:
    by_hand = int(900 * 4 / 64) + int(1000 * 8 / 64)
    assert owed_after(2000, 4.0, 8.0).until(2000) == by_hand
    assert owed_after(3000, 4.0, 8.0, 1.0).until(3000) == by_hand + int(1000 * 1 / 64)


def test_the_same_ratio_goes_on_as_if_nothing_had_been() -> None:
    assert [owed_after(0, 4.0, 4.0, 4.0).until(steps) for steps in (0, 116, 5000)] == [0, 1, int(4900 * 4 / 64)]
    kept = owed_after(0, 4.0, 8.0, 8.0)  # what another one asked for before is not forgotten by going on twice
    assert kept.until(3000) == owed_after(0, 4.0, 8.0).until(3000)


def test_a_ratio_that_changes_within_the_prefill_begins_after_it() -> None:
    assert owed_after(0, 4.0, 8.0, every=50).until(180) == int(80 * 8 / 64)
