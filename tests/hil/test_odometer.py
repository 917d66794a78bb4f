"""Claimed velocities and body rates against positions and attitudes: motions of known mismatch."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.odometer import Odometer, TurnOdometer
from dreamer_racing.hil.velocity import GAP


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


def test_after_a_gap_it_begins_anew():
    odometer = Odometer(0.075)
    for step in range(6):
        odometer.mismatch(0.04 * step, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert odometer.mismatch(0.2 + GAP + 0.01, (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)) is None


def test_a_lie_is_forgotten_once_it_is_behind_the_window():
    odometer = Odometer(0.075)
    said = [odometer.mismatch(0.04 * step, (0.0, 0.0, 0.0), (8.0 * (step == 3), 0.0, 0.0)) for step in range(8)]
    assert said[2:] == pytest.approx([0.0, 2.0, 4.0, 2.0, 0.0, 0.0], abs=1e-9)


def turned_by(true_rates, claimed, count=40, period=0.005):
    """What is said at last of a vehicle that turns with rates of time, (3,) rad/s, and claims others."""
    odometer, attitude, said = TurnOdometer(0.075), np.array([1.0, 0.0, 0.0, 0.0]), None
    for step in range(count):
        time = step * period
        said = odometer.mismatch(time, tuple(attitude.tolist()), tuple(claimed(time).tolist()))
        for part in range(20):
            attitude = turn(attitude, period / 20 * true_rates(time + (part + 0.5) * period / 20))
    return said


def swaying(time):
    """Body rates about an axis that moves, of up to 10 rad/s."""
    return np.array([7.0 * math.sin(20.0 * time), 7.0 * math.cos(17.0 * time), 3.0])


def test_rates_about_a_moving_axis_agree_with_the_attitudes_that_they_lead_to():
    assert turned_by(swaying, swaying) < 0.1


@pytest.mark.parametrize(
    ("claims", "expected"),
    [(-1.0, 12.0), (0.0, 6.0), (1.5, 3.0), (math.degrees(1.0) * 1e-2, 6.0 * (1 - math.degrees(1.0) * 1e-2))],
)
def test_rates_that_are_not_those_of_the_attitudes_are_off_by_the_difference(claims, expected):
    steady = np.array([0.0, 6.0, 0.0])
    assert turned_by(lambda _: steady, lambda _: claims * steady) == pytest.approx(expected, rel=1e-3)


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


def test_a_gap_in_which_a_vehicle_may_have_turned_there_and_back_says_nothing():
    odometer = TurnOdometer(0.075, gap=0.05)
    level = (1.0, 0.0, 0.0, 0.0)
    for step in range(6):
        odometer.mismatch(0.02 * step, level, (0.0, 0.0, 0.0))
    said = [odometer.mismatch(0.18 + 0.02 * step, level, (10.0 * (step == 0), 0.0, 0.0)) for step in range(4)]
    assert said == [None] * 4
