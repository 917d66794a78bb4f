"""MAVLink 2 to PX4: SET_ATTITUDE_TARGET with body rates and thrust, and the command that arms.

Not for ArduPilot, see docs/hil_wiring.md. Disarming is forced: it stops the motors in the air too, as the arm switch of
the other links does. Unlike that switch it works in every mode, so it is not sent before this link has armed the
vehicle, nor once its HEARTBEAT says that a pilot has switched the armed vehicle to another mode than offboard: a
pilot's flight goes on. A mode that PX4 has changed by itself, in a failsafe, is none of a pilot.

Thrust is sent as the motors' command (`ThrustMap.to_motor`), which PX4 passes on unchanged with ``THR_MDL_FAC = 0``.

The battery's voltage comes in BATTERY_STATUS (``id`` 0; mV of each cell, 65535 for missing ones; if only the voltage of
the whole is known, it is in the first) or in SYS_STATUS (mV; 65535: unknown). Gyro and accelerometer come in
HIGHRES_IMU (rad/s, m/s², FRD) or SCALED_IMU (mrad/s, mG): the vehicle must be set to send one of them as often as
commands come.

Reference: mavlink.io/en/messages/common.html; modes: PX4-Autopilot, ``px4_custom_mode.h``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dreamer_racing.commands import import_extra
from dreamer_racing.hil.imu import make_sample
from dreamer_racing.hil.links.link import Telemetry, Transport, TransportLink
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.hil.vehicle import GRAVITY, Command, Setpoint

SYSTEM, AUTOPILOT = 1, 1  # IDs of the vehicle and of its autopilot
IGNORE_ATTITUDE = 128  # ATTITUDE_TARGET_TYPEMASK: rates and thrust count, the attitude does not
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
FORCE = 21196.0  # second parameter of COMPONENT_ARM_DISARM: disarm even in flight
STANDARD_GRAVITY = 9.80665  # m/s² per G in SCALED_IMU
FIRST_BATTERY = 0
UNKNOWN = 65535  # mV, value of an unknown voltage
_LONGEST = Setpoint(GRAVITY, np.ones(3))  # without zeros, which the wire omits at a message's end
PX4 = 12  # MAV_AUTOPILOT_PX4
MAIN_MODE = 16  # lowest bit of PX4's main mode in HEARTBEAT's custom_mode
OFFBOARD = 6
CRITICAL = 5  # MAV_STATE_CRITICAL: PX4 itself has changed the mode, in a failsafe
MODES = {
    1: "manual", 2: "altitude", 3: "position", 4: "an automatic", 5: "acro", 7: "stabilized", 11: "altitude cruise",
}  # fmt: skip
"""PX4's main modes beside offboard, to which a pilot may switch."""
ARM_TRIES = 5
"""Arm messages sent from the first armed command on: one may be lost, but a vehicle that has disarmed itself later must
not be armed again [choice]."""


def import_messages(who: str) -> Any:
    """Return the module of MAVLink 2's common messages, which ``who`` needs.

    Raises:
        ImportError: pymavlink is not installed.
    """
    return import_extra("pymavlink.dialects.v20.common", "hil", f"{who} needs pymavlink")


class MavlinkLink(TransportLink):
    """Sends attitude targets, and arms and disarms.

    Of the thrust map ``idle`` and ``min_check`` are not used.

    Raises:
        ImportError: pymavlink is not installed.
    """

    thrust: ThrustMap
    _telemetry: MavlinkTelemetry

    def __init__(self, transport: Transport, thrust: ThrustMap) -> None:
        super().__init__(transport, thrust, MavlinkTelemetry())
        self._common = import_messages("The link mavlink")
        self._sender = self._common.MAVLink(None, SYSTEM, self._common.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._armed_for = 0  # commands in a row
        self._has_armed = False  # whether this link ever armed; it disarms only what it has armed

    @property
    def longest(self) -> int:
        """Bytes of the longest command: one that arms."""
        return len(self._switch(armed=True) + self._attitude_target(Command(True, _LONGEST)))

    def encode(self, command: Command) -> bytes:
        """Return the messages of a command: arm or disarm, if due, and the attitude target."""
        self._armed_for = self._armed_for + 1 if command.armed else 0
        self._has_armed = self._has_armed or command.armed
        due = self._has_armed and self._armed_for <= ARM_TRIES and not self._telemetry.pilot_mode
        return (self._switch(command.armed) if due else b"") + self._attitude_target(command)

    def _switch(self, armed: bool) -> bytes:
        force = 0.0 if armed else FORCE
        confirmation = max(self._armed_for - 1, 0)
        arm = self._common.MAV_CMD_COMPONENT_ARM_DISARM
        return self._pack(
            self._common.MAVLink_command_long_message(
                SYSTEM, AUTOPILOT, arm, confirmation, float(armed), force, 0, 0, 0, 0, 0
            )
        )

    def _attitude_target(self, command: Command) -> bytes:
        thrust = self.thrust.to_motor(command.setpoint.collective_thrust)
        forward, left, up = (float(rate) for rate in command.setpoint.body_rates)
        rates_frd = forward, -left, -up
        milliseconds = int(1000 * time.monotonic()) % 2**32
        return self._pack(
            self._common.MAVLink_set_attitude_target_message(
                milliseconds, SYSTEM, AUTOPILOT, IGNORE_ATTITUDE, [1.0, 0.0, 0.0, 0.0], *rates_frd, thrust
            )
        )

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._sender))
        self._sender.seq = (self._sender.seq + 1) % 256
        return data


