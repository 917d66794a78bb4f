"""Channels to a firmware on this machine: none before it has booted, and what it says of itself."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from functools import reduce
from operator import xor

import pytest

from dreamer_racing.hil.betaflight.status import BOXIDS_REQUEST, REQUEST, SerialOverTcp
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.link import ASK_EVERY
from dreamer_racing.hil.links.msp import IMU_REQUEST, OVERRIDE_REQUEST, MspTelemetry, decode_msp
from dreamer_racing.hil.links.sitl import SitlTransport
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import Command, at_rest, hover

RATES = RateMap(roll=10.0, pitch=10.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)
BOOTGRACE, RXLOSS, THROTTLE = 1 << 9, 1 << 2, 1 << 7
ARM, ANGLE, OVERRIDE = 1, 1 << 1, 1 << 3
BOXES = bytes([0, 1, 6, 50])
"""Modes in the order of the status' bits: ARM, ANGLE, HEADFREE, MSP OVERRIDE."""


def frame(code: int, payload: bytes) -> bytes:
    body = bytes([len(payload), code]) + payload
    return b"$M>" + body + bytes([reduce(xor, body)])


def status(modes: int = 0, flags: int = 0) -> bytes:
    """An MSP_STATUS as a 4.6 lays it out, with 29 flags."""
    head = bytes(6) + modes.to_bytes(4, "little") + bytes(5)
    return frame(101, head + b"\0" + b"\x1d" + flags.to_bytes(4, "little") + bytes(3))


