"""The link to a simulated firmware, and the signs of what goes through it."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest

from dreamer_racing.hil.betaflight.status import BOXIDS_REQUEST, REQUEST
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.link import ASK_EVERY, ChannelLink, TransportLink
from dreamer_racing.hil.links.mavlink import MavlinkLink
from dreamer_racing.hil.links.msp import IMU_REQUEST, OVERRIDE_REQUEST, MspTelemetry
from dreamer_racing.hil.links.sitl import SerialOverTcp, SitlTransport
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest, hover
from tests.hil.links.frames import CHANNEL_LINKS, RATES, RESTING, THRUST, Recorder, msp_answer, read_words

BOOTGRACE, RXLOSS, THROTTLE = 1 << 9, 1 << 2, 1 << 7
ARM, ANGLE, OVERRIDE = 1, 1 << 1, 1 << 3
BOXES = bytes([0, 1, 6, 50])
"""Modes in the order of the status' bits: ARM, ANGLE, HEADFREE, MSP OVERRIDE."""


def status(modes: int = 0, flags: int = 0) -> bytes:
    """An MSP_STATUS as a 4.6 lays it out, with 29 flags."""
    head = bytes(6) + modes.to_bytes(4, "little") + bytes(5)
    return msp_answer(101, head + b"\0" + b"\x1d" + flags.to_bytes(4, "little") + bytes(3))


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
    channels = Recorder()
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
    transport = SitlTransport(Recorder(), SerialOverTcp(server.getsockname()[1]), imu=True)
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
    channels, now = Recorder(), [1000.0]
    monkeypatch.setattr("dreamer_racing.hil.links.sitl.time.monotonic", lambda: now[0])
    transport = SitlTransport(channels, SerialOverTcp(server.getsockname()[1]))
    transport.write(b"1")
    now[0] += 9.9
    assert not transport.write(b"2")
    now[0] += 0.2
    assert transport.write(b"3") and channels.sent == [b"3"]
    assert "does not report whether it has booted" in caplog.text
    transport.close()


def test_where_no_firmware_is_nothing_is_sent_until_one_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    channels, now = Recorder(), [1000.0]
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
    assert telemetry.refusal(False) == ("RXLOSS: it receives no valid channels; THROTTLE: the throttle is not low")
    telemetry.read(status())
    assert telemetry.refusal(False) == "" and "gives no reason" in telemetry.refusal(True)
    telemetry.read(status(modes=ARM, flags=THROTTLE))
    assert telemetry.refusal(True) == ""
    telemetry.read(msp_answer(101, b"short") + b"$M!" + status(modes=0)[3:])
    assert telemetry.refusal(True) == "", "what says nothing changes nothing"


@pytest.mark.parametrize(
    ("modes", "flags", "words"),
    [
        (0, RXLOSS, "the pilot has not armed it: RXLOSS: it receives no valid channels"),
        (OVERRIDE, 0, "the pilot has not armed it"),
        (ARM, 0, "the pilot flies it: MSP OVERRIDE is off"),
        (ARM | OVERRIDE | ANGLE, 0, "it levels itself: switch ANGLE and HORIZON off"),
        (ARM | OVERRIDE, 0, ""),
    ],
)
def test_beside_a_receiver_the_pilot_arms_and_hands_over(modes: int, flags: int, words: str) -> None:
    telemetry = MspTelemetry(override=True)
    assert telemetry.refusal(False) == "no status was received from it"
    telemetry.read(status(modes, flags))
    assert telemetry.refusal(False) == "no status was received from it"
    telemetry.read(msp_answer(119, BOXES))
    assert telemetry.refusal(False) == telemetry.refusal(True) == words
    telemetry.read(msp_answer(119, BOXES[:-1]))
    assert "it has no mode MSP OVERRIDE" in telemetry.refusal(True)