class MavlinkTelemetry(Telemetry):
    """Reads BATTERY_STATUS (of the first battery), SYS_STATUS, HEARTBEAT and the IMU's messages, by pymavlink.

    Attributes:
        mode: PX4's main mode; None before a HEARTBEAT, or of another autopilot.
        pilot_mode: Name of the mode to which a pilot has switched the armed vehicle; empty if none is known to have.

    Raises:
        ImportError: pymavlink is not installed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mode: int | None = None
        self.pilot_mode = ""
        self._parser = import_messages("The link mavlink").MAVLink(None)
        self._parser.robust_parsing = True  # damaged messages come out as BAD_DATA

    def read(self, data: bytes) -> list[float]:
        """Parse bytes; return the voltages in them, V, oldest first."""
        voltages: list[float] = []
        for message in self._parser.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.rejected += 1
            elif message.get_srcSystem() != SYSTEM:
                continue
            elif kind in SAMPLES:
                self._add(self.imu_samples, SAMPLES[kind](message))
            elif kind == "HEARTBEAT" and message.get_srcComponent() == AUTOPILOT and message.autopilot == PX4:
                self.mode = message.custom_mode >> MAIN_MODE & 0xFF
                by_hand = message.base_mode & ARMED and self.mode != OFFBOARD and message.system_status != CRITICAL
                self.pilot_mode = MODES.get(self.mode, "another") if by_hand else ""
            elif kind in VOLTAGES and not (kind == "BATTERY_STATUS" and message.id != FIRST_BATTERY):
                self._add(voltages, VOLTAGES[kind](message))
        return voltages

    def refusal(self, armed: bool) -> str:
        """Return why the vehicle does not, or would not, follow commands; empty if no reason is known."""
        if self.pilot_mode:
            return f"the pilot has taken over, in {self.pilot_mode} mode"
        return "" if armed or self.mode in (None, OFFBOARD) else "it is not in offboard mode"


def _of_battery_status(message: Any) -> float | None:
    cells = [cell for cell in (*message.voltages, *message.voltages_ext) if 0 < cell < UNKNOWN]
    return sum(cells) / 1000 if cells else None


VOLTAGES: dict[str, Callable[[Any], float | None]] = {
    "BATTERY_STATUS": _of_battery_status,
    "SYS_STATUS": lambda message: None if message.voltage_battery == UNKNOWN else message.voltage_battery / 1000,
}
"""Reader of the voltage, V, by message name; it returns None if the voltage is unknown."""


def _of_imu(message: Any, gyro: float, force: float) -> np.ndarray | None:
    """Return an FLU sample from FRD values in units of ``gyro`` rad/s and ``force`` m/s²."""
    return make_sample(
        (gyro * message.xgyro, -gyro * message.ygyro, -gyro * message.zgyro),
        (force * message.xacc, -force * message.yacc, -force * message.zacc),
    )


SAMPLES: dict[str, Callable[[Any], np.ndarray | None]] = {
    "HIGHRES_IMU": lambda message: _of_imu(message, 1.0, 1.0),
    "SCALED_IMU": lambda message: _of_imu(message, 1e-3, 1e-3 * STANDARD_GRAVITY),
}
"""Reader of the IMU's sample, by message name; it returns None if numbers are implausible."""
