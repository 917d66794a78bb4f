"""Ramps by hand, and what they refuse."""

import pytest

from dreamer_racing.training.schedule import Clock, Ramp


@pytest.mark.parametrize(
    ("progress", "expected"), [(0.0, 0.98), (0.5, 0.98), (0.6, 0.984), (0.75, 0.99), (1.0, 0.99), (1.3, 0.99)]
)
def test_a_ramp_moves_between_its_shares_of_the_run(progress, expected):
    assert Ramp(to=0.99, begin=0.5, end=0.75).at(0.98, {Clock.run: progress}) == pytest.approx(expected)


def test_a_ramp_to_nowhere_stays():
    assert Ramp().at(0.7, {Clock.run: 0.9}) == 0.7


def test_a_ramp_without_length_is_a_step():
    ramp = Ramp(to=1.0, begin=0.5, end=0.5)
    assert [ramp.at(0.0, {Clock.run: progress}) for progress in (0.49, 0.5, 0.51)] == [0.0, 1.0, 1.0]


def test_a_ramp_may_turn_back():
    ramp = Ramp(to=1.0, begin=0.2, end=0.4, until=0.6)
    moments = (0.2, 0.4, 0.59, 0.6, 1.0)
    assert [ramp.at(0.0, {Clock.run: progress}) for progress in moments] == [0.0, 1.0, 1.0, 0.0, 0.0]


def test_a_ramp_may_turn_back_by_another_clock():
    ramp = Ramp(to=1.0, begin=0.2, end=0.4, until=0.3, until_by=Clock.passes)
    assert ramp.clocks == {Clock.run, Clock.passes}
    ramp.check("schedule.discount")
    assert ramp.at(0.0, {Clock.run: 0.9, Clock.passes: 0.29}) == 1.0
    assert ramp.at(0.0, {Clock.run: 0.9, Clock.passes: 0.3}) == 0.0


def test_a_second_clock_without_a_time_is_refused():
    with pytest.raises(ValueError, match="schedule.discount: until_by=passes says by what, and there is no until"):
        Ramp(to=1.0, until_by=Clock.passes).check("schedule.discount")


def test_a_time_of_another_clock_lies_between_0_and_1():
    with pytest.raises(ValueError, match="schedule.discount: until=1.5 must be at least 0 and at most 1"):
        Ramp(to=1.0, until=1.5, until_by=Clock.passes).check("schedule.discount")


@pytest.mark.parametrize("until", [0.3, 1.1])
def test_a_ramp_that_turns_back_before_its_end_or_never_is_refused(until):
    with pytest.raises(ValueError, match=f"schedule.discount: until={until} must be at least end=0.4"):
        Ramp(to=0.5, begin=0.2, end=0.4, until=until).check("schedule.discount")


@pytest.mark.parametrize(("begin", "end"), [(0.6, 0.5), (-0.1, 0.5), (0.5, 1.1)])
def test_a_ramp_that_ends_before_it_begins_or_outside_the_run_is_refused(begin, end):
    with pytest.raises(ValueError, match=f"schedule.discount: begin={begin} and end={end} are shares"):
        Ramp(to=0.5, begin=begin, end=end).check("schedule.discount")
