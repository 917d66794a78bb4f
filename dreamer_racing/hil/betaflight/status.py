"""The status of a Betaflight by MSP: which modes are on, whether it is armed, and what prevents arming.

MSP_STATUS (101) is requested without payload. The answer's payload, little endian: cycle time u16, errors u16, sensors
u16, modes u32 (bit 0: armed), profile u8, load u16, u16; a u8 whose lowest 4 bits give the number n of further bytes of
modes, these n bytes, the number of arming-disable flags u8, and these flags u32. Names are those of the CLI's
``status``. The arm switch is the last flag in every release; those from 25 up to it depend on the release. The answer
to MSP_BOXIDS (119) gives the mode of each bit: a u8 each, its number in the CLI's ``aux``.

Reference: Betaflight, src/main/msp/msp.c (MSP_STATUS) and msp_box.c (MSP_BOXIDS); src/main/fc/runtime_config.h and .c;
https://betaflight.com/docs/wiki/guides/current/Arming-Sequence-And-Safety.
"""

from __future__ import annotations

from typing import NamedTuple

STATUS, BOXIDS = 101, 119  # codes of the messages
ARM, ANGLE, HORIZON, MSP_OVERRIDE = 0, 1, 2, 50  # numbers of modes

_REASONS = (
    ("NOGYRO", "it finds no gyro"),
    ("FAILSAFE", "its failsafe is active"),
    ("RXLOSS", "it receives no valid channels"),
    ("NOT_DISARMED", "it has recovered from a failsafe: disarm first"),
    ("BOXFAILSAFE", "the failsafe switch is on"),
    ("RUNAWAY", "runaway takeoff: motors did not respond as expected; disarm first"),
    ("CRASH", "it has detected a crash; disarm first"),
    ("THROTTLE", "the throttle is not low"),
    ("ANGLE", "it is not level (small_angle)"),
    ("BOOTGRACE", "it has just been started"),
    ("NOPREARM", "the prearm switch is off"),
    ("LOAD", "its CPU load is too high"),
    ("CALIB", "it is calibrating: keep it still"),
    ("CLI", "its CLI is open: type `exit`"),
    ("CMS", "its menu is open"),
    ("BST", "a Black Sheep Telemetry device forbids arming"),
    ("MSP", "a program forbids arming by MSP: is a configurator connected?"),
    ("PARALYZE", "it is in paralyze mode: power it off and on"),
    ("GPS", "GPS rescue is configured and there is no GPS fix"),
    ("RESCUE_SW", "the GPS rescue switch is on"),
    ("DSHOT_TELEM", "no telemetry comes from its motors"),
    ("REBOOT_REQD", "settings were changed: restart it"),
    ("DSHOT_BBANG", "DShot bitbang does not work on its pins"),
    ("NO_ACC_CAL", "its accelerometer is not calibrated"),
    ("MOTOR_PROTO", "no motor protocol is set"),
)
_SWITCH = ("ARM_SWITCH", "the arm switch was on before it could arm: switch it off and on again")
_HEAD = 16  # bytes up to and including the number of further bytes of modes
_LEAST = _HEAD + 5


class FlightControllerStatus(NamedTuple):
    """The status of a flight controller."""

    modes: int  # which are on, one bit each: the first is ARM, the others are given by MSP_BOXIDS
    flags: int  # what prevents arming, one bit each
    total: int  # number of flags that exist

    @property
    def armed(self) -> bool:
        """Whether its motors may turn."""
        return bool(self.modes & 1)

    @property
    def reasons(self) -> dict[str, str]:
        """What prevents arming, for a person, by the names of its CLI."""
        known = dict(enumerate(_REASONS)) | {self.total - 1: _SWITCH}
        bits = (bit for bit in range(32) if self.flags >> bit & 1)
        return dict(known.get(bit, (f"flag {bit}", "see `status` in its CLI")) for bit in bits)

    @property
    def words(self) -> str:
        """What prevents arming, in a sentence; empty if nothing does."""
        return "; ".join(f"{name}: {reason}" for name, reason in self.reasons.items())


def read_status(payload: bytes) -> FlightControllerStatus | None:
    """Return the status in the payload of an MSP_STATUS; None if it is too short to be one."""
    if len(payload) < _LEAST:
        return None
    at = _HEAD + (payload[_HEAD - 1] & 0x0F)
    if len(payload) < at + 5:
        return None
    modes = int.from_bytes(payload[6:10] + payload[_HEAD:at], "little")
    return FlightControllerStatus(modes, int.from_bytes(payload[at + 1 : at + 5], "little"), payload[at])


NOT_READY = frozenset({"NOGYRO", "ANGLE", "BOOTGRACE", "CALIB", "CLI"})
"""Flags that prevent arming while a firmware boots; the others depend on its pilot."""

REQUEST = b"$M<" + bytes([0, STATUS, STATUS])  # request of the status: 6 bytes of MSP version 1
BOXIDS_REQUEST = b"$M<" + bytes([0, BOXIDS, BOXIDS])  # request of the list of modes, in the order of the status bits
