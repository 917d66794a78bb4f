"""MSP version 1 (MultiWii serial protocol): the message SET_RAW_RC, over the flight controller's USB or a serial port.

38 bytes, little endian: ``b"$M<"``, size 32 of the payload, code 200, 16 u16 µs, and all after ``<`` combined by XOR.
In Betaflight: ``feature RX_MSP``, and at least five messages a second. Its answers are not read.

Reference: Betaflight, src/main/msp/msp_serial.c and msp_protocol.h.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import reduce
from operator import xor

SET_RAW_RC = 200
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


def _checksum(frame: bytes) -> int:
    return reduce(xor, frame[3:-1])
