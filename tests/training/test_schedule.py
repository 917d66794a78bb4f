"""What a run's settings follow: schedules, the replay ratio, and the model's lag."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from dreamer_racing.losses import LossConfig
from dreamer_racing.training.schedule import (
    MEDIAN_WINDOW,
    PATIENCE,
    ModelLag,
    Ramp,
    RampClock,
    ReplayRatio,
    Schedule,
    ScheduleConfig,
)
from tests.training.test_episodes import episodes

HALF = {"to": 0.99, "begin": 0.5}


def test_the_hardest_gate_is_that_of_the_moment():
    schedule = Schedule(ScheduleConfig(), {"loss": LossConfig()}, 1000, num_gates=3)
    assert schedule.observe(episodes([1], [1], [1]), 10).keys() == {"episode/pass_share"}, "no mean over a row"
    schedule.observe(episodes([7, 1, 1], [2, 1, 1], [0, 2, 3]), 20)  # two crashes at gate 1
    assert schedule.hardest_gate() == {"episode/hardest_gate": 1.0}
    schedule.observe(episodes([2] * 9, [2] * 9, [1] * 9), 30)  # past 1, and a crash at gate 2
    assert schedule.hardest_gate() == {"episode/hardest_gate": 2.0}
    assert Schedule(ScheduleConfig(), {"loss": LossConfig()}, 1000).hardest_gate() == {}


@pytest.mark.parametrize(
    ("ramp", "progress", "expected"),
    [
        (Ramp(**HALF, end=0.75), 0.5, 0.98),
        (Ramp(**HALF, end=0.75), 0.6, 0.984),
        (Ramp(**HALF, end=0.75), 1.3, 0.99),
        (Ramp(**HALF, end=0.5), 0.49, 0.98),
        (Ramp(**HALF, end=0.5), 0.5, 0.99),
        (Ramp(to=0.99, begin=0.2, end=0.4, by=RampClock.passes), 0.9, 0.985),
        (Ramp(), 0.9, 0.98),
    ],
)
def test_a_ramp_moves_between_two_times_of_its_clock(ramp, progress, expected):
    assert ramp.at(0.98, {RampClock.run: progress, RampClock.passes: 0.3}) == pytest.approx(expected)


@pytest.mark.parametrize(("begin", "end"), [(0.6, 0.5), (-0.1, 0.5), (0.5, 1.1)])
def test_a_ramp_that_ends_before_it_begins_or_outside_the_run_is_refused(begin, end):
    with pytest.raises(ValueError, match=f"schedule.discount: begin={begin} and end={end} must satisfy"):
        Ramp(to=0.5, begin=begin, end=end).check("schedule.discount")


# Updates that are due, by hand.


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


@pytest.mark.parametrize(
    ("ratios", "every", "env_steps", "updates"),
    [
        ((4.0, 8.0), 1000, 2000, int(900 * 4 / 64) + int(1000 * 8 / 64)),
        ((4.0, 8.0, 8.0), 1000, 3000, int(900 * 4 / 64) + int(2000 * 8 / 64)),
        ((4.0, 8.0, 1.0), 1000, 3000, int(900 * 4 / 64) + int(1000 * 8 / 64) + int(1000 * 1 / 64)),
        ((4.0, 4.0, 4.0), 1000, 116, 1),
        ((4.0, 4.0, 4.0), 1000, 5000, int(4900 * 4 / 64)),
        ((4.0, 8.0), 50, 180, int(80 * 8 / 64)),  # it changes within the prefill
    ],
)
def test_another_ratio_counts_from_where_it_begins_whatever_was_due_before(
    ratios: tuple[float, ...], every: int, env_steps: int, updates: int
) -> None:
    assert resumed(*ratios, every=every).updates(env_steps) == updates


# When a policy waits for its model.


def of(error: float) -> dict[str, torch.Tensor]:
    return {"reward_error": torch.tensor(error)}


def measure(lag: ModelLag, *ratios: float) -> float | torch.Tensor:
    for ratio in ratios:
        for _ in range(3):
            lag.add_training_error(of(0.5))
        found = lag.add_fresh_error(of(0.5 * ratio))["lag/ratio"]
    return found


def test_it_waits_above_the_limit_and_goes_on_below():
    lag = ModelLag(limit=1.25)
    assert measure(lag, 1.2) == pytest.approx(1.2) and not lag.waits
    measure(lag, *[1.5] * MEDIAN_WINDOW)
    assert lag.waits
    measure(lag, *[1.0] * MEDIAN_WINDOW)
    assert not lag.waits


def test_one_odd_flight_is_no_lag_and_one_good_one_not_its_end():
    lag = ModelLag(limit=2.0)
    for ratio in (1.0, 1.0, 1.0, 30.0, 1.0, 1.0):
        assert measure(lag, ratio) == pytest.approx(1.0) and not lag.waits
    assert measure(lag, *[3.0] * MEDIAN_WINDOW, 1.0) == pytest.approx(3.0) and lag.waits


def test_it_does_not_wait_for_ever_and_again_only_after_the_model_has_caught_up():
    lag = ModelLag(limit=2.0)
    waited = [measure(lag, 3.0) and lag.waits for _ in range(2 * PATIENCE)]
    assert waited == [True] * PATIENCE + [False] * PATIENCE
    measure(lag, *[1.0] * MEDIAN_WINDOW, *[3.0] * MEDIAN_WINDOW)
    assert lag.waits


def test_the_training_error_is_the_mean_since_the_last_measurement():
    lag = ModelLag(limit=9.0)
    for error in (1.0, 2.0, 3.0):
        lag.add_training_error(of(error))
    assert lag.add_fresh_error(of(4.0))["lag/ratio"] == pytest.approx(2.0)


def test_without_a_limit_or_before_any_update_it_never_waits():
    lag = ModelLag(limit=None)
    assert not lag.due(10_000) and math.isnan(measure(lag, 100.0)) and not lag.waits
    lag = ModelLag(limit=1.1)
    assert math.isnan(lag.add_fresh_error(of(1.0))["lag/ratio"]) and not lag.waits
    assert lag.add_fresh_error({"loss": torch.tensor(1.0)}) == {}


def test_a_restored_one_goes_on_as_if_it_had_never_stopped_unless_the_limit_was_taken_away():
    lag = ModelLag(limit=1.25)
    measure(lag, 1.5)
    lag.add_training_error(of(0.5))
    other, unlimited = ModelLag(limit=1.25), ModelLag(limit=None)
    for restored in (other, unlimited):
        restored.load_state_dict(lag.state_dict())
    assert lag.waits and not unlimited.waits
    for ratio in (1.1, 3.0, 1.0, 1.0):
        assert measure(lag, ratio) == measure(other, ratio)
        assert (lag.waits, lag.state_dict()) == (other.waits, other.state_dict())


def test_it_is_measured_once_a_period_and_tells_when_the_actor_waits(caplog: pytest.LogCaptureFixture):
    lag = ModelLag(limit=2.0, every=100)
    assert [steps for steps in range(0, 450, 30) if lag.due(steps)] == [120, 210, 300, 420]
    with caplog.at_level("INFO", "dreamer_racing"):
        measure(lag, 1.0, *[3.0] * MEDIAN_WINDOW, *[1.0] * MEDIAN_WINDOW)
    assert len(caplog.messages) == 2
    assert caplog.messages[0].startswith("the actor waits: ") and caplog.messages[0].endswith("(wait_for_model=2)")
    assert caplog.messages[1].startswith("the actor continues: ")
