"""When a policy waits for its model."""

import math

import pytest
import torch

from dreamer_racing.training.model_lag import MEMORY, ModelLag


def measure(lag: ModelLag, trained: float, fresh: float) -> float:
    for _ in range(3):
        lag.trained(torch.tensor(trained))
    return lag.measured(torch.tensor(fresh))


def test_it_waits_above_the_limit_and_goes_on_below():
    lag = ModelLag(limit=1.25)
    assert measure(lag, 1.0, 1.2) == pytest.approx(1.2) and not lag.waits
    for _ in range(20):
        measure(lag, 1.0, 1.5)
    assert lag.waits
    for _ in range(20):
        measure(lag, 1.0, 1.0)
    assert not lag.waits


def test_a_single_measurement_counts_a_fifth():
    lag = ModelLag(limit=None)
    measure(lag, 1.0, 1.0)
    assert measure(lag, 1.0, 2.0) == pytest.approx(MEMORY + (1 - MEMORY) * 2.0)


def test_the_training_error_is_the_mean_since_the_last_measurement():
    lag = ModelLag(limit=None)
    for error in (1.0, 2.0, 3.0):
        lag.trained(torch.tensor(error))
    assert lag.measured(torch.tensor(4.0)) == pytest.approx(2.0)


def test_without_a_limit_or_before_any_update_it_never_waits():
    lag = ModelLag(limit=None)
    assert measure(lag, 1.0, 100.0) == pytest.approx(100.0) and not lag.waits
    lag = ModelLag(limit=1.1)
    assert math.isnan(lag.measured(torch.tensor(1.0))) and not lag.waits


def test_a_restored_one_goes_on_as_if_it_had_never_stopped():
    lag = ModelLag(limit=1.25)
    measure(lag, 1.0, 1.5)
    lag.trained(torch.tensor(0.5))
    other = ModelLag(limit=1.25)
    other.load_state_dict(lag.state_dict())
    assert [measure(each, 1.0, 1.1) for each in (lag, other)] == [pytest.approx(lag._fresh / lag._trained)] * 2
    assert lag.waits == other.waits
