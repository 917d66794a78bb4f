"""Converts setpoints to the sticks of a radio, by which a Betaflight flight controller is flown.

Rates and thrust are mapped separately: `RateMap` is the flight controller's map from sticks to rates, fixed by its
configuration; `ThrustMap` is the map from throttle to thrust of motors and battery, which changes in flight.

| stick | +1 means | in `Setpoint` | channel |
|---|---|---|---|
| roll | roll right | +x | 1 |
| pitch | stick forward, nose down | +y | 2 |
| throttle, 0 to 1 | full throttle | +collective thrust | 3 |
| yaw | yaw right | −z | 4 |

Reference: Betaflight, src/main/fc/rc.c (rates, throttle) and src/main/flight/mixer.c (motor idle).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from dreamer_racing.hil.vehicle import GRAVITY, Command
from dreamer_racing.settings import ALLOWED, Range, check_settings

LOWEST, CENTRE, HIGHEST = 1000.0, 1500.0, 2000.0  # ends and centre of a channel, µs
CHANNELS = 16
FIRST_SWITCH = 4  # index of AUX1, the first channel that is no stick
_RATE = Range(0, math.radians(2000), open_below=True)  # Betaflight's rc_rate ends at 200, in units of 10 deg/s
_PHYSICAL = Range(0, 1e4, open_below=True)


@dataclass(frozen=True)
class RateMap:
    """The linear map from stick positions to body rates.

    In Betaflight: ``rates_type = ACTUAL``, expo 0, and rc_rate and srate both a tenth of the largest rate in deg/s.

    Raises:
        ValueError: No flight controller can be set to such rates; the message gives the field and what is allowed.

    Example:
        >>> RateMap(roll=10.0, pitch=10.0, yaw=4.0).to_sticks(np.array([5.0, -10.0, 1.0]))
        (0.5, -1.0, -0.25)
    """

    roll: float = field(metadata={ALLOWED: _RATE})  # rad/s at full stick
    pitch: float = field(metadata={ALLOWED: _RATE})  # rad/s at full stick
    yaw: float = field(metadata={ALLOWED: _RATE})  # rad/s at full stick

    def __post_init__(self) -> None:
        check_settings(self, "RateMap.")

    def to_sticks(self, body_rates: np.ndarray) -> tuple[float, float, float]:
        """Return roll, pitch and yaw stick for body rates (3,) in rad/s; full stick if they are larger."""
        roll, pitch, yaw = (float(rate) for rate in body_rates)
        return _clamp(roll / self.roll, -1, 1), _clamp(pitch / self.pitch, -1, 1), _clamp(-yaw / self.yaw, -1, 1)


@dataclass(frozen=True)
class ThrustMap:
    """The map from throttle to thrust, proportional to the squares of motor command and battery voltage.

    ``motor = idle + (1 − idle) (µs − min_check) / (2000 − min_check)``, and
    ``thrust = full_thrust (voltage / reference_voltage)² motor²``.

    Raises:
        ValueError: No flying drone has such values; the message gives the field, its value, and what is allowed.

    Example:
        >>> thrust = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)
        >>> round(thrust.to_motor(9.81), 3), round(thrust.to_sticks(9.81), 3)
        (0.607, 0.604)
    """

    mass: float = field(metadata={ALLOWED: _PHYSICAL})  # kg, with battery
    # N, of all motors at full command and the reference voltage, as measured on a stand
    full_thrust: float = field(metadata={ALLOWED: _PHYSICAL})
    reference_voltage: float = field(metadata={ALLOWED: _PHYSICAL})  # V, of the battery under that load
    voltage: float = field(metadata={ALLOWED: _PHYSICAL})  # V, of the battery now; `at` updates it, see `hil.battery`
    # motor command at throttle 0: Betaflight's motor_idle (dshot_idle_value) [Betaflight's default and largest]
    idle: float = field(default=0.055, metadata={ALLOWED: Range(0, 0.2)})
    # µs, the channel's value up to which the throttle counts as 0; Betaflight's default
    min_check: float = field(default=1050.0, metadata={ALLOWED: Range(LOWEST, CENTRE)})

    def __post_init__(self) -> None:
        check_settings(self, "ThrustMap.")
        low, high = self._voltage_ends
        if not low <= self.voltage <= high:
            raise ValueError(
                f"ThrustMap.voltage={self.voltage} V: must be between {low:g} and {high:g} V, 0.5 to 1.5 times "
                "reference_voltage. Is one that of a cell and the other that of the whole battery?"
            )
        if not self.collective_thrust_max > GRAVITY:
            raise ValueError(
                f"ThrustMap.full_thrust={self.full_thrust} N: must lift mass={self.mass} kg, which weighs "
                f"{GRAVITY * self.mass:.3g} N, but is {self.collective_thrust_max * self.mass:.3g} N at "
                f"{self.voltage:g} V. Is it the thrust of all motors together?"
            )

    @property
    def _voltage_ends(self) -> tuple[float, float]:
        """Least and largest voltage that is plausible for the reference voltage, V."""
        return 0.5 * self.reference_voltage, 1.5 * self.reference_voltage

    def at(self, voltage: float) -> Self:
        """Return the map at another voltage, V, or at the nearest one that is allowed; this never raises.

        A voltage too low to lift the drone counts as one that just does; a non-finite one changes nothing.
        """
        if not math.isfinite(voltage):
            return self
        low, high = self._voltage_ends
        lifting = self.reference_voltage * math.sqrt(GRAVITY * self.mass / self.full_thrust) * (1.0 + 1e-6)
        low = max(low, min(lifting, self.voltage))  # the present voltage is allowed
        return replace(self, voltage=_clamp(voltage, low, high))

    @property
    def collective_thrust_max(self) -> float:
        """Collective thrust at full command and the voltage now, m/s²."""
        return self.full_thrust * (self.voltage / self.reference_voltage) ** 2 / self.mass

    def to_motor(self, collective_thrust: float) -> float:
        """Return the motor command in [0, 1] for a collective thrust in m/s²; 1 if that exceeds the largest."""
        return math.sqrt(_clamp(collective_thrust / self.collective_thrust_max, 0, 1))

    def to_sticks(self, collective_thrust: float) -> float:
        """Return the throttle in [0, 1] for a collective thrust in m/s².

        Thrust below that of idling motors gives a throttle below ``min_check``, which Betaflight needs for arming.
        """
        share = (self.to_motor(collective_thrust) - self.idle) / (1 - self.idle)
        return _clamp((self.min_check + share * (HIGHEST - self.min_check) - LOWEST) / (HIGHEST - LOWEST), 0, 1)


def channels(command: Command, rates: RateMap, thrust: ThrustMap, arm_channel: int = FIRST_SWITCH) -> tuple[float, ...]:
    """Return the 16 radio channels of a command.

    The order is Betaflight's ``map AETR1234``: roll, pitch, throttle, yaw, AUX1, … If the command is not armed, the
    throttle is down and the other sticks are centred, whatever the setpoint.

    Args:
        command: If it is armed, its setpoint must be finite.
        rates: Of roll, pitch and yaw.
        thrust: Of the throttle.
        arm_channel: Index of the arm switch: 2000 µs if armed, else 1000 µs; all other switches are always at 1000 µs.

    Returns:
        (16,) µs in [1000, 2000], not rounded.
    """
    if not command.armed:
        return (CENTRE, CENTRE, LOWEST, CENTRE, *[LOWEST] * (CHANNELS - FIRST_SWITCH))
    roll, pitch, yaw = (CENTRE + (HIGHEST - CENTRE) * stick for stick in rates.to_sticks(command.setpoint.body_rates))
    throttle = LOWEST + (HIGHEST - LOWEST) * thrust.to_sticks(command.setpoint.collective_thrust)
    switches = (HIGHEST if index == arm_channel else LOWEST for index in range(FIRST_SWITCH, CHANNELS))
    return (roll, pitch, throttle, yaw, *switches)


def _clamp(value: float, low: float, high: float) -> float:
    return float(min(max(value, low), high))
