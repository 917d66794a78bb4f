"""Links over UDP, the codecs of channels, and what every link does alike."""

from __future__ import annotations

import math
import socket
import struct
import subprocess
import sys
import time
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.links import LINKS, LinkConfig, make_link, packed
from dreamer_racing.hil.links.crsf import crc8, decode_crsf, encode_crsf
from dreamer_racing.hil.links.msp import decode_msp, encode_msp
from dreamer_racing.hil.links.sbus import SbusFrame, decode_sbus, encode_sbus
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.links.udp import CommandPacket, UdpLink, UdpTransport, decode_command, encode_command
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest

finite = st.floats(allow_nan=False, allow_infinity=False)


def packet(thrust: float = 9.81, rates: tuple[float, ...] = (1.0, 2.0, 3.0), stamp: float = 2.5) -> CommandPacket:
    return CommandPacket(7, stamp, Command(True, Setpoint(thrust, np.array(rates))))


@pytest.fixture
def listener():
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listening.bind(("127.0.0.1", 0))
    listening.settimeout(5.0)
    yield listening
    listening.close()


def test_packet_by_hand():
    body = b"DRC1" + b"\x07\x00\x00\x00" + struct.pack("<d", 2.5) + b"\x01" + struct.pack("<dddd", 9.81, 1.0, 2.0, 3.0)
    assert encode_command(packet()) == body + struct.pack("<I", zlib.crc32(body))
    assert len(encode_command(packet())) == 53


@given(st.integers(0, 2**32 - 1), finite, st.booleans(), st.floats(0, 1e9), st.tuples(finite, finite, finite))
def test_round_trip(sequence, stamp, armed, thrust, rates):
    decoded = decode_command(
        encode_command(CommandPacket(sequence, stamp, Command(armed, Setpoint(thrust, np.array(rates)))))
    )
    assert (decoded.sequence, decoded.stamp, decoded.command.armed) == (sequence, stamp, armed)
    assert decoded.command.setpoint.collective_thrust == thrust
    assert tuple(decoded.command.setpoint.body_rates) == rates


@pytest.mark.parametrize(
    "impossible",
    [packet(thrust=math.nan), packet(thrust=-0.1), packet(rates=(0.0, math.inf, 0.0)), packet(stamp=math.nan)],
)
def test_impossible_numbers(impossible):
    """Their checksum is right, and they are refused all the same."""
    assert decode_command(encode_command(impossible)) is None


def test_armed_is_yes_or_no():
    body = bytearray(encode_command(packet())[:-4])
    body[16] = 2
    assert decode_command(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


def test_what_is_sent_arrives(listener):
    link = UdpLink(*listener.getsockname())
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


# Links by name: each is made and heard, and what is missing is named.


RATES = RateMap(roll=10.0, pitch=10.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)


def hears_command(data):
    return decode_command(data).command.armed is False


def hears_mavlink(data):
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    return len(common.MAVLink(None).parse_buffer(data)) == 1


@pytest.mark.parametrize(
    ("name", "hears"), [("udp", hears_command), ("simulated", hears_command), ("mavlink", hears_mavlink)]
)
def test_links_over_udp(listener, name, hears):
    link = make_link(LinkConfig(name, port=listener.getsockname()[1], rates=RATES, thrust=THRUST))
    sent = link.send(at_rest())
    assert listener.recv(200) == sent and hears(sent)
    link.close()


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
        *[(LinkConfig(name, rates=RATES, thrust=THRUST), "device") for name in ("crsf", "sbus", "msp", "msp_override")],
        *[
            (LinkConfig(name, device="/dev/ttyUSB0", thrust=THRUST), "rates")
            for name in ("crsf", "sbus", "msp", "msp_override")
        ],
    ],
)
def test_what_is_missing_is_named(config, field):
    with pytest.raises(ValueError, match=f"{field} is not given: the link {config.name} needs it"):
        make_link(config)


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_ports_that_are_none(port):
    with pytest.raises(ValueError, match=f"port={port}: must be at least 1 and at most 65535"):
        make_link(LinkConfig("udp", port=port))


def test_a_stick_arms_nothing():
    with pytest.raises(ValueError, match="arm_channel=2"):
        LinkConfig("crsf", arm_channel=2)


def test_without_pymavlink(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(ImportError, match=r"pip install .*\[hil\]'"):
        make_link(LinkConfig("mavlink", port=14540, thrust=THRUST))


def test_what_flies_needs_neither_torch_nor_the_packages_of_other_links():
    program = (
        "import sys, dreamer_racing.hil.links as links; links.make_link(links.LinkConfig('udp', port=9100)).close(); "
        "print([name for name in ('torch', 'serial', 'pymavlink') if name in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"
