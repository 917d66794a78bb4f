"""MSP version 1 (MultiWii serial protocol): SET_RAW_RC, BATTERY_STATE, RAW_IMU and STATUS, over a serial port or TCP.

A channel message has 38 bytes, little endian: ``b"$M<"``, size 32 of the payload, code 200, 16 u16 µs, and the XOR of
all bytes after ``<``. Betaflight needs ``feature RX_MSP``, and at least five messages a second. If MSP overrides the
sticks of a receiver, only these four are sent, 14 bytes: without an arm channel they cannot arm.

The flight controller's status (101, `hil.betaflight.status`) is requested with the battery.

The battery is requested by code 130 without payload. The answer begins with ``b"$M>"``; its payload of 11 bytes is:
cells u8 (0: no battery), capacity u16 (mAh), voltage u8 (0.1 V), drawn u16 (mAh), current i16 (0.01 A), alert u8, and
voltage u16 (0.01 V), which is the one that is read. Releases before 4.0 lack it.

The IMU is requested likewise (code 102). The payload of the answer, 18 bytes, is nine i16: acceleration, body rates and
magnetic field, each x, y, z; the first two are in FLU, with the signs of a 4.6 that was built for a computer (SITL).
Body rates are raw counts of ±2000 deg/s, 16.4 per deg/s, and 512 counts of acceleration are 1 g (256 in SITL).

Reference: Betaflight, src/main/msp/msp_serial.c, msp_protocol.h and msp.c (MSP_BATTERY_STATE, MSP_RAW_IMU).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from functools import reduce
from operator import xor

import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.betaflight.status import (
    ANGLE,
    BOXIDS,
    BOXIDS_REQUEST,
    HORIZON,
    MSP_OVERRIDE,
    REQUEST,
    STATUS,
    FlightControllerStatus,
    read_status,
)
from dreamer_racing.hil.imu import make_sample
from dreamer_racing.hil.links.link import FrameReader, Telemetry

SET_RAW_RC, BATTERY_STATE, RAW_IMU = 200, 130, 102
BATTERY_REQUEST = b"$M<" + bytes([0, BATTERY_STATE, BATTERY_STATE])  # request of the battery's state: 6 bytes
MSP_REQUEST = BATTERY_REQUEST + REQUEST  # request of battery and status, sent every `ASK_EVERY` commands
OVERRIDE_REQUEST = MSP_REQUEST + BOXIDS_REQUEST  # the same, and a request of the list of modes
_BATTERY_PAYLOAD = 11
UNANSWERED = 5  # requests without an answer after which a status is out of date [choice]: a second at 25 Hz
IMU_REQUEST = b"$M<" + bytes([0, RAW_IMU, RAW_IMU])  # request of an IMU sample: 6 bytes
GYRO_COUNTS = 16.4  # counts of the gyro per deg/s
G_COUNTS, G_COUNTS_SITL = 512.0, 256.0
"""Counts of acceleration per 9.81 m/s²: of sensors, and of a firmware that was built for a computer."""
_IMU = struct.Struct("<6h")
_STICKS = 4


def encode_msp(channels: Sequence[float]) -> bytes:
    """Return the message of channels, usually 16, in µs, rounded to 1 µs."""
    words = struct.pack(f"<{len(channels)}H", *(round(value) for value in channels))
    frame = b"$M<" + bytes([len(words), SET_RAW_RC]) + words + b"\0"
    return frame[:-1] + bytes([_checksum(frame)])


def encode_sticks(channels: Sequence[float]) -> bytes:
    """Return the message of the four sticks of 16 channels."""
    return encode_msp(channels[:_STICKS])


class MspTelemetry(Telemetry):
    """Reads answers to `OVERRIDE_REQUEST` and `IMU_REQUEST`.

    Args:
        g_counts: Counts of acceleration per 9.81 m/s².
        override: Whether MSP overrides a receiver, whose pilot arms, hands over and takes back.

    Attributes:
        status: Last status of the flight controller; None before the first.
        boxes: Numbers of its modes, in the order of the status bits; None if not received yet.
    """

    def __init__(self, g_counts: float = G_COUNTS, override: bool = False) -> None:
        super().__init__()
        self._frames = FrameReader(size_of, is_whole)
        self.status: FlightControllerStatus | None = None
        self.boxes: bytes | None = None
        self._override = override
        self._scale = math.radians(1.0 / GYRO_COUNTS), GRAVITY / g_counts

    def read(self, data: bytes) -> list[float]:
        """Parse bytes; return the voltages in them, V, in steps of 0.01 V."""
        voltages: list[float] = []
        for frame in self._frames.read(data):
            if frame is None:
                self.rejected += 1
                continue
            kind, payload, answered = frame[4], frame[5:-1], frame[2] == ord(">")
            if kind == BATTERY_STATE:
                self._add(voltages, _voltage(payload) if answered else None)
            elif kind == RAW_IMU:
                self._add(self.imu_samples, self._sample(payload) if answered else None)
            elif kind == STATUS and answered:
                self.status, self.unanswered = read_status(payload) or self.status, 0
            elif kind == BOXIDS and answered:
                self.boxes = payload
        return voltages

    def refusal(self, armed: bool) -> str:
        """Return why the flight controller does not, or would not, follow commands; empty if no reason is known."""
        status = self.status
        if self._override:
            return self._override_refusal()
        if status is None or status.armed:
            return ""
        return status.words or ("it has not armed and gives no reason: is arm_channel= its switch?" if armed else "")

    def _override_refusal(self) -> str:
        """Return why the pilot or the modes prevent the override; empty if nothing does."""
        status, boxes = self.status, self.boxes
        if status is None or boxes is None:
            return "no status was received from it"
        if self.unanswered > UNANSWERED:
            return f"it has not answered the last {self.unanswered} requests of its status"
        if MSP_OVERRIDE not in boxes:
            return "it has no mode MSP OVERRIDE: see msp_override_channels_mask, and assign the mode to a switch"
        on = {box for bit, box in enumerate(boxes) if status.modes >> bit & 1}
        if not status.armed:
            return "the pilot has not armed it" + (f": {status.words}" if status.words else "")
        if MSP_OVERRIDE not in on:
            return "the pilot flies it: MSP OVERRIDE is off"
        return "it levels itself: switch ANGLE and HORIZON off" if on & {ANGLE, HORIZON} else ""

    def _sample(self, payload: bytes) -> np.ndarray | None:
        """Return body rates, rad/s, and specific force, m/s², FLU, of a RAW_IMU; None if too short or implausible."""
        if len(payload) < _IMU.size:
            return None
        counts, (rate, force) = _IMU.unpack_from(payload), self._scale
        return make_sample(tuple(rate * each for each in counts[3:]), tuple(force * each for each in counts[:3]))


def _voltage(payload: bytes) -> float | None:
    """Return the voltage of a BATTERY_STATE, V; None if it is too short, or there is no battery."""
    if len(payload) < _BATTERY_PAYLOAD or payload[0] == 0:
        return None
    return int.from_bytes(payload[9:11], "little") / 100


def size_of(data: bytes) -> int | None:
    """Return the size of the frame at the start of the data, as `FrameReader` requires."""
    if data[:3] not in (b"$", b"$M", b"$M>", b"$M!"):
        return None
    return data[3] + 6 if len(data) > 3 else 0


def is_whole(frame: bytes) -> bool:
    """Return whether the checksum of a frame is right."""
    return _checksum(frame) == frame[-1]


def _checksum(frame: bytes) -> int:
    return reduce(xor, frame[3:-1])
