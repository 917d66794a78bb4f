"""Velocities from poses, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.velocity import GAP, VelocityEstimator

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)
STEP = 0.005


def close(value, expected):
    return np.allclose(value, expected, rtol=0, atol=1e-9)


def test_nothing_is_known_of_one_pose():
    assert VelocityEstimator(0.0).update(3.0, STILL, LEVEL) is None


@pytest.mark.parametrize("time_constant", [0.0, 0.02])
def test_constant_velocity_is_known_from_the_second_pose_on(time_constant):
    estimator, velocity = VelocityEstimator(time_constant), np.array([3.0, -4.0, 0.5])
    estimates = [estimator.update(7.0 + n * STEP, n * STEP * velocity, LEVEL) for n in range(20)]
    assert estimates[0] is None
    assert all(close(estimate.linear_velocity, velocity) for estimate in estimates[1:])
    assert all(close(estimate.body_rates, 0.0) for estimate in estimates[1:])


@pytest.mark.parametrize("time_constant", [0.0, 0.02])
def test_constant_body_rates_through_many_turns(time_constant):
    """From an attitude that is not level, so that rates of the world would differ."""
    estimator, rates = VelocityEstimator(time_constant), np.array([8.0, -6.0, 10.0])
    attitude, estimates = turn(LEVEL, np.array([0.4, 1.0, -2.0])), []
    for n in range(1000):  # 11 turns
        estimates.append(estimator.update(n * STEP, STILL, attitude))
        attitude = turn(attitude, STEP * rates)
    assert all(close(estimate.body_rates, rates) for estimate in estimates[1:])


def test_yaw_left_by_a_right_angle_per_second():
    estimator = VelocityEstimator(0.0)
    estimator.update(0.0, STILL, np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]))
    half = math.radians(45.0 + 4.5)
    estimate = estimator.update(0.1, STILL, np.array([math.cos(half), 0.0, 0.0, math.sin(half)]))
    assert close(estimate.body_rates, (0.0, 0.0, math.pi / 2))


def test_a_step_comes_through_as_one_minus_exp():
    """At rest, then at 2 m/s and 3 rad/s: t after the step, 1 − exp(−t / τ) of it is there."""
    time_constant, speed, rate = 0.03, 2.0, 3.0
    estimator = VelocityEstimator(time_constant)
    estimator.update(-STEP, STILL, LEVEL)
    estimator.update(0.0, STILL, LEVEL)
    for n in range(1, 30):
        time = (n + 0.3 * (n % 2)) * STEP  # at uneven times too
        attitude = turn(LEVEL, np.array([0.0, 0.0, rate * time]))
        estimate = estimator.update(time, np.array([speed * time, 0.0, 0.0]), attitude)
        share = 1.0 - math.exp(-time / time_constant)
        assert close(estimate.linear_velocity, (share * speed, 0.0, 0.0))
        assert close(estimate.body_rates, (0.0, 0.0, share * rate))


@given(signs=st.lists(st.sampled_from([-1.0, 1.0]), min_size=10, max_size=10))
def test_q_and_minus_q_are_the_same_attitude(signs):
    estimator, rates = VelocityEstimator(0.0), np.array([1.0, 2.0, -3.0])
    attitudes = [sign * turn(LEVEL, n * STEP * rates) for n, sign in enumerate(signs)]
    estimates = [estimator.update(n * STEP, STILL, attitude) for n, attitude in enumerate(attitudes)]
    assert all(close(estimate.body_rates, rates) for estimate in estimates[1:])


@pytest.mark.parametrize(
    "next_pose",
    [
        pytest.param((STEP + 1.01 * GAP, STILL, LEVEL), id="gap"),
        pytest.param((2 * STEP, np.array([0.0, 0.0, 0.3]), LEVEL), id="jump of 60 m/s"),
        pytest.param((2 * STEP, STILL, turn(LEVEL, np.array([0.3, 0.0, 0.0]))), id="jump of 60 rad/s"),
        pytest.param((STEP, STILL, LEVEL), id="same time"),
        pytest.param((-50.0, STILL, LEVEL), id="step back"),
    ],
)
def test_it_begins_anew(next_pose):
    """With no memory of how it moved before, and no difference across."""
    estimator = VelocityEstimator(0.05)
    estimator.update(0.0, np.array([-0.1, 0.0, 0.0]), LEVEL)
    assert estimator.update(STEP, STILL, LEVEL).linear_velocity[0] > 19.0
    time, position, attitude = next_pose
    assert estimator.update(time, position, attitude) is None
    after = estimator.update(time + STEP, position + np.array([0.0, 0.01, 0.0]), attitude)
    assert close(after.linear_velocity, (0.0, 2.0, 0.0)) and close(after.body_rates, 0.0)


def test_a_gap_at_the_limit_is_none():
    estimator = VelocityEstimator(0.0)
    estimator.update(0.0, STILL, LEVEL)
    assert close(estimator.update(GAP, np.array([1.0, 0.0, 0.0]), LEVEL).linear_velocity, (10.0, 0.0, 0.0))
