"""The vehicle's interface in SI units: poses (measured), setpoints and commands (sent), and the `Link` protocol.

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
    """The vehicle's position, attitude and velocities at one time.

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
    """The thrust and body rates that the flight controller is asked for.

    Args:
        collective_thrust: m/s² along body +z, thrust divided by mass; at least 0.
        body_rates: (3,) rad/s, body frame.
    """

    collective_thrust: float
    body_rates: np.ndarray


class Command(NamedTuple):
    """One message to the vehicle.

    Args:
        armed: Whether motors may turn. If not, a link sends its protocol's disarmed command and ignores the setpoint.
        setpoint: Thrust and body rates.
    """

    armed: bool
    setpoint: Setpoint


def hover() -> Setpoint:
    """Return the setpoint that holds altitude when level."""
    return Setpoint(GRAVITY, np.zeros(3))


def at_rest() -> Command:
    """Return the command that keeps a vehicle on the ground: disarmed, no thrust."""
    return Command(False, Setpoint(0.0, np.zeros(3)))


class Link(Protocol):
    """Sends commands to a vehicle, and receives its battery voltages, IMU samples and status."""

    @property
    def refusal(self) -> str:
        """Why the flight controller does not follow commands, or would not if armed; empty if no reason is known."""

    def send(self, command: Command) -> bytes:
        """Send a command without blocking; return the bytes sent, none if it was dropped."""

    def listen(self) -> list[Reading]:
        """Return the battery voltages received since the last call, oldest first, without blocking."""

    def read_imu(self) -> list[ImuReading]:
        """Return the IMU samples received up to the last `listen`, oldest first; called at every tick."""

    def set_voltage(self, voltage: float) -> None:
        """Convert thrust to throttle by this voltage, V, from now on; no effect if thrust is sent in SI units."""

    def close(self) -> None:
        """Close the socket or device; may be called twice."""
