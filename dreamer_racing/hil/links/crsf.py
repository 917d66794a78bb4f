"""CRSF (Crossfire, ExpressLRS): the frame RC_CHANNELS_PACKED out, and BATTERY_SENSOR back.

26 bytes: address of the flight controller C8, length 18 of what follows, kind 16, 22 bytes of channels (`sbus`), and
a CRC-8 over kind and channels.

Betaflight reads 1811 − 172 ticks as 2012 − 988 µs exactly, which is up to 1 µs more than meant, and 0.8 µs at centre.

Telemetry, big endian: address, length 0A, kind 08, voltage u16 (0.1 V), current u16 (0.1 A), used capacity u24
(mAh), remaining u8 (%), and the CRC-8. With Betaflight's ``report_cell_voltage`` it is the voltage of one cell.

Reference: github.com/crsf-wg/crsf, wiki, Message-Format, CRSF_FRAMETYPE_RC_CHANNELS_PACKED and
CRSF_FRAMETYPE_BATTERY_SENSOR; Betaflight, src/main/telemetry/crsf.c (crsfFrameBatterySensor).
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamer_racing.hil.links.link import FrameReader, Telemetry
from dreamer_racing.hil.links.sbus import pack_channels

HEADER = b"\xc8\x18\x16"
ADDRESSES = (0xC8, 0xEA, 0xEC, 0xEE)
"""First bytes of frames: of flight controller, handset, receiver and transmitter module."""
BATTERY_SENSOR, _BATTERY_FRAME = 0x08, 12  # kind, and bytes of a frame
_SHORTEST, _LONGEST = 2, 62  # allowed values of the length byte
_POLYNOMIAL = 0xD5  # DVB-S2


def encode_crsf(channels: Sequence[float]) -> bytes:
    """Return the frame of 16 channels in µs."""
    frame = HEADER + pack_channels(channels)
    return frame + bytes([crc8(frame[2:])])


class CrsfTelemetry(Telemetry):
    """Reads BATTERY_SENSOR."""

    def __init__(self) -> None:
        super().__init__()
        self._frames = FrameReader(size_of, is_whole)

    def read(self, data: bytes) -> list[float]:
        """Parse bytes; return the voltages in them, V, in steps of 0.1 V."""
        voltages = []
        for frame in self._frames.read(data):
            if frame is not None and frame[2] != BATTERY_SENSOR:
                continue
            if frame is None or len(frame) < _BATTERY_FRAME:
                self.rejected += 1
            else:
                voltages.append(int.from_bytes(frame[3:5], "big") / 10)
        return voltages


def size_of(data: bytes) -> int | None:
    """Return the size of the frame at the start of the data, as `FrameReader` requires."""
    if data[0] not in ADDRESSES:
        return None
    if len(data) < 2:
        return 0
    return data[1] + 2 if _SHORTEST <= data[1] <= _LONGEST else None


def is_whole(frame: bytes) -> bool:
    """Return whether the CRC of a frame is right."""
    return crc8(frame[2:-1]) == frame[-1]


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
