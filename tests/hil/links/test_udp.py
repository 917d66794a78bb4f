"""Commands over UDP: the packet by hand, round trips, and a socket that never waits."""

from __future__ import annotations

import math
import socket
import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.links.udp import CommandPacket, UdpLink, UdpTransport, decode_command, encode_command
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
    with pytest.raises(OSError, match=f"host={host}, port={port}: cannot be sent to"):
        UdpTransport(host, port)
