"""The real Betaflight firmware as flight controller, built for a computer (SITL), in a separate process.

It receives the state of the vehicle (UDP port 9003) and answers with motor commands (9002), both little endian:

| packet | bytes | content |
|---|---|---|
| state | 144 | 18 f64: time, body rates, acceleration, attitude wxyz, velocity, position, air pressure in Pa |
| motors | 16 | 4 f32 in [0, 1]; idle is above 0, disarmed is 0 |

The firmware inverts the signs of some: the whole acceleration, body rates about y, and about z before 2026.6. Its
channels (9004) come from `hil.links`. All traffic is meant to stay on one machine.

Reference: Betaflight, src/platform/SIMULATOR/sitl.c (updateState) and target/SITL/target.h (fdm_packet, servo_packet);
measured answers of the firmware.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.vehicle import Pose
from dreamer_racing.plant.commands import TIMEOUT, Failsafe
from dreamer_racing.plant.vehicle import PlantVehicle

STATE_PORT, MOTOR_PORT = 9003, 9002
_STATE, _MOTORS = struct.Struct("<18d"), struct.Struct("<4f")
_STAMP = 1.0  # s, constant: the firmware paces its clock by timestamps, and loses the radio if they jitter


class PacketConvention(NamedTuple):
    """Conventions of a firmware's packets."""

    # (4,) index of the rotor of each motor command: M1 … M4 are rear right, front right, rear left, front left, indices
    # 0 … 3
    rotors: tuple[int, int, int, int]
    yaw_rate_sign: float  # sign of the body rate about z in state packets, relative to FLU


CONVENTIONS = {"2026.6": PacketConvention((0, 1, 2, 3), 1.0), "before": PacketConvention((1, 2, 3, 0), -1.0)}
"""By the firmware's version: 2026.6 and later, or before."""


def convention_of(release: str) -> PacketConvention:
    """Return the packet conventions of a release: 4.6.0, 2025.12, 2026.12.0-alpha, or ``before`` for any before 2026.6.

    Raises:
        ValueError: It is not the number of a release.
    """
    if release in CONVENTIONS:
        return CONVENTIONS[release]
    number = re.match(r"(\d+)\.(\d+)", release)
    if number is None:
        raise ValueError(f"betaflight={release}: must be a firmware release, as 4.6 or 2026.6, or before (any older).")
    return CONVENTIONS["2026.6" if (int(number[1]), int(number[2])) >= (2026, 6) else "before"]


def encode_state(pose: Pose, specific_force: np.ndarray, convention: PacketConvention) -> bytes:
    """Return the state packet for the firmware; specific force: (3,) m/s², body frame, +9.81 upwards at rest."""
    x, y, z = pose.body_rates
    rates = (x, -y, convention.yaw_rate_sign * z)
    pressure = 101325.0 * (1.0 - 2.25577e-5 * pose.position[2]) ** 5.25588  # Pa, standard atmosphere
    vectors = (rates, -specific_force, pose.attitude, pose.linear_velocity, pose.position)
    return _STATE.pack(_STAMP, *(float(number) for vector in vectors for number in vector), pressure)


def decode_motors(data: bytes, convention: PacketConvention) -> np.ndarray | None:
    """Return the motor commands (4,) in [0, 1] by rotor; None if the packet is invalid."""
    if len(data) != _MOTORS.size:
        return None
    motors = np.array(_MOTORS.unpack(data))
    if not np.isfinite(motors).all():
        return None
    rotors = np.empty(4)
    rotors[list(convention.rotors)] = motors.clip(0.0, 1.0)
    return rotors


class BetaflightSitl:
    """`Controls` that fly the vehicle by the motor commands of the firmware.

    Args:
        vehicle: Its delay and body-rate controller are not used.
        send: Sends a state packet to the firmware.
        firmware: Its release, see `convention_of`.
        timeout: s, of `Failsafe`.

    Attributes:
        received: Number of motor packets.
        malformed: Number of messages that were not motor packets.
    """

    def __init__(
        self, vehicle: PlantVehicle, send: Callable[[bytes], object], firmware: str, timeout: float = TIMEOUT
    ) -> None:
        self._vehicle, self._send, self._convention = vehicle, send, convention_of(firmware)
        self._sent = 0
        self.failsafe = Failsafe(timeout)
        self.received = self.malformed = 0

    @property
    def due(self) -> float:
        """When the next state is to be sent: once every physics step."""
        return self._sent * self._vehicle.parameters.physics_dt

    def act(self, time: float) -> None:
        """Send the state, and cut the motors if nothing was heard for too long."""
        if self.failsafe.expire(time):
            self._vehicle.cut()
        self._sent += 1
        self._send(encode_state(self._vehicle.pose(), self._vehicle.specific_force, self._convention))

    def take(self, data: bytes, time: float) -> bool:
        """Apply a motor packet; return whether it was valid."""
        motors = decode_motors(data, self._convention)
        if motors is None:
            self.malformed += 1
            return False
        self.received += 1
        armed = self.failsafe.hear(bool((motors > 0.0).any()), time)
        self._vehicle.turn_rotors(motors if armed else np.zeros(4))
        return True

    def summary(self) -> str:
        """Return a phrase on what was received."""
        return f"{self.received} motor packets ({self.malformed} malformed), {self.failsafe.events} failsafe(s)"
