"""SBUS (Futaba): 25 bytes, which are 0F, 16 channels in 22 bytes, one of flags, and 00. CRSF packs channels alike.

Each channel has 11 bits, the least significant first. A tick is 5/8 µs, and 992 ticks are 1500 µs: 192 and 1792 are
1000 and 2000 µs, 172 and 1811 are 988 and 2012 µs.

The signal is inverted: either the adapter inverts it, or the flight controller is told not to (``serialrx_inverted``).
A frame has no checksum; only the parity bit of each byte detects damage.

Reference: Betaflight, src/main/rx/sbus.c and sbus_channels.c; TBS, "CRSF protocol" (TICKS_TO_US);
github.com/crsf-wg/crsf, wiki, CRSF_FRAMETYPE_RC_CHANNELS_PACKED.
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamer_racing.hil.sticks import CENTRE, CHANNELS

_BITS, _MIDDLE, _TICK = 11, 992, 0.625


def encode_sbus(channels: Sequence[float]) -> bytes:
    """Return the frame of 16 channels in µs."""
    return b"\x0f" + pack_channels(channels) + b"\x00\x00"  # no flag: neither a lost frame nor a failsafe


def pack_channels(channels: Sequence[float]) -> bytes:
    """Return the 22 bytes of 16 channels in µs, rounded to 5/8 µs; clipped to 880 to 2159 µs.

    Raises:
        ValueError: There are not 16 channels.
    """
    if len(channels) != CHANNELS:
        raise ValueError(f"{len(channels)} channels: a frame has {CHANNELS}.")
    bits = 0
    for value in reversed(channels):
        bits = bits << _BITS | min(max(round(_MIDDLE + (value - CENTRE) / _TICK), 0), 2**_BITS - 1)
    return bits.to_bytes(CHANNELS * _BITS // 8, "little")