def test_beside_a_receiver_nothing_that_is_sent_could_arm(server: socket.socket) -> None:
    link = make_link(LinkConfig("msp_override", port=server.getsockname()[1], rates=RATES, thrust=THRUST, imu=True))
    first = link.send(Command(True, hover()))
    assert read_words(first[5:13]) == [1500, 1500, pytest.approx(1608.0, abs=20.0), 1500]
    assert first[14:] == OVERRIDE_REQUEST + IMU_REQUEST and OVERRIDE_REQUEST.endswith(BOXIDS_REQUEST)
    firmware = server.accept()[0]
    second = link.send(at_rest())
    assert read_words(second[5:13]) == [1500, 1500, 1000, 1500] and second[14:] == IMU_REQUEST
    assert link.refusal == "no status was received from it"
    firmware.sendall(msp_answer(119, BOXES) + status(ARM | OVERRIDE))
    deadline = time.monotonic() + 5.0
    while link.refusal and time.monotonic() < deadline:
        link.listen()
    assert link.refusal == ""
    for _ in range(6 * ASK_EVERY):  # it never answers again
        link.send(Command(True, hover()))
    assert link.refusal == "it has not answered the last 6 requests of its status"
    firmware.close()
    link.close()


# Every link by the bytes that it sends: which way each axis goes, and how far, read by hand or by pymavlink.


HOVER_THROTTLE = 1604.45  # µs, see tests/hil/test_flyer.py


@pytest.fixture(params=CHANNEL_LINKS)
def radio(request):
    """What is sent for a command, as 16 channels in µs."""
    encode, read = CHANNEL_LINKS[request.param]
    link = ChannelLink(Recorder(), encode, RATES, THRUST)
    return lambda command: read(link.send(command))


