"""Eq. 1 by hand."""

import math

import pytest
import torch

from dreamer_racing.envs.race.rewards import RewardWeights, race_reward

GATE = torch.tensor([[10.0, 0.0, 0.0]])
RATES = torch.tensor([[1.0, 2.0, 2.0]])  # norm 3


def reward(previous, position, passes=0, crashed=False, weights=None, rates=RATES):
    """Reward one drone."""
    base, rate = race_reward(
        weights or RewardWeights(),
        GATE,
        torch.tensor([previous]),
        torch.tensor([position]),
        rates,
        torch.tensor([passes]),
        torch.tensor([crashed]),
    )
    return base.item(), rate.item()


@pytest.mark.parametrize("name", ["progress", "body_rate", "gate", "collision"])
@pytest.mark.parametrize("weight", [math.nan, math.inf, -math.inf, "10", True])
def test_weights_are_finite_numbers(name, weight):
    with pytest.raises(ValueError, match=f"RewardWeights.{name}={weight!r}: must be (a number, )?finite"):
        RewardWeights(**{name: weight})


def test_defaults_are_the_papers():
    assert RewardWeights() == RewardWeights(progress=1.0, body_rate=0.0, gate=10.0, collision=-4.0)


@pytest.mark.parametrize(
    ("previous", "position", "progress"),
    [
        ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 0.2),
        ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), -0.2),
        ((10.0, 3.0, 4.0), (10.0, 0.0, 1.0), 4.0),  # from 5 m away to 1 m away
        ((7.0, 4.0, 0.0), (7.0, -4.0, 0.0), 0.0),  # along a sphere about the gate
    ],
)
def test_progress_is_the_decrease_of_the_distance(previous, position, progress):
    assert reward(previous, position) == (pytest.approx(progress), pytest.approx(3.0))


def test_a_pass_replaces_progress_and_the_rate_term():
    assert reward((9.9, 0.0, 0.0), (10.1, 0.0, 0.0), passes=1) == (10.0, 0.0)


@pytest.mark.parametrize("passes", [0, 1])
def test_a_crash_outweighs_everything(passes):
    assert reward((9.9, 0.0, 0.0), (10.1, 0.0, 0.0), passes=passes, crashed=True) == (-4.0, 0.0)


def test_a_crash_hides_lost_numbers():
    lost = torch.full((1, 3), math.nan)
    assert reward((0.0, 0.0, 0.0), (math.nan, 0.0, math.inf), crashed=True, rates=lost) == (-4.0, 0.0)


def test_weights():
    weights = RewardWeights(progress=2.0, body_rate=0.5, gate=7.0, collision=-1.0)
    flight = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    # The rate term is left to the caller, so b₂ changes neither part.
    assert reward(*flight, weights=weights) == (pytest.approx(0.4), pytest.approx(3.0))
    assert reward(*flight, weights=weights, passes=1) == (7.0, 0.0)
    assert reward(*flight, weights=weights, crashed=True) == (-1.0, 0.0)


def test_drones_are_independent():
    base, rate = race_reward(
        RewardWeights(),
        GATE.expand(3, 3),
        torch.zeros(3, 3),
        torch.tensor([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [math.nan, 0.0, 0.0]]),
        RATES.expand(3, 3),
        torch.tensor([False, True, False]),
        torch.tensor([False, False, True]),
    )
    assert base.tolist() == [1.0, 10.0, -4.0]
    assert rate.tolist() == [3.0, 0.0, 0.0]
