"""Betaflight's firmware in a process of its own (SITL): channels to its UDP port 9004.

The packet, 40 bytes, little endian: a time stamp f64 and 16 u16 µs. The stamp is constant: where the firmware reads the
time from stamps, their jitter becomes its clock's.

Reference: Betaflight, src/platform/SIMULATOR/sitl.c (rc_packet).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

RC_PORT = 9004
_PACKET = struct.Struct("<d16H")
_STAMP = 0.0


def encode_sitl(channels: Sequence[float]) -> bytes:
    """Return the packet of 16 channels in µs, rounded to 1 µs."""
    return _PACKET.pack(_STAMP, *(round(value) for value in channels))
