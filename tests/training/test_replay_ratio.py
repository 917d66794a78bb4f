"""Updates that are due, by hand."""

from itertools import pairwise

import pytest

from dreamer_racing.training.replay_ratio import ReplayRatio


@pytest.mark.parametrize(
    ("env_steps", "updates"), [(0, 0), (100, 0), (115, 0), (116, 1), (180, 5), (260, 10), (1700, 100)]
)
def test_updates_follow_the_steps_after_the_prefill(env_steps: int, updates: int) -> None:
    assert ReplayRatio(4.0, 64, 100).updates(env_steps) == updates
    assert ReplayRatio(4.0, 64, 100).updates_due(env_steps, made=3) == max(0, updates - 3)


def resumed(*ratios: float, every: int = 1000) -> ReplayRatio:
    """Of a run that was resumed every so many env_steps, with one ratio after the other."""
    ratio = ReplayRatio(ratios[0], 64, 100)
    for number, (_, following) in enumerate(pairwise(ratios), 1):
        ratio.updates_due(number * every)
        after = ReplayRatio(following, 64, 100)
        after.load_state_dict(ratio.state_dict())
        ratio = after
    return ratio


def test_another_ratio_counts_from_where_it_begins_whatever_was_due_before() -> None:
    by_hand = int(900 * 4 / 64) + int(1000 * 8 / 64)
    assert resumed(4.0, 8.0).updates(2000) == by_hand
    assert resumed(4.0, 8.0, 1.0).updates(3000) == by_hand + int(1000 * 1 / 64)


def test_the_same_ratio_goes_on_as_if_nothing_had_been() -> None:
    assert [resumed(4.0, 4.0, 4.0).updates(steps) for steps in (0, 116, 5000)] == [0, 1, int(4900 * 4 / 64)]


def test_what_another_ratio_asked_for_is_not_forgotten_by_going_on_twice() -> None:
    assert resumed(4.0, 8.0, 8.0).updates(3000) == resumed(4.0, 8.0).updates(3000)


def test_a_ratio_that_changes_within_the_prefill_begins_after_it() -> None:
    assert resumed(4.0, 8.0, every=50).updates(180) == int(80 * 8 / 64)
