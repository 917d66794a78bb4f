"""Links over UDP, the codecs of channels, and what every link does alike."""

from __future__ import annotations

import socket
import struct
import sys
import time
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.links import LINKS, LinkConfig, make_link
from dreamer_racing.hil.links.crsf import crc8, encode_crsf
from dreamer_racing.hil.links.msp import encode_msp
from dreamer_racing.hil.links.sbus import encode_sbus, pack_channels
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.links.udp import CommandPacket, UdpLink, UdpTransport, decode_command, encode_command
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest
from tests.hil.links.frames import CHANNEL_LINKS, RATES, THRUST, read_channels


def packet(thrust: float = 9.81) -> CommandPacket:
    return CommandPacket(7, 2.5, Command(True, Setpoint(thrust, np.array((1.0, 2.0, 3.0)))))


def test_packet_by_hand():
    body = b"DRC1" + b"\x07\x00\x00\x00" + struct.pack("<d", 2.5) + b"\x01" + struct.pack("<dddd", 9.81, 1.0, 2.0, 3.0)
    assert encode_command(packet()) == body + struct.pack("<I", zlib.crc32(body))
    assert len(encode_command(packet())) == 53


def test_impossible_numbers():
    """Their checksum is right, and they are refused all the same; those that are not finite are in `test_fuzz`."""
    assert decode_command(encode_command(packet(thrust=-0.1))) is None
    body = bytearray(encode_command(packet())[:-4])
    body[16] = 2  # armed is yes or no
    assert decode_command(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


def test_what_is_sent_arrives(listener):
    link = make_link(LinkConfig("udp", port=listener.getsockname()[1]))
    before = time.monotonic()
    sent = [link.send(Command(True, Setpoint(9.81, np.array([1.0, 2.0, 3.0])))), link.send(at_rest())]
    received = [listener.recv(100), listener.recv(100)]
    link.close()
    link.close()
    assert received == sent
    first, second = (decode_command(data) for data in received)
    assert (first.sequence, second.sequence, link.dropped) == (0, 1, 0)
    assert before <= first.stamp <= second.stamp <= time.monotonic()
    assert first.command.armed and not second.command.armed
    assert first.command.setpoint.body_rates.tolist() == [1.0, 2.0, 3.0]


def test_nobody_listens(listener):
    """Loopback says so at once; it is counted, and when somebody does listen the link works."""
    address = listener.getsockname()
    listener.close()
    link = UdpLink(*address)
    sent = [link.send(at_rest()) for _ in range(10)]
    assert sent[1:] == [b""] * 9 and link.dropped == sent.count(b"")  # what the first one met is known with the second
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(address)
        late.settimeout(5.0)
        assert link.send(at_rest()) == b""  # the one before found nobody; this one is sent all the same
        assert decode_command(late.recv(100)).sequence == 10
        assert link.send(at_rest()) == late.recv(100)
    link.close()


def test_a_closed_link_says_so(listener):
    link = UdpLink(*listener.getsockname())
    link.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        link.send(at_rest())


@pytest.mark.parametrize(("host", "port"), [("no.such.host.invalid", 9100), ("127.0.0.1", 70000)])
def test_nowhere_to_send_to(host, port):
    with pytest.raises(OSError, match=f"host={host}, port={port}: cannot send there"):
        UdpTransport(host, port)


# CRSF, SBUS, MSP and SITL frames: golden vectors by hand, and round trips.


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
    data = pack_channels((microseconds, *CENTRED[1:]))
    assert data[0] | (data[1] & 0b111) << 8 == tick


def test_sixteen_channels_and_no_others():
    with pytest.raises(ValueError, match="15 channels: a frame has 16"):
        pack_channels([1500.0] * 15)


def test_sbus_by_hand():
    """Channel 1 at 1000 µs is 192 = 000 11000000: byte 1 is C0, and 000 are the low bits of byte 2.

    Channel 2 at 2000 µs is 1792 = 111000 00000: 00000 are the high bits of byte 2, and 111000 the low ones of byte 3,
    above which stand the lowest two of channel 3: of 992, 00. From byte 4 on all is as if everything were centred.
    """
    frame = encode_sbus((1000.0, 2000.0, *CENTRED[2:]))
    assert frame == b"\x0f" + b"\xc0\x00\x38" + ALL_992[3:] + b"\x00\x00"


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
@pytest.mark.parametrize("name", CHANNEL_LINKS)
def test_a_channel_loses_half_a_step_at_most(name, values):
    """Of 5/8 µs in ticks, and 1 µs in whole microseconds."""
    encode, _ = CHANNEL_LINKS[name]
    assert read_channels(name, encode(values)) == pytest.approx(values, abs=0.5001 if name[0] in "mb" else 0.3126)


# Links by name: each is made and heard, and what is missing is named.


def test_ports_of_the_firmware(monkeypatch):
    opened = []
    monkeypatch.setattr("dreamer_racing.hil.links.UdpTransport", lambda *address: opened.append(address))
    monkeypatch.setattr("dreamer_racing.hil.links.SerialOverTcp", lambda *address: opened.append(address))
    make_link(LinkConfig("betaflight_sitl", rates=RATES, thrust=THRUST))
    assert opened == [(5761, "127.0.0.1"), ("127.0.0.1", 9004)]


def test_the_arm_channel_is_the_one_chosen():
    link = make_link(LinkConfig("betaflight_sitl", rates=RATES, thrust=THRUST, arm_channel=7))
    sent = link.encode(at_rest()._replace(armed=True))
    assert [int.from_bytes(sent[8 + 2 * n : 10 + 2 * n], "little") for n in (4, 7)] == [1000, 2000]
    link.close()


def test_unknown_links():
    with pytest.raises(ValueError, match=f"name=carrier_pigeon: must be one of {', '.join(LINKS)}"):
        make_link(LinkConfig("carrier_pigeon"))


@pytest.mark.parametrize(
    ("config", "field"),
    [
        (LinkConfig("udp"), "port"),
        (LinkConfig("mavlink", thrust=THRUST), "port"),
        (LinkConfig("mavlink", port=14540), "thrust"),
        (LinkConfig("betaflight_sitl", thrust=THRUST), "rates"),
        (LinkConfig("betaflight_sitl", rates=RATES), "thrust"),
        (LinkConfig("crsf", rates=RATES, thrust=THRUST), "device"),
        (LinkConfig("msp_override", rates=RATES, thrust=THRUST), "device"),
        (LinkConfig("sbus", device="/dev/ttyUSB0", thrust=THRUST), "rates"),
        (LinkConfig("msp", device="/dev/ttyUSB0", thrust=THRUST), "rates"),
    ],
)
def test_what_is_missing_is_named(config, field):
    with pytest.raises(ValueError, match=f"{field} is not given: the link {config.name} needs it"):
        make_link(config)


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        *(("port", port, "at least 1 and at most 65535") for port in (0, 65536)),
        ("baud", 0, "at least 1"),
        *(("arm_channel", channel, "4") for channel in (-1, 3, 16)),  # the others are sticks, or none
    ],
)
def test_settings_out_of_range_are_refused(field, value, allowed):
    with pytest.raises(ValueError, match=f"{field}={value}: must be {allowed}"):
        LinkConfig("crsf", **{field: value})


def test_without_pymavlink(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.common", None)
    with pytest.raises(ImportError, match=r"pip install .*\[hil\]'"):
        make_link(LinkConfig("mavlink", port=14540, thrust=THRUST))