class Sent:
    """A transport that keeps what was sent."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def write(self, data: bytes) -> bool:
        self.sent.append(data)
        return True

    def close(self) -> None:
        self.sent.clear()


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(5.0)
        yield listening


def read_all(transport: SitlTransport, wanted: bytes) -> None:
    """Read until so many bytes have come."""
    heard, deadline = b"", time.monotonic() + 5.0
    while len(heard) < len(wanted) and time.monotonic() < deadline:
        heard += b"".join(data for _, data in transport.read())
    assert heard == wanted


def test_no_channels_are_sent_before_the_firmware_says_that_it_has_booted(server: socket.socket) -> None:
    channels = Sent()
    transport = SitlTransport(channels, SerialOverTcp(server.getsockname()[1]))
    assert not transport.write(b"1")
    firmware = server.accept()[0]
    firmware.settimeout(5.0)
    assert firmware.recv(100) == REQUEST
    for answer in (status(flags=BOOTGRACE | RXLOSS), status(flags=RXLOSS)):
        assert not transport.write(b"2") and channels.sent == []
        firmware.sendall(answer)
        read_all(transport, answer)
    assert transport.write(b"3") and channels.sent == [b"3"]
    for _ in range(2 * ASK_EVERY):
        assert transport.write(b"4")
    assert firmware.recv(100) == 2 * REQUEST
    firmware.sendall(status(flags=BOOTGRACE))  # it has been started anew: channels are not held back again
    read_all(transport, status(flags=BOOTGRACE))
    assert transport.write(b"5")
    firmware.close()
    transport.close()


def test_the_imu_is_asked_for_with_each_command(server: socket.socket) -> None:
    transport = SitlTransport(Sent(), SerialOverTcp(server.getsockname()[1]), imu=True)
    transport.write(b"channels")
    firmware = server.accept()[0]
    firmware.settimeout(5.0)
    transport.write(b"channels")
    wanted, asked = REQUEST + 2 * IMU_REQUEST, b""
    while len(asked) < len(wanted):
        asked += firmware.recv(100)
    assert asked == wanted
    firmware.close()
    for _ in range(3):  # who has gone is asked in vain
        transport.write(b"channels")
    assert list(transport.read()) == []
    transport.close()


def test_one_whose_serial_port_somebody_else_has_is_sent_channels_after_a_while(
    server: socket.socket, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    channels, now = Sent(), [1000.0]
    monkeypatch.setattr("dreamer_racing.hil.links.sitl.time.monotonic", lambda: now[0])
    transport = SitlTransport(channels, SerialOverTcp(server.getsockname()[1]))
    transport.write(b"1")
    now[0] += 9.9
    assert not transport.write(b"2")
    now[0] += 0.2
    assert transport.write(b"3") and channels.sent == [b"3"]
    assert "does not say whether it has booted" in caplog.text
    transport.close()


def test_where_no_firmware_is_nothing_is_sent_until_one_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    channels, now = Sent(), [1000.0]
    monkeypatch.setattr("dreamer_racing.hil.links.sitl.time.monotonic", lambda: now[0])
    transport = SitlTransport(channels, SerialOverTcp(port))
    for _ in range(40):
        assert not transport.write(b"channels")
        assert list(transport.read()) == []
        now[0] += 1.0
    assert channels.sent == []
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(5.0)
        while not transport._serial.write(REQUEST):
            now[0] += 1.0
        server.accept()[0].close()
    transport.close()


def test_what_keeps_it_from_arming_is_said_in_its_words() -> None:
    telemetry = MspTelemetry()
    assert telemetry.refusal(True) == "", "before it has said anything"
    telemetry.read(status(flags=THROTTLE | RXLOSS))
    assert telemetry.refusal(False) == ("RXLOSS: it hears no valid channels; THROTTLE: the throttle is not low")
    telemetry.read(status())
    assert telemetry.refusal(False) == "" and "gives no reason" in telemetry.refusal(True)
    telemetry.read(status(modes=ARM, flags=THROTTLE))
    assert telemetry.refusal(True) == ""
    telemetry.read(frame(101, b"short") + b"$M!" + status(modes=0)[3:])
    assert telemetry.refusal(True) == "", "what says nothing changes nothing"


@pytest.mark.parametrize(
    ("modes", "flags", "words"),
    [
        (0, RXLOSS, "the pilot has not armed it: RXLOSS: it hears no valid channels"),
        (OVERRIDE, 0, "the pilot has not armed it"),
        (ARM, 0, "the pilot flies it: MSP OVERRIDE is off"),
        (ARM | OVERRIDE | ANGLE, 0, "it levels itself: switch ANGLE and HORIZON off"),
        (ARM | OVERRIDE, 0, ""),
    ],
)
def test_beside_a_receiver_the_pilot_arms_and_hands_over(modes: int, flags: int, words: str) -> None:
    telemetry = MspTelemetry(override=True)
    assert telemetry.refusal(False) == "nothing was heard of it"
    telemetry.read(status(modes, flags))
    assert telemetry.refusal(False) == "nothing was heard of it"
    telemetry.read(frame(119, BOXES))
    assert telemetry.refusal(False) == telemetry.refusal(True) == words
    telemetry.read(frame(119, BOXES[:-1]))
    assert "it has no mode MSP OVERRIDE" in telemetry.refusal(True)


def test_beside_a_receiver_nothing_that_is_sent_could_arm(server: socket.socket) -> None:
    link = make_link(LinkConfig("msp_override", port=server.getsockname()[1], rates=RATES, thrust=THRUST, imu=True))
    first = link.send(Command(True, hover()))
    assert decode_msp(first[:14]) == (1500.0, 1500.0, pytest.approx(1608.0, abs=20.0), 1500.0)
    assert first[14:] == OVERRIDE_REQUEST + IMU_REQUEST and OVERRIDE_REQUEST.endswith(BOXIDS_REQUEST)
    firmware = server.accept()[0]
    second = link.send(at_rest())
    assert decode_msp(second[:14]) == (1500.0, 1500.0, 1000.0, 1500.0) and second[14:] == IMU_REQUEST
    assert link.refusal == "nothing was heard of it"
    firmware.sendall(frame(119, BOXES) + status(ARM | OVERRIDE))
    deadline = time.monotonic() + 5.0
    while link.refusal and time.monotonic() < deadline:
        link.listen()
    assert link.refusal == ""
    firmware.close()
    link.close()
