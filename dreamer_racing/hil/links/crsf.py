"""CRSF (Crossfire, ExpressLRS): the frame RC_CHANNELS_PACKED.

26 bytes: address of the flight controller C8, length 18 of what follows, kind 16, 22 bytes of `packed` channels, and a
CRC-8 over kind and channels.

Betaflight reads 1811 − 172 ticks as 2012 − 988 µs exactly, which is up to 1 µs more than meant, and 0.8 µs at centre.

Reference: github.com/crsf-wg/crsf, wiki, Message-Format and CRSF_FRAMETYPE_RC_CHANNELS_PACKED.
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamer_racing.hil.links import packed

HEADER = b"\xc8\x18\x16"
FRAME_SIZE = len(HEADER) + packed.SIZE + 1
"""Bytes of a frame: 26."""
_POLYNOMIAL = 0xD5  # DVB-S2


def encode_crsf(channels: Sequence[float]) -> bytes:
    """Return the frame of 16 channels in µs."""
    frame = HEADER + packed.pack(channels)
    return frame + bytes([crc8(frame[2:])])


def decode_crsf(frame: bytes) -> tuple[float, ...] | None:
    """Return the 16 channels, in µs, of a frame; None if it is none, or damaged."""
    if len(frame) != FRAME_SIZE or not frame.startswith(HEADER) or crc8(frame[2:-1]) != frame[-1]:
        return None
    return packed.unpack(frame[len(HEADER) : -1])


def crc8(data: bytes) -> int:
    """Return the CRC-8 of bytes: polynomial D5, highest bit first, from 0."""
    crc = 0
    for byte in data:
        crc = _CRC_OF_BYTE[crc ^ byte]
    return crc


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1 ^ _POLYNOMIAL) & 0xFF if byte & 0x80 else byte << 1
    return byte


_CRC_OF_BYTE = tuple(_crc_of_byte(byte) for byte in range(256))
