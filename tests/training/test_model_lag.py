"""When a policy waits for its model."""

import math

import pytest
import torch

from dreamer_racing.training.model_lag import LOOKS, PATIENCE, ModelLag


def of(error: float) -> dict[str, torch.Tensor]:
    return {"reward_error": torch.tensor(error)}


def measure(lag: ModelLag, ratio: float) -> float | torch.Tensor:
    for _ in range(3):
        lag.trained(of(0.5))
    return lag.measured(of(0.5 * ratio))["lag/ratio"]


def test_it_waits_above_the_limit_and_goes_on_below():
    lag = ModelLag(limit=1.25)
    assert measure(lag, 1.2) == pytest.approx(1.2) and not lag.waits
    for _ in range(LOOKS):
        measure(lag, 1.5)
    assert lag.waits
    for _ in range(LOOKS):
        measure(lag, 1.0)
    assert not lag.waits


def test_one_odd_flight_is_no_lag_and_one_good_one_not_its_end():
    lag = ModelLag(limit=2.0)
    for ratio in (1.0, 1.0, 1.0, 30.0, 1.0, 1.0):
        assert measure(lag, ratio) == pytest.approx(1.0) and not lag.waits
    for _ in range(LOOKS):
        measure(lag, 3.0)
    assert measure(lag, 1.0) == pytest.approx(3.0) and lag.waits


def test_it_does_not_wait_for_ever_and_again_only_after_the_model_has_caught_up():
    lag = ModelLag(limit=2.0)
    waited = [measure(lag, 3.0) and lag.waits for _ in range(2 * PATIENCE)]
    assert waited == [True] * PATIENCE + [False] * PATIENCE
    for _ in range(LOOKS):
        measure(lag, 1.0)
    for _ in range(LOOKS):
        measure(lag, 3.0)
    assert lag.waits


def test_the_training_error_is_the_mean_since_the_last_measurement():
    lag = ModelLag(limit=9.0)
    for error in (1.0, 2.0, 3.0):
        lag.trained(of(error))
    assert lag.measured(of(4.0))["lag/ratio"] == pytest.approx(2.0)


def test_without_a_limit_or_before_any_update_it_never_waits():
    lag = ModelLag(limit=None)
    assert not lag.due(10_000) and math.isnan(measure(lag, 100.0)) and not lag.waits
    lag = ModelLag(limit=1.1)
    assert math.isnan(lag.measured(of(1.0))["lag/ratio"]) and not lag.waits
    assert lag.measured({"loss": torch.tensor(1.0)}) == {}


def test_a_restored_one_goes_on_as_if_it_had_never_stopped():
    lag = ModelLag(limit=1.25)
    measure(lag, 1.5)
    lag.trained(of(0.5))
    other = ModelLag(limit=1.25)
    other.load_state_dict(lag.state_dict())
    for ratio in (1.1, 3.0, 1.0, 1.0):
        assert measure(lag, ratio) == measure(other, ratio)
        assert (lag.waits, lag.state_dict()) == (other.waits, other.state_dict())


def test_one_that_waited_goes_on_where_the_limit_was_taken_away():
    lag = ModelLag(limit=1.25)
    measure(lag, 1.5)
    assert lag.waits
    other = ModelLag(limit=None)
    other.load_state_dict(lag.state_dict())
    assert not other.waits


def test_it_is_measured_once_a_period_and_tells_when_the_actor_waits(caplog: pytest.LogCaptureFixture):
    lag = ModelLag(limit=2.0, every=100)
    assert [steps for steps in range(0, 450, 30) if lag.due(steps)] == [120, 210, 300, 420]
    with caplog.at_level("INFO", "dreamer_racing"):
        for ratio in (1.0, *(3.0,) * LOOKS, *(1.0,) * LOOKS):
            measure(lag, ratio)
    assert len(caplog.messages) == 2
    assert caplog.messages[0].startswith("the actor waits: ") and caplog.messages[0].endswith("(wait_for_model=2)")
    assert caplog.messages[1].startswith("the actor goes on: ")
