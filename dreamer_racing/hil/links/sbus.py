"""SBUS (Futaba): 25 bytes, which are 0F, 22 bytes of `packed` channels, one of flags, and 00.

The signal is inverted: either the adapter inverts it, or the flight controller is told not to (``serialrx_inverted``).
A frame has no checksum; only the parity bit of each byte detects damage.

Reference: Betaflight, src/main/rx/sbus.c and sbus_channels.c.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dreamer_racing.hil.links import packed

HEADER, FOOTER = 0x0F, 0x00
FRAME_LOST, FAILSAFE = 1 << 2, 1 << 3
FRAME_SIZE = packed.SIZE + 3
"""Bytes of a frame: 25."""
_FLAGS = 0x0F  # of channels 17 and 18, and the two above


class SbusFrame(NamedTuple):
    """The content of a frame."""

    channels: tuple[float, ...]  # (16,) µs
    frame_lost: bool  # whether the receiver missed the last frame of its radio
    failsafe: bool  # whether it has received nothing for long; channels are substitutes then


def encode_sbus(channels: Sequence[float], frame_lost: bool = False, failsafe: bool = False) -> bytes:
    """Return the frame of 16 channels in µs."""
    flags = FRAME_LOST * frame_lost | FAILSAFE * failsafe
    return bytes([HEADER]) + packed.pack(channels) + bytes([flags, FOOTER])


def decode_sbus(frame: bytes) -> SbusFrame | None:
    """Return a frame's content; None if it is not an SBUS frame."""
    if len(frame) != FRAME_SIZE or frame[0] != HEADER or frame[-1] != FOOTER or frame[-2] & ~_FLAGS:
        return None
    return SbusFrame(packed.unpack(frame[1:-2]), bool(frame[-2] & FRAME_LOST), bool(frame[-2] & FAILSAFE))