def turning(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Command:
    return Command(True, Setpoint(9.81, np.array([x, y, z])))


@pytest.mark.parametrize(
    ("command", "channel", "value"),
    [
        (turning(x=5.0), 0, 1750),  # rolls right: channel 1 above centre
        (turning(x=-5.0), 0, 1250),
        (turning(y=5.0), 1, 1750),  # nose down: channel 2, stick forward, above centre
        (turning(y=-5.0), 1, 1250),
        (turning(z=2.0), 3, 1250),  # yaws left: channel 4, stick left, below centre
        (turning(z=-2.0), 3, 1750),
    ],
)
def test_one_axis_of_a_radio(radio, command, channel, value):
    """And no other axis moves."""
    expected = [1500, 1500, HOVER_THROTTLE, 1500, 2000, *[1000] * 11]
    expected[channel] = value
    assert radio(command) == pytest.approx(expected, abs=1.0)


def test_throttle_of_a_radio_armed_and_disarmed(radio):
    assert radio(Command(True, Setpoint(16.0 / 0.6, np.zeros(3))))[2] == pytest.approx(2000, abs=1.0)
    assert radio(Command(True, Setpoint(0.0, np.zeros(3))))[2] == pytest.approx(1000, abs=1.0)
    assert radio(at_rest()) == radio(turning(1.0, 2.0, 3.0)._replace(armed=False)) == pytest.approx(RESTING)


def messages(data: bytes):
    """What pymavlink reads in bytes."""
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    return common.MAVLink(None).parse_buffer(data) or []


@pytest.fixture
def mavlink():
    pytest.importorskip("pymavlink")
    return MavlinkLink(Recorder(), THRUST)


@pytest.mark.parametrize(
    ("command", "rates"),
    [
        (turning(x=5.0), [5, 0, 0]),
        (turning(y=5.0), [0, -5, 0]),  # nose down is negative in FRD
        (turning(z=2.0), [0, 0, -2]),  # left is negative in FRD
    ],
)
def test_one_axis_of_mavlink(mavlink, command, rates):
    target = messages(mavlink.send(command))[-1]
    assert target.get_type() == "SET_ATTITUDE_TARGET"
    assert (target.target_system, target.target_component, target.type_mask) == (1, 1, 128)
    assert [target.body_roll_rate, target.body_pitch_rate, target.body_yaw_rate] == rates
    assert target.thrust == pytest.approx(math.sqrt(0.6 * 9.81 / 16.0))


@pytest.mark.parametrize(
    ("main_mode", "armed", "status", "taken"),
    [
        (3, True, 4, "position"), (1, True, 4, "manual"), (4, True, 4, "an automatic"),
        (11, True, 4, "altitude cruise"), (99, True, 4, "another"), (6, True, 4, ""), (3, True, 5, ""),
        (3, False, 3, ""),
    ],
)  # fmt: skip
def test_what_a_pilot_has_taken_over_is_not_disarmed(mavlink, main_mode, armed, status, taken):
    """But it is where PX4 has changed the mode itself, in a failsafe (status 5, critical)."""
    common = pytest.importorskip("pymavlink.dialects.v20.common")

    def hear(mode, is_armed, state):
        beat = common.MAVLink_heartbeat_message(2, 12, 128 * is_armed, mode << 16, state, 3)
        mavlink._telemetry.read(bytes(beat.pack(common.MAVLink(None, 1, 1))))

    hear(6, False, 3)
    assert mavlink.refusal == ""
    mavlink.send(turning())
    hear(main_mode, armed, status)
    assert mavlink.refusal == (f"the pilot has taken over, in {taken} mode" if taken else "")
    sent = [message.get_type() for message in messages(mavlink.send(at_rest()))]
    assert sent == ["COMMAND_LONG"] * (not taken) + ["SET_ATTITUDE_TARGET"]


def test_mavlink_is_armed_in_offboard_mode_only(mavlink):
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    assert mavlink.refusal == ""  # unknown
    beat = common.MAVLink_heartbeat_message(2, 12, 0, 3 << 16, 4, 3)
    mavlink._telemetry.read(bytes(beat.pack(common.MAVLink(None, 1, 1))))
    assert mavlink.refusal == "it is not in offboard mode"


def test_mavlink_arms_for_a_moment_and_disarms_for_good(mavlink):
    """A vehicle that disarmed itself is not armed again by the flight's further commands."""

    def switches(command):
        return [
            (message.command, message.param1, message.param2, message.confirmation)
            for message in messages(mavlink.send(command))
            if message.get_type() == "COMMAND_LONG"
        ]

    assert [switches(turning()) for _ in range(7)] == [[(400, 1.0, 0.0, n)] for n in range(5)] + [[], []]
    assert switches(at_rest()) == switches(at_rest()) == [(400, 0.0, 21196.0, 0)]
    assert switches(turning()) == [(400, 1.0, 0.0, 0)]


def test_mavlink_disarms_nothing_that_it_has_not_armed(mavlink):
    """Whoever flies the vehicle by radio while this program starts, or runs with arm=false, goes on flying."""
    sent = b"".join(mavlink.send(at_rest()) for _ in range(50))
    assert {message.get_type() for message in messages(sent)} == {"SET_ATTITUDE_TARGET"}
    with pytest.raises(ValueError, match="must be finite"):  # what is never sent arms nothing either
        mavlink.send(turning(x=math.nan))
    assert len(messages(mavlink.send(at_rest()))) == 1


def test_mavlink_knows_its_longest_command(mavlink):
    longest = mavlink.longest
    assert max(len(mavlink.send(command)) for command in (at_rest(), turning(1, 2, 3), at_rest())) <= longest < 100


def test_mavlink_counts_its_messages(mavlink):
    mavlink.send(turning())
    sent = b"".join(mavlink.send(at_rest()) for _ in range(150))
    assert [message.get_seq() for message in messages(sent)] == [(2 + n) % 256 for n in range(300)]
    assert all(message.thrust == 0.0 for message in messages(sent)[1::2])


class Bare(TransportLink):
    """Says only what comes to `encode`."""

    def encode(self, command):
        return struct.pack("<?4d", command.armed, command.setpoint.collective_thrust, *command.setpoint.body_rates)


def test_what_is_dropped_is_counted_and_closing_closes_the_transport():
    recorder = Recorder(takes=False)
    link = Bare(recorder)
    assert [link.send(at_rest()), link.send(turning())] == [b"", b""]
    assert link.dropped == 2
    link.close()
    assert recorder.closed


@pytest.mark.parametrize("setpoint", [Setpoint(math.nan, np.zeros(3)), Setpoint(9.81, np.array([0.0, math.inf, 0.0]))])
def test_numbers_that_are_none(setpoint):
    """Armed they are refused, disarmed they are nobody's business."""
    recorder = Recorder()
    with pytest.raises(ValueError, match="an armed command must be finite"):
        Bare(recorder).send(Command(True, setpoint))
    assert recorder.sent == []
    assert Bare(recorder).send(Command(False, setpoint)) == bytes(33)
