"""CRSF, SBUS, MSP and SITL frames: golden vectors by hand, and round trips."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.links import packed
from dreamer_racing.hil.links.crsf import crc8, decode_crsf, encode_crsf
from dreamer_racing.hil.links.msp import decode_msp, encode_msp
from dreamer_racing.hil.links.sbus import SbusFrame, decode_sbus, encode_sbus
from dreamer_racing.hil.links.sitl import encode_sitl

CENTRED = (1500.0,) * 16
# 992 is 01111100000; eleven bits each from the lowest bit up make these eleven bytes of every eight channels.
ALL_992 = bytes.fromhex("e0031ff8c0073ef0810f7c") * 2
MICROSECONDS = st.lists(st.floats(1000, 2000), min_size=16, max_size=16)


def test_crsf_all_centred():
    """The example of the CRSF working group's wiki."""
    assert encode_crsf(CENTRED) == bytes.fromhex("c81816") + ALL_992 + b"\xad"


def test_crc_of_its_polynomial():
    """One bit shifted out leaves the polynomial; the check value of CRC-8/DVB-S2 is BC."""
    assert crc8(b"\x01") == 0xD5
    assert crc8(b"123456789") == 0xBC


@pytest.mark.parametrize(
    ("microseconds", "tick"), [(1000, 192), (1500, 992), (1500.6, 993), (2000, 1792), (0, 0), (9999, 2047)]
)
def test_ticks(microseconds, tick):
    """The least significant bits of channel 1 come first."""
    data = packed.pack((microseconds, *CENTRED[1:]))
    assert data[0] | (data[1] & 0b111) << 8 == tick


@pytest.mark.parametrize(("tick", "microseconds"), [(172, 988), (992, 1500), (1811, 2012)])
def test_ends_of_crsf(tick, microseconds):
    """Its ends are given in whole microseconds."""
    assert packed.unpack(tick.to_bytes(22, "little"))[0] == pytest.approx(microseconds, abs=0.5)


@pytest.mark.parametrize("count", [0, 15, 17])
def test_sixteen_channels_and_no_others(count):
    with pytest.raises(ValueError, match=f"{count} channels: a frame has 16"):
        packed.pack([1500.0] * count)


def test_sbus_by_hand():
    """Channel 1 at 1000 µs is 192 = 000 11000000: byte 1 is C0, and 000 are the low bits of byte 2.

    Channel 2 at 2000 µs is 1792 = 111000 00000: 00000 are the high bits of byte 2, and 111000 the low ones of byte 3,
    above which stand the lowest two of channel 3: of 992, 00. From byte 4 on all is as if everything were centred.
    """
    frame = encode_sbus((1000.0, 2000.0, *CENTRED[2:]))
    assert frame == b"\x0f" + b"\xc0\x00\x38" + ALL_992[3:] + b"\x00\x00"


@pytest.mark.parametrize(("lost", "failsafe", "flags"), [(True, False, 0x04), (False, True, 0x08), (True, True, 0x0C)])
def test_sbus_flags(lost, failsafe, flags):
    frame = encode_sbus(CENTRED, lost, failsafe)
    assert frame[23] == flags
    assert decode_sbus(frame) == SbusFrame(CENTRED, lost, failsafe)


def test_msp_by_hand():
    """1500 = 05DC, 2000 = 07D0, 1000 = 03E8, low byte first.

    Checksum: 20 ^ C8 = E8; three times DC 05 leaves DC ^ 05 = D9; twice D0 07 leaves nothing; eleven times E8 03 leaves
    EB; E8 ^ D9 ^ EB = DA.
    """
    values = (1500, 1500, 2000, 1500, 2000, *[1000] * 11)
    payload = "dc05 dc05 d007 dc05 d007" + "e803" * 11
    assert encode_msp(values) == b"$M<" + bytes.fromhex("20 c8" + payload + "da")


def test_sitl_packet():
    """40 bytes, and the stamp never moves."""
    first, second = encode_sitl((1000.4, 1999.6, *CENTRED[2:])), encode_sitl(CENTRED)
    assert len(first) == 40 and first[:8] == second[:8]
    assert struct.unpack_from("<16H", first, 8) == (1000, 2000, *[1500] * 14)


@given(MICROSECONDS)
def test_round_trips(values):
    """1 µs in whole microseconds, 5/8 µs in ticks; half of that is lost by rounding."""
    assert decode_crsf(encode_crsf(values)) == pytest.approx(values, abs=0.3126)
    assert decode_sbus(encode_sbus(values)).channels == pytest.approx(values, abs=0.3126)
    assert decode_msp(encode_msp(values)) == pytest.approx(values, abs=0.5001)
    assert struct.unpack_from("<16H", encode_sitl(values), 8) == pytest.approx(values, abs=0.5001)
