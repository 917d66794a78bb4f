"""Motion as it is told: attitudes, velocities from poses, odometry against poses, and how a vehicle answers."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.attitude import rotation_between, rotation_matrix, turn
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.identify import AMPLITUDES, AXES, IdentificationFlyer, make_schedule
from dreamer_racing.hil.motion import Odometer, TurnOdometer
from dreamer_racing.hil.pose_sources.messages import GAP, VelocityEstimator
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.plant.lock_step import LockStep
from dreamer_racing.plant.vehicle import PlantVehicle

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("axis", "turned", "towards"),
    [
        (0, 1, (0, 0, 1)),  # rolling right lifts the left side
        (1, 0, (0, 0, -1)),  # pitching by +y puts the nose down
        (2, 0, (0, 1, 0)),  # yawing by +z turns the nose left
    ],
)
def test_the_sign_of_every_axis(axis, turned, towards):
    rotation = np.zeros(3)
    rotation[axis] = math.pi / 2
    assert rotation_matrix(turn(LEVEL, rotation))[:, turned] == pytest.approx(towards, abs=1e-12)


def test_small_turns_add_up():
    attitude, rates = LEVEL, np.array([0.3, -0.7, 1.1])
    for _ in range(1000):
        attitude = turn(attitude, 1e-3 * rates)
    assert rotation_matrix(attitude) == pytest.approx(rotation_matrix(turn(LEVEL, rates)), abs=1e-9)
    assert turn(LEVEL, np.zeros(3)).tolist() == LEVEL.tolist()


@given(rotation=st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3), sign=st.sampled_from([-1.0, 1.0]))
def test_the_logarithm_undoes_a_turn(rotation, sign):
    """Up to 3.12 rad: at half a turn, left and right are the same."""
    first = turn(LEVEL, np.array([0.3, -2.0, 1.0]))
    assert rotation_between(first, sign * turn(first, np.array(rotation))) == pytest.approx(rotation, abs=1e-9)


# Velocities from poses, by hand.


STILL = np.zeros(3)
STEP = 0.005


def close(value, expected):
    return np.allclose(value, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("time_constant", [0.0, 0.02])
def test_steady_motion_is_known_from_the_second_pose_on_through_many_turns(time_constant):
    """From an attitude that is not level, so that rates of the world would differ."""
    estimator = VelocityEstimator(time_constant)
    velocity, rates = np.array([3.0, -4.0, 0.5]), np.array([8.0, -6.0, 10.0])
    attitude, estimates = turn(LEVEL, np.array([0.4, 1.0, -2.0])), []
    for n in range(1000):  # 11 turns
        estimates.append(estimator.update(7.0 + n * STEP, n * STEP * velocity, attitude))
        attitude = turn(attitude, STEP * rates)
    assert estimates[0] is None
    assert all(close(estimate.linear_velocity, velocity) for estimate in estimates[1:])
    assert all(close(estimate.body_rates, rates) for estimate in estimates[1:])


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


# Claimed velocities and body rates against positions and attitudes: motions of known mismatch.


def test_nothing_is_said_before_the_window_is_full():
    odometer = Odometer(0.075)
    said = [odometer.mismatch(0.02 * step, (0.1 * step, 0.0, 0.0), (5.0, 0.0, 0.0)) for step in range(6)]
    assert said[:4] == [None] * 4 and said[4:] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_steady_turns_and_accelerations_agree():
    """Trapezoids are exact for a constant acceleration, and off by v (w dt)²/12 on a circle."""
    falling, circling = Odometer(0.075), Odometer(0.075)
    for step in range(50):
        time = 0.02 * step
        fell = falling.mismatch(time, (0.0, 0.0, -4.905 * time**2), (0.0, 0.0, -9.81 * time))
        angle = 5.0 * time
        turned = circling.mismatch(
            time, (math.cos(angle), math.sin(angle), 0.0), (-5 * math.sin(angle), 5 * math.cos(angle), 0.0)
        )
    assert fell == pytest.approx(0.0, abs=1e-9) and turned == pytest.approx(5.0 * (5 * 0.02) ** 2 / 12, rel=0.05)


def test_a_velocity_along_the_wrong_axis_is_off_by_the_diagonal():
    odometer = Odometer(0.075)
    said = [odometer.mismatch(0.04 * step, (0.2 * step, 0.0, 0.0), (0.0, 5.0, 0.0)) for step in range(4)]
    assert said[-1] == pytest.approx(math.hypot(5.0, 5.0))


@pytest.mark.parametrize(("make", "place"), [(Odometer, (0.0, 0.0, 0.0)), (TurnOdometer, (1.0, 0.0, 0.0, 0.0))])
def test_after_a_gap_it_begins_anew(make, place):
    """In which a vehicle may have gone or turned there and back."""
    odometer = make(0.075, gap=0.05)
    for step in range(6):
        odometer.mismatch(0.02 * step, place, (0.0, 0.0, 0.0))
    said = [odometer.mismatch(0.18 + 0.02 * step, place, (10.0 * (step == 0), 0.0, 0.0)) for step in range(4)]
    assert said == [None] * 4


def test_a_lie_is_forgotten_once_it_is_behind_the_window():
    odometer = Odometer(0.075)
    said = [odometer.mismatch(0.04 * step, (0.0, 0.0, 0.0), (8.0 * (step == 3), 0.0, 0.0)) for step in range(8)]
    assert said[2:] == pytest.approx([0.0, 2.0, 4.0, 2.0, 0.0, 0.0], abs=1e-9)


def test_rates_about_a_moving_axis_agree_with_the_attitudes_that_they_lead_to():
    """Rates of up to 10 rad/s, integrated in 20 parts between two poses."""

    def rates(time):
        return np.array([7.0 * math.sin(20.0 * time), 7.0 * math.cos(17.0 * time), 3.0])

    odometer, attitude, part = TurnOdometer(0.075), LEVEL, 0.005 / 20
    for step in range(40):
        time = 0.005 * step
        said = odometer.mismatch(time, tuple(attitude.tolist()), tuple(rates(time).tolist()))
        for count in range(20):
            attitude = turn(attitude, part * rates(time + (count + 0.5) * part))
    assert said < 0.1


def test_an_attitude_and_its_negative_are_the_same_place():
    odometer = TurnOdometer(0.075)
    said = [odometer.mismatch(0.04 * step, ((-1.0) ** step, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for step in range(5)]
    assert said[2:] == [0.0] * 3


@pytest.mark.parametrize("huge", [1e200, 1e308])
def test_rates_beyond_all_numbers_are_no_match(huge):
    odometer = TurnOdometer(0.075)
    for step in range(4):
        said = odometer.mismatch(0.04 * step, (1.0, 0.0, 0.0, 0.0), 3 * (huge,))
    assert said is not None and not said <= 5.0


# The flight that tells how a vehicle answers.


CIRCLE = load_track("circle")


def test_steps_follow_each_other_and_every_axis_is_moved_both_ways() -> None:
    steps = make_schedule()
    assert all(one.end <= other.begin + 1e-9 for one, other in pairwise(steps))
    for axis in range(len(AXES)):
        moved = [step.value * (step.end - step.begin) for step in steps if step.axis == axis]
        assert min(moved) < 0 < max(moved)
        assert abs(sum(moved)) <= 0.46 * AMPLITUDES[AXES[axis]][1], "it ends near where it began"
    assert make_schedule() == steps


def test_a_vehicle_flies_its_first_steps_within_a_metre_and_tilts_little() -> None:
    """On physics that answer later than those of most; the whole flight is in `tests/identification`."""
    plant = LockStep(PlantVehicle(CIRCLE, "faithful"))
    places, tilts = [], []
    sleep = plant.sleep_until

    def watch(deadline: float) -> None:
        sleep(deadline)
        pose = plant.plant.vehicle.pose()
        if plant.plant.vehicle.armed:  # it falls when all is over
            places.append(pose.position)
            tilts.append(1.0 - 2.0 * (pose.attitude[1] ** 2 + pose.attitude[2] ** 2))

    plant.sleep_until = watch
    limits = SafetyLimits.of_track(CIRCLE, still_time=3600.0)
    flyer = IdentificationFlyer()
    chain = FlightChain(flyer, CIRCLE, ChainConfig(limits, arm=True))
    assert plant.fly(chain, flyer.rate, 12.0) == "12 s are over"
    flown = np.array(places[200:])
    assert np.abs(flown - (*CIRCLE.start_position[:2], CIRCLE.start_position[2] + 0.3)).max() < 1.0
    assert np.degrees(np.arccos(min(tilts))) < 40.0
