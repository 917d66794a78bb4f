"""Sixteen channels in 22 bytes, as CRSF and SBUS both have them: 11 bits each, the least significant first.

A tick is 5/8 µs, and 992 ticks are 1500 µs: 192 and 1792 are 1000 and 2000 µs, 172 and 1811 are 988 and 2012 µs.

Reference: TBS, "CRSF protocol" (TICKS_TO_US); github.com/crsf-wg/crsf, wiki, CRSF_FRAMETYPE_RC_CHANNELS_PACKED.
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamer_racing.hil.sticks import CENTRE, CHANNELS

BITS = 11
SIZE = CHANNELS * BITS // 8
"""Bytes of sixteen channels: 22."""
_MIDDLE, _TICK = 992, 0.625
_LARGEST = 2**BITS - 1


def pack(channels: Sequence[float]) -> bytes:
    """Return the 22 bytes of 16 channels in µs, rounded to 5/8 µs; clipped to 880 to 2159 µs.

    Raises:
        ValueError: There are not 16 channels.
    """
    if len(channels) != CHANNELS:
        raise ValueError(f"{len(channels)} channels: a frame has {CHANNELS}.")
    bits = 0
    for value in reversed(channels):
        bits = bits << BITS | min(max(round(_MIDDLE + (value - CENTRE) / _TICK), 0), _LARGEST)
    return bits.to_bytes(SIZE, "little")


def unpack(data: bytes) -> tuple[float, ...]:
    """Return the 16 channels, in µs, of 22 bytes."""
    bits = int.from_bytes(data, "little")
    return tuple(CENTRE + ((bits >> BITS * index & _LARGEST) - _MIDDLE) * _TICK for index in range(CHANNELS))
