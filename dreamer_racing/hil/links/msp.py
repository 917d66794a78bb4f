"""MSP version 1 (MultiWii serial protocol): SET_RAW_RC, BATTERY_STATE and STATUS, over USB or a serial port.

38 bytes, little endian: ``b"$M<"``, size 32 of the payload, code 200, 16 u16 µs, and all after ``<`` combined by XOR.
In Betaflight: ``feature RX_MSP``, and at least five messages a second.

The status (101, `hil.betaflight.status`) is asked for with the battery. That one is asked for (code 130, no payload).
The answer begins with ``b"$M>"``; its payload of 11 bytes is: cells u8 (0: no battery), capacity u16 (mAh), voltage u8
(0.1 V), drawn u16 (mAh), current i16 (0.01 A), alert u8, and voltage u16 (0.01 V), which is the one that is read.
Releases before 4.0 lack it.

Reference: Betaflight, src/main/msp/msp_serial.c, msp_protocol.h and msp.c (MSP_BATTERY_STATE).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import reduce
from operator import xor

from dreamer_racing.hil.betaflight.status import STATUS, read_status
from dreamer_racing.hil.links.telemetry import FrameTelemetry

SET_RAW_RC, BATTERY_STATE = 200, 130
BATTERY_REQUEST = b"$M<" + bytes([0, BATTERY_STATE, BATTERY_STATE])
"""Asks for the battery's state: 6 bytes."""
_BATTERY_PAYLOAD = 11
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
    """Reads answers to `BATTERY_REQUEST`, and to `hil.betaflight.status.REQUEST`."""

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

    def note(self, frame: bytes) -> None:
        """Keep what a STATUS says."""
        if frame[4] == STATUS and frame[2] == ord(">"):
            self.status = read_status(frame[5:-1]) or self.status

    def voltage(self, frame: bytes) -> float | None:
        """Return the voltage, V, in steps of 0.01 V."""
        payload = frame[5:-1]
        if frame[2] != ord(">") or len(payload) < _BATTERY_PAYLOAD or payload[0] == 0:
            return None
        return int.from_bytes(payload[9:11], "little") / 100


def _checksum(frame: bytes) -> int:
    return reduce(xor, frame[3:-1])
