"""When something is due, and that a resumed run finds the same."""

from __future__ import annotations

import pytest

from dreamer_racing.training.journal import Interval, Journal, Periods
from dreamer_racing.training.metrics import PendingMetrics


def test_something_is_due_once_a_period() -> None:
    periods = Periods(log=100, never=0)
    assert [steps for steps in range(0, 450, 30) if periods.due("log", steps)] == [120, 210, 300, 420]
    assert not periods.due("never", 10_000) and not periods.due("never", 10_000, last=True)


def test_at_the_end_what_has_been_since_the_latest_is_due() -> None:
    periods = Periods(log=100)
    assert periods.due("log", 100, last=True) and not periods.due("log", 100, last=True)
    assert not periods.due("log", 130) and periods.due("log", 130, last=True)


def test_what_was_due_when_a_run_was_saved_is_due_when_it_goes_on() -> None:
    saved = Journal(Periods(log=100, save=100), PendingMetrics())
    assert saved.periods.due("log", 130)
    journal = Journal(Periods(log=100, save=100), PendingMetrics())
    journal.load_state_dict(saved.state_dict())
    assert not journal.periods.due("log", 130) and journal.periods.due("save", 130)


def test_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("dreamer_racing.training.journal.time.monotonic", lambda: now[0])
    interval, never = Interval(2.0), Interval(0.0)
    for now[0], due in ((119.0, False), (120.0, True), (200.0, False), (245.0, True)):
        assert interval.due() == due and not never.due()


def test_the_first_time_of_an_interval_may_come_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("dreamer_racing.training.journal.time.monotonic", lambda: now[0])
    intervals = {minutes: Interval(minutes, first=2.0) for minutes in (0.0, 1.0, 10.0)}
    due: dict[float, list[int]] = {minutes: [] for minutes in intervals}
    for minute in range(1, 25):
        now[0] = 60.0 * minute
        for minutes, interval in intervals.items():
            due[minutes] += [minute] if interval.due() else []
    assert due == {0.0: [2], 1.0: list(range(1, 25)), 10.0: [2, 12, 22]}


def test_a_first_one_comes_before_the_periods_once_and_costs_none_of_them():
    periods = Periods({"evaluate": 30}, evaluate=100, log=100)
    places = (10, 29, 31, 60, 99, 105, 150, 210)
    assert [place for place in places if periods.due("evaluate", place)] == [31, 105, 210]
    assert [place for place in places if periods.due("log", place)] == [105, 210]
    assert not Periods({"evaluate": 30}, evaluate=0).due("evaluate", 40)
