"""MSP version 1 (MultiWii serial protocol): SET_RAW_RC, BATTERY_STATE and RAW_IMU, over USB or a serial port.

38 bytes, little endian: ``b"$M<"``, size 32 of the payload, code 200, 16 u16 µs, and all after ``<`` combined by XOR.
In Betaflight: ``feature RX_MSP``, and at least five messages a second.

The battery is asked for (code 130, no payload). The answer begins with ``b"$M>"``; its payload of 11 bytes is: cells u8
(0: no battery), capacity u16 (mAh), voltage u8 (0.1 V), drawn u16 (mAh), current i16 (0.01 A), alert u8, and voltage
u16 (0.01 V), which is the one that is read. Releases before 4.0 lack it.

The IMU is asked for likewise (code 102). The payload of the answer, 18 bytes, is nine i16: acceleration, body rates and
magnetic field, each x, y, z; the first two are in FLU, with signs as a 4.6 that was built for a computer sends them.
Body rates are raw counts of ±2000 deg/s, 16.4 to a deg/s, and 512 of acceleration are 1 g (256 in such a build).

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
from dreamer_racing.hil.imu import make_sample
from dreamer_racing.hil.links.telemetry import FrameTelemetry

SET_RAW_RC, BATTERY_STATE, RAW_IMU = 200, 130, 102
BATTERY_REQUEST = b"$M<" + bytes([0, BATTERY_STATE, BATTERY_STATE])
"""Asks for the battery's state: 6 bytes."""
_BATTERY_PAYLOAD = 11
IMU_REQUEST = b"$M<" + bytes([0, RAW_IMU, RAW_IMU])
"""Asks for what the IMU tells: 6 bytes."""
GYRO_COUNTS = 16.4
"""To a deg/s."""
G_COUNTS, G_COUNTS_SITL = 512.0, 256.0
"""To 9.81 m/s²: of sensors, and of a firmware that was built for a computer."""
_IMU = struct.Struct("<6h")
_FRAME = struct.Struct("<3sBB16HB")
_PAYLOAD_SIZE = 32
_HEADER = b"$M<" + bytes([_PAYLOAD_SIZE, SET_RAW_RC])
FRAME_SIZE = _FRAME.size
"""Bytes of a message: 38."""


def encode_msp(channels: Sequence[float]) -> bytes:
    """Return the message of 16 channels in µs, rounded to 1 µs."""
    frame = _FRAME.pack(b"$M<", _PAYLOAD_SIZE, SET_RAW_RC, *(round(value) for value in channels), 0)
    return frame[:-1] + bytes([_checksum(frame)])


def decode_msp(frame: bytes) -> tuple[float, ...] | None:
    """Return the 16 channels, in µs, of a message; None if it is none, or damaged."""
    if len(frame) != FRAME_SIZE or not frame.startswith(_HEADER) or _checksum(frame) != frame[-1]:
        return None
    return tuple(float(value) for value in _FRAME.unpack(frame)[3:-1])


class MspTelemetry(FrameTelemetry):
    """Reads answers to `BATTERY_REQUEST` and `IMU_REQUEST`.

    Args:
        g_counts: Of acceleration, to 9.81 m/s².
    """

    def __init__(self, g_counts: float = G_COUNTS) -> None:
        super().__init__()
        self._scale = math.radians(1.0 / GYRO_COUNTS), GRAVITY / g_counts

    def frame_size(self, data: bytes) -> int | None:
        """Return the size of the frame that begins the data; see `FrameTelemetry`."""
        if data[:3] not in (b"$", b"$M", b"$M>", b"$M!"):
            return None
        return data[3] + 6 if len(data) > 3 else 0

    def is_whole(self, frame: bytes) -> bool:
        """Whether the checksum of a frame is right."""
        return _checksum(frame) == frame[-1]

    def is_battery(self, frame: bytes) -> bool:
        """Whether a frame is a BATTERY_STATE, or says that the flight controller has none."""
        return frame[4] == BATTERY_STATE

    def voltage(self, frame: bytes) -> float | None:
        """Return the voltage, V, in steps of 0.01 V."""
        payload = frame[5:-1]
        if frame[2] != ord(">") or len(payload) < _BATTERY_PAYLOAD or payload[0] == 0:
            return None
        return int.from_bytes(payload[9:11], "little") / 100

    def is_imu(self, frame: bytes) -> bool:
        """Whether a frame is a RAW_IMU, or says that the flight controller has none."""
        return frame[4] == RAW_IMU

    def sample(self, frame: bytes) -> np.ndarray | None:
        """Return body rates, rad/s, and specific force, m/s², FLU."""
        payload = frame[5:-1]
        if frame[2] != ord(">") or len(payload) < _IMU.size:
            return None
        counts, (rate, force) = _IMU.unpack_from(payload), self._scale
        return make_sample(tuple(rate * each for each in counts[3:]), tuple(force * each for each in counts[:3]))


def _checksum(frame: bytes) -> int:
    return reduce(xor, frame[3:-1])
