"""Claimed velocities against positions: motions whose mismatch is known in closed form."""

from __future__ import annotations

import math

import pytest

from dreamer_racing.hil.odometer import Odometer
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
