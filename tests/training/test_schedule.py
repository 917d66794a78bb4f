"""Ramps by hand, and what they refuse."""

import pytest

from dreamer_racing.training.schedule import Ramp, RampClock


@pytest.mark.parametrize(
    ("progress", "expected"), [(0.0, 0.98), (0.5, 0.98), (0.6, 0.984), (0.75, 0.99), (1.0, 0.99), (1.3, 0.99)]
)
def test_a_ramp_moves_between_its_shares_of_the_run(progress, expected):
    assert Ramp(to=0.99, begin=0.5, end=0.75).at(0.98, {RampClock.run: progress}) == pytest.approx(expected)


def test_a_ramp_to_nowhere_stays():
    assert Ramp().at(0.7, {RampClock.run: 0.9}) == 0.7


def test_a_ramp_may_go_by_another_clock():
    ramp = Ramp(to=1.0, begin=0.2, end=0.4, by=RampClock.passes)
    assert ramp.at(0.0, {RampClock.run: 0.9, RampClock.passes: 0.3}) == pytest.approx(0.5)


def test_a_ramp_without_length_is_a_step():
    ramp = Ramp(to=1.0, begin=0.5, end=0.5)
    assert [ramp.at(0.0, {RampClock.run: progress}) for progress in (0.49, 0.5, 0.51)] == [0.0, 1.0, 1.0]


@pytest.mark.parametrize(("begin", "end"), [(0.6, 0.5), (-0.1, 0.5), (0.5, 1.1)])
def test_a_ramp_that_ends_before_it_begins_or_outside_the_run_is_refused(begin, end):
    with pytest.raises(ValueError, match=f"schedule.discount: begin={begin} and end={end} are shares"):
        Ramp(to=0.5, begin=begin, end=end).check("schedule.discount")
