"""Updates that are due, by hand."""

from itertools import pairwise

import pytest

from dreamer_racing.training.replay_ratio import ReplayRatio, UpdatesOwed


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(0, 0), (100, 0), (115, 0), (116, 1), (180, 5), (260, 10), (1700, 100)]
)
def test_updates_follow_the_steps_after_the_prefill(env_steps: int, updates: int) -> None:
    assert ReplayRatio(4.0, 64, 100, "model.replay_ratio").updates(env_steps) == updates


SLOW = ReplayRatio(4.0, 64, 100, "model.replay_ratio")


def owed_after(*ratios: float, every: int = 1000, says: bool = True) -> UpdatesOwed:
    """Of a run that was resumed every so many env_steps, with one ratio after the other.

    Args:
        says: Whether checkpoints say by which they were trained; those of older versions do not.
    """
    owed = UpdatesOwed(SLOW._replace(ratio=ratios[0]))
    for number, (before, ratio) in enumerate(pairwise(ratios), 1):
        resumed = UpdatesOwed(SLOW._replace(ratio=ratio))
        if says:
            resumed.load_state_dict(owed.state_dict())
        trained = SLOW._replace(ratio=99.0 if says else before)
        assert resumed.go_on(number * every, trained) is (ratio != before)
        owed = resumed
    return owed


@pytest.mark.parametrize("says", [True, False])
def test_another_ratio_counts_from_where_it_begins_whatever_was_owed_before(says: bool) -> None:
    by_hand = int(900 * 4 / 64) + int(1000 * 8 / 64)
    assert owed_after(4.0, 8.0, says=says).until(2000) == by_hand
    assert owed_after(4.0, 8.0, 1.0).until(3000) == by_hand + int(1000 * 1 / 64)


@pytest.mark.parametrize("says", [True, False])
def test_the_same_ratio_goes_on_as_if_nothing_had_been(says: bool) -> None:
    owed = owed_after(4.0, 4.0, 4.0, says=says)
    assert [owed.until(steps) for steps in (0, 116, 5000)] == [0, 1, int(4900 * 4 / 64)]


def test_what_another_ratio_asked_for_is_not_forgotten_by_going_on_twice() -> None:
    assert owed_after(4.0, 8.0, 8.0).until(3000) == owed_after(4.0, 8.0).until(3000)


def test_a_ratio_that_changes_within_the_prefill_begins_after_it() -> None:
    assert owed_after(4.0, 8.0, every=50).until(180) == int(80 * 8 / 64)
