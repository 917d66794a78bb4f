"""Every link by the bytes that it sends: which way each axis goes, and how far, read by hand or by pymavlink."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from dreamer_racing.hil.links.crsf import encode_crsf
from dreamer_racing.hil.links.link import ChannelLink, TransportLink
from dreamer_racing.hil.links.mavlink import MavlinkLink
from dreamer_racing.hil.links.msp import encode_msp
from dreamer_racing.hil.links.sbus import encode_sbus
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest

RATES = RateMap(roll=10.0, pitch=10.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)
HOVER_THROTTLE = 1604.45  # µs, see test_sticks


class Recorder:
    """A transport that takes everything, or nothing."""

    def __init__(self, takes: bool = True):
        self.takes, self.data, self.closed = takes, b"", False

    def write(self, data):
        self.data += data * self.takes
        return self.takes

    def discard(self):
        pass

    def close(self):
        self.closed = True


def read_bits(data: bytes) -> list[float]:
    """Channels of 11 bits each: one string of bits, in the order in which a wire has them."""
    bits = "".join(format(byte, "08b")[::-1] for byte in data)
    ticks = [int(bits[start : start + 11][::-1], 2) for start in range(0, 176, 11)]
    return [1500 + (tick - 992) * 1000 / 1600 for tick in ticks]


def read_words(data: bytes) -> list[float]:
    return [low + 256 * high for low, high in zip(data[::2], data[1::2], strict=True)]


CHANNEL_LINKS = {
    "crsf": (encode_crsf, lambda data: read_bits(data[3:25])),
    "sbus": (encode_sbus, lambda data: read_bits(data[1:23])),
    "msp": (encode_msp, lambda data: read_words(data[5:37])),
    "betaflight_sitl": (encode_sitl, lambda data: read_words(data[8:40])),
}


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


def test_throttle_of_a_radio(radio):
    assert radio(Command(True, Setpoint(16.0 / 0.6, np.zeros(3))))[2] == pytest.approx(2000, abs=1.0)
    assert radio(Command(True, Setpoint(0.0, np.zeros(3))))[2] == pytest.approx(1000, abs=1.0)


def test_disarmed_radio(radio):
    resting = pytest.approx([1500, 1500, 1000, 1500, *[1000] * 12], abs=1.0)
    assert radio(at_rest()) == radio(turning(1.0, 2.0, 3.0)._replace(armed=False)) == resting


def test_the_battery_may_be_read_in_flight():
    link = ChannelLink(Recorder(), encode_msp, RATES, THRUST)
    before = read_words(link.send(turning())[5:37])[2]
    link.thrust = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=13.5)
    assert read_words(link.send(turning())[5:37])[2] > before + 60


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


def test_what_is_dropped_is_counted():
    link = Bare(Recorder(takes=False))
    assert [link.send(at_rest()), link.send(turning())] == [b"", b""]
    assert link.dropped == 2


def test_closing_closes_the_transport():
    recorder = Recorder()
    Bare(recorder).close()
    assert recorder.closed


@pytest.mark.parametrize("setpoint", [Setpoint(math.nan, np.zeros(3)), Setpoint(9.81, np.array([0.0, math.inf, 0.0]))])
def test_numbers_that_are_none(setpoint):
    """Armed they are refused, disarmed they are nobody's business."""
    recorder = Recorder()
    with pytest.raises(ValueError, match="an armed command must be finite"):
        Bare(recorder).send(Command(True, setpoint))
    assert recorder.data == b""
    assert Bare(recorder).send(Command(False, setpoint)) == bytes(33)
