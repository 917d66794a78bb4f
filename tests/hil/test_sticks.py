"""Sticks: signs, scales and clamps against values worked out by hand, and every map against its inverse."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.sticks import RateMap, Sticks, ThrustMap, channels, from_sticks, to_sticks
from dreamer_racing.hil.vehicle import GRAVITY, Command, Setpoint, at_rest, hover

RATES = RateMap(roll=10.0, pitch=8.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)
IDLE_THRUST = 0.055**2 * 16.0 / 0.6  # m/s²


def armed(thrust: float = GRAVITY, rates: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Command:
    return Command(True, Setpoint(thrust, np.array(rates)))


@pytest.mark.parametrize(
    ("rates", "sticks"),
    [
        ((5.0, 0.0, 0.0), (0.5, 0.0, 0.0)),  # rolls right: stick right
        ((0.0, 2.0, 0.0), (0.0, 0.25, 0.0)),  # nose down: stick forward
        ((0.0, 0.0, 1.0), (0.0, 0.0, -0.25)),  # yaws left: stick left
        ((-50.0, 50.0, 50.0), (-1.0, 1.0, -1.0)),
    ],
)
def test_signs_and_ends_of_sticks(rates, sticks):
    assert RATES.to_sticks(np.array(rates)) == sticks


def test_hover_of_the_projects_drone():
    """motor² · 16 N = 0.6 kg · 9.81 m/s², and the throttle by Betaflight's formula."""
    motor = math.sqrt(0.6 * 9.81 / 16.0)
    assert motor == pytest.approx(0.6065, abs=1e-4)  # .607 in Betaflight's own simulation
    assert THRUST.to_motor(9.81) == pytest.approx(motor)
    microseconds = 1050 + (motor - 0.055) / 0.945 * 950
    assert microseconds == pytest.approx(1604.45, abs=0.01)
    assert channels(Command(True, hover()), RATES, THRUST) == pytest.approx(
        [1500, 1500, microseconds, 1500, 2000, *[1000] * 11]
    )


def test_throttle_of_the_firmware():
    """At 1500 µs real firmware runs its motors at .502."""
    assert THRUST.from_sticks(0.5) == pytest.approx(0.5026**2 * 16.0 / 0.6, rel=1e-3)
    assert THRUST.from_sticks(0.0) == THRUST.from_sticks(0.05) == pytest.approx(IDLE_THRUST)
    assert THRUST.from_sticks(1.0) == pytest.approx(16.0 / 0.6)


def test_a_flat_battery_needs_more_throttle():
    low = dataclasses.replace(THRUST, voltage=13.5)
    assert low.to_motor(9.81) == pytest.approx(THRUST.to_motor(9.81) / 0.9)
    assert low.from_sticks(1.0) == pytest.approx(0.81 * THRUST.from_sticks(1.0))
    assert low.to_sticks(0.9 * 16.0 / 0.6) == 1.0  # more than there is left


@given(
    thrust=st.floats(IDLE_THRUST, 16.0 / 0.6),
    roll=st.floats(-10, 10),
    pitch=st.floats(-8, 8),
    yaw=st.floats(-4, 4),
)
def test_sticks_lead_back_to_the_setpoint(thrust, roll, pitch, yaw):
    setpoint = from_sticks(to_sticks(Setpoint(thrust, np.array([roll, pitch, yaw])), RATES, THRUST), RATES, THRUST)
    assert setpoint.collective_thrust == pytest.approx(thrust, abs=1e-9)
    assert setpoint.body_rates == pytest.approx([roll, pitch, yaw], abs=1e-9)


@given(
    mass=st.floats(0.1, 1.0),
    voltage=st.floats(12, 17),
    idle=st.floats(0, 0.2),
    min_check=st.floats(1000, 1200),
    throttle=st.floats(0.21, 1.0),
)
def test_thrust_leads_back_to_the_throttle(mass, voltage, idle, min_check, throttle):
    thrust = ThrustMap(mass, 20.0, 15.0, voltage, idle, min_check)
    assert thrust.to_sticks(thrust.from_sticks(throttle)) == pytest.approx(throttle, abs=1e-9)


@given(
    thrust=st.floats(-1e6, 1e6),
    rates=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    is_armed=st.booleans(),
    arm_channel=st.integers(4, 15),
)
def test_channels_stay_within_their_ends(thrust, rates, is_armed, arm_channel):
    values = channels(Command(is_armed, Setpoint(thrust, np.array(rates))), RATES, THRUST, arm_channel)
    assert len(values) == 16 and min(values) >= 1000.0 and max(values) <= 2000.0
    assert [index for index, value in enumerate(values[4:], 4) if value != 1000.0] == [arm_channel] * is_armed


def test_order_of_channels():
    """Roll, pitch, throttle, yaw; by Betaflight's default map AETR1234."""
    values = channels(armed(16.0 / 0.6, (10.0, -8.0, 2.0)), RATES, THRUST)
    assert values == (2000, 1000, 2000, 1250, 2000, *[1000] * 11)


@pytest.mark.parametrize(
    "command", [at_rest(), armed(20.0, (1.0, 2.0, 3.0))._replace(armed=False), armed(math.nan)._replace(armed=False)]
)
def test_disarmed_is_throttle_down_and_sticks_centred(command):
    assert channels(command, RATES, THRUST) == (1500, 1500, 1000, 1500, *[1000] * 12)


def test_armed_without_thrust_is_low_enough_to_arm():
    """Betaflight refuses to arm unless the throttle is below min_check."""
    assert channels(armed(0.0), RATES, THRUST)[2] == 1000


@pytest.mark.parametrize("arm_channel", [-1, 0, 3, 16])
def test_a_stick_arms_nothing(arm_channel):
    with pytest.raises(ValueError, match=f"arm_channel={arm_channel}: an index of 4"):
        channels(armed(), RATES, THRUST, arm_channel)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 573.0])
@pytest.mark.parametrize("field", ["roll", "pitch", "yaw"])
def test_rates_that_are_none(field, value):
    """573 is 10 rad/s, in deg/s."""
    with pytest.raises(ValueError, match=f"RateMap.{field}="):
        dataclasses.replace(RATES, **{field: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": 0.0}, "ThrustMap.mass=0.0: must be above 0"),
        ({"mass": math.nan}, "ThrustMap.mass=nan"),
        ({"mass": 600.0}, "ThrustMap.full_thrust=16.0 N: must lift mass=600.0 kg"),
        ({"full_thrust": 4.0}, "ThrustMap.full_thrust=4.0 N: .* all motors together"),
        ({"full_thrust": -16.0}, "ThrustMap.full_thrust=-16.0"),
        ({"reference_voltage": 0.0}, "ThrustMap.reference_voltage=0.0"),
        ({"voltage": 3.75}, "ThrustMap.voltage=3.75 V: must be between 7.5 and 22.5 V"),
        ({"voltage": 0.0}, "ThrustMap.voltage=0.0"),
        ({"idle": 5.5}, "ThrustMap.idle=5.5: must be at least 0 and at most 0.2"),
        ({"min_check": 50.0}, "ThrustMap.min_check=50.0: must be at least 1000"),
    ],
)
def test_drones_that_are_none(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(THRUST, **changes)


def test_sticks_have_names():
    assert to_sticks(Setpoint(0.0, np.array([10.0, 0.0, 0.0])), RATES, THRUST) == Sticks(1.0, 0.0, 0.0, 0.0)
