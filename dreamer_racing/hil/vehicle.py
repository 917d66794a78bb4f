"""What is known of the vehicle and what is asked of it: the two ends of every flight, in SI units.

World frame z up; body frame FLU (x forward, y left, z up), right-handed: +x rolls right, +y pitches the nose down,
+z yaws left. Attitudes are wxyz, body → world.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.battery import Reading
from dreamer_racing.hil.imu import ImuReading


class Pose(NamedTuple):
    """Where the vehicle was, and how it moved, at a time.

    Args:
        time: s, on the clock of the loop (``time.monotonic``).
        position: (3,) m, world.
        attitude: (4,) wxyz, unit length.
        linear_velocity: (3,) m/s, world.
        body_rates: (3,) rad/s, body frame.
    """

    time: float
    position: np.ndarray
    attitude: np.ndarray
    linear_velocity: np.ndarray
    body_rates: np.ndarray


class Setpoint(NamedTuple):
    """What the flight controller is asked to do.

    Args:
        collective_thrust: m/s² along body +z, thrust divided by mass; at least 0.
        body_rates: (3,) rad/s, body frame.
    """

    collective_thrust: float
    body_rates: np.ndarray


class Command(NamedTuple):
    """One message to the vehicle.

    Args:
        armed: Whether motors may turn at all; where not, a link says so in its own way whatever the setpoint is.
        setpoint: What is asked for.
    """

    armed: bool
    setpoint: Setpoint


def hover() -> Setpoint:
    """Return the setpoint that holds altitude when level."""
    return Setpoint(GRAVITY, np.zeros(3))


def at_rest() -> Command:
    """Return the command with which a vehicle stays on the ground: disarmed, no thrust."""
    return Command(False, Setpoint(0.0, np.zeros(3)))


class Link(Protocol):
    """Carries commands to a vehicle, and back what it says of its battery, of its IMU and of itself."""

    @property
    def refusal(self) -> str:
        """Why the flight controller does not fly what it is told, or would not; empty as far as is known."""
        ...

    def send(self, command: Command) -> bytes:
        """Send a command now, without waiting; return the bytes that went out, none if it was dropped."""
        ...

    def listen(self) -> list[Reading]:
        """Return the battery's voltages that have come back since the last call, oldest first, without waiting."""
        ...

    def feel(self) -> list[ImuReading]:
        """Return what the vehicle's IMU told until the last `listen`, oldest first; asked of links that hear one."""
        ...

    def reckon_with(self, voltage: float) -> None:
        """Turn thrust into a throttle by a voltage, V, from now on; nothing where thrust is sent as it is."""
        ...

    def close(self) -> None:
        """Give back socket or device; may be called twice."""
        ...
