"""MAVLink: messages of pymavlink go over loopback, and arrive as poses in our frames, by hand."""

from __future__ import annotations

import math
import os
import socket
import sys
import time

import numpy as np
import pytest

mavlink = pytest.importorskip("pymavlink.dialects.v20.common")

from dreamer_racing.hil.attitude import rotation_matrix  # noqa: E402
from dreamer_racing.hil.inlet import UdpInlet  # noqa: E402
from dreamer_racing.hil.pose_sources import make_poses  # noqa: E402
from dreamer_racing.hil.pose_sources.mavlink import MESSAGES, MavlinkPose  # noqa: E402
from dreamer_racing.hil.stamping import PoseClock, Stamping  # noqa: E402

HALF = math.sqrt(0.5)
LEVEL, YAW_RIGHT, ROLL_RIGHT, NOSE_UP = (1, 0, 0, 0), (HALF, 0, 0, HALF), (HALF, HALF, 0, 0), (HALF, 0, HALF, 0)
"""Attitudes FRD → NED, wxyz: level to the north; turned by 90° about +z (down), +x (forward) and +y (right)."""
UNKNOWN = [math.nan] * 21
LOCAL_NED, LOCAL_ENU, BODY_FRD, LOCAL_FRD = 1, 4, 12, 20


class Listening:
    """A source at a free port, and what sends to it."""

    def __init__(self, message: str = "ODOMETRY", smoothing: float = 0.0) -> None:
        self.inlet = UdpInlet(0)
        self.source = MavlinkPose(self.inlet, message, smoothing)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def hear(self, *messages) -> list:
        """Packets that come of messages, or of bytes as they are, each in a datagram of its own."""
        for message in messages:
            self._socket.sendto(message if isinstance(message, bytes) else pack(message), self.inlet.address)
        return [received.packet for received in self.source.poll()]

    def close(self) -> None:
        for part in (self.source, self.source, self._socket):  # twice is once
            part.close()


@pytest.fixture
def listening():
    """Makes sources that are closed at the end."""
    made = []

    def listen(*arguments, **keywords) -> Listening:
        made.append(Listening(*arguments, **keywords))
        return made[-1]

    yield listen
    for one in made:
        one.close()


def pack(message, **keywords) -> bytes:
    return bytes(message.pack(mavlink.MAVLink(None, 1, 1), **keywords))


def odometry(
    microseconds=1_500_000,
    position=(0, 0, 0),
    attitude=LEVEL,
    velocity=(0, 0, 0),
    rates=(0, 0, 0),
    frames=(LOCAL_FRD, BODY_FRD),
    quality=100,
):
    numbers = *position, list(attitude), *velocity, *rates
    return mavlink.MAVLink_odometry_message(microseconds, *frames, *numbers, UNKNOWN, UNKNOWN, 0, 0, quality)


def local_position(milliseconds, position=(0, 0, 0), velocity=(0, 0, 0)):
    return mavlink.MAVLink_local_position_ned_message(milliseconds, *position, *velocity)


def attitude_quaternion(milliseconds, attitude=LEVEL, rates=(0, 0, 0)):
    return mavlink.MAVLink_attitude_quaternion_message(milliseconds, *attitude, *rates)


def vision(microseconds, position=(0, 0, 0), angles=(0, 0, 0)):
    return mavlink.MAVLink_vision_position_estimate_message(microseconds, *position, *angles)


def mocap(microseconds, position=(0, 0, 0), attitude=LEVEL):
    return mavlink.MAVLink_att_pos_mocap_message(microseconds, list(attitude), *position)


def close(value, expected):
    return np.allclose(value, expected, rtol=0, atol=1e-6)


def same_attitude(one, other):
    return abs(np.dot(one, other)) > 1 - 1e-9


class Given:
    """An inlet of what a test gives, a piece a second: after each there was a silence, and stamps may begin anew."""

    def __init__(self, pieces: list[bytes], whole: bool = True) -> None:
        self.pieces, self.whole = pieces, whole

    def read(self):
        yield from ((float(second), piece) for second, piece in enumerate(self.pieces))

    def close(self) -> None:
        pass


SIGNS = [
    pytest.param((1, 0, 0), (1, 0, 0), id="north, or roll right, is +x"),
    pytest.param((0, 1, 0), (0, -1, 0), id="east, or nose up, is -y"),
    pytest.param((0, 0, 1), (0, 0, -1), id="down, or yaw right, is -z"),
]
ATTITUDES = [
    pytest.param(LEVEL, (1, 0, 0, 0), id="level"),
    pytest.param(YAW_RIGHT, (HALF, 0, 0, -HALF), id="yaw right turns clockwise, seen from above"),
    pytest.param(ROLL_RIGHT, (HALF, HALF, 0, 0), id="roll right"),
    pytest.param(NOSE_UP, (HALF, 0, -HALF, 0), id="nose up"),
]


@pytest.mark.parametrize(("theirs", "ours"), SIGNS)
@pytest.mark.parametrize("frame", [LOCAL_NED, LOCAL_FRD])
def test_signs_of_odometry(listening, frame, theirs, ours):
    """All three at once; level and heading north, the body's axes are the world's."""
    sent = odometry(position=theirs, velocity=theirs, rates=theirs, frames=(frame, BODY_FRD))
    (packet,) = listening().hear(sent)
    assert packet.stamp == pytest.approx(1.5)
    assert packet.attitude.tolist() == [1, 0, 0, 0]
    assert all(close(vector, ours) for vector in (packet.position, packet.linear_velocity, packet.body_rates))


@pytest.mark.parametrize(("theirs", "ours"), ATTITUDES)
def test_attitudes(listening, theirs, ours):
    assert same_attitude(listening().hear(odometry(attitude=theirs))[0].attitude, ours)
    (packet,) = listening("ATT_POS_MOCAP").hear(mocap(0, attitude=theirs), mocap(9000, attitude=theirs))
    assert same_attitude(packet.attitude, ours)


@pytest.mark.parametrize(
    ("attitude", "velocity", "ours"),
    [
        pytest.param(YAW_RIGHT, (2, 0, 0), (0, -2, 0), id="forward when heading east is east"),
        pytest.param(YAW_RIGHT, (0, 2, 0), (-2, 0, 0), id="to the right when heading east is south"),
        pytest.param(NOSE_UP, (2, 0, 0), (0, 0, 2), id="forward when the nose is up is up"),
        pytest.param(ROLL_RIGHT, (0, 2, 0), (0, 0, -2), id="to the right when rolled right is down"),
    ],
)
def test_velocities_of_the_body_are_turned_into_the_world(listening, attitude, velocity, ours):
    (packet,) = listening().hear(odometry(attitude=attitude, velocity=velocity, frames=(LOCAL_NED, BODY_FRD)))
    assert close(packet.linear_velocity, ours)


def test_velocities_in_the_frame_of_the_position_are_not(listening):
    """PX4 says so: both in NED."""
    (packet,) = listening().hear(odometry(attitude=YAW_RIGHT, velocity=(1, 2, 3), frames=(LOCAL_NED, LOCAL_NED)))
    assert close(packet.linear_velocity, (1, -2, -3))


@pytest.mark.parametrize(
    "sent",
    [
        pytest.param(odometry(frames=(LOCAL_ENU, BODY_FRD)), id="frame"),
        pytest.param(odometry(frames=(LOCAL_FRD, LOCAL_NED)), id="frame of velocity"),
        pytest.param(odometry(quality=-1), id="estimator failed"),
        pytest.param(odometry(position=(math.nan, 0, 0)), id="position"),
        pytest.param(odometry(position=(0, 0, 3e38)), id="far away"),
        pytest.param(odometry(velocity=(0, math.inf, 0)), id="velocity"),
        pytest.param(odometry(rates=(0, 0, math.nan)), id="rates"),
        pytest.param(odometry(attitude=(0, 0, 0, 0)), id="attitude"),
        pytest.param(odometry(attitude=(math.nan,) * 4), id="attitude unknown"),
        pytest.param(b"", id="empty"),
        pytest.param(b"nonsense", id="no message"),
        pytest.param(pack(odometry())[:-1], id="cut short"),
        pytest.param(pack(odometry())[:40] + b"!" + pack(odometry())[41:], id="damaged"),
        pytest.param(b"\xfd\xff\x00", id="announces more"),
    ],
)
def test_what_is_no_pose_is_counted_and_does_not_spoil_the_next(listening, sent):
    one = listening()
    assert one.hear(sent) == [] and one.source.rejected == 1
    assert len(one.hear(odometry())) == 1 and one.source.rejected == 1


def test_packets_are_numbered_by_counting_and_old_stamps_do_not_count(listening):
    one = listening()
    packets = one.hear(*(odometry(1000 * stamp) for stamp in (10, 20, 20, 15, 30)))
    assert [packet.sequence for packet in packets] == [0, 1, 2]
    assert [packet.stamp for packet in packets] == pytest.approx([0.010, 0.020, 0.030])
    assert one.source.rejected == 2


def test_an_autopilot_may_begin_anew_after_a_silence(listening):
    one = listening()
    assert len(one.hear(odometry(9_000_000))) == 1
    assert one.hear(odometry(5000)) == []
    clock = PoseClock(Stamping.receive, 0.0)
    received = MavlinkPose(Given([pack(odometry(9_000_000)), pack(odometry(5000)), pack(odometry(6000))])).poll()
    assert [clock.read(packet) is not None for packet in received] == [True] * 3


def test_a_datagram_that_ends_amid_its_second_message_holds_one(listening):
    one = listening()
    assert len(one.hear(pack(odometry(1000)) + pack(odometry(2000))[:-1])) == 1 and one.source.rejected == 1


def test_several_messages_in_a_datagram_and_those_of_version_1(listening):
    assert len(listening().hear(pack(odometry(1000)) + pack(odometry(2000)))) == 2
    pair = [pack(message, force_mavlink1=True) for message in (attitude_quaternion(990), local_position(1000))]
    assert len(listening("LOCAL_POSITION_NED").hear(*pair)) == 1


def test_messages_of_other_kinds_are_passed_over(listening):
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    one = listening()
    assert len(one.hear(heartbeat, attitude_quaternion(1500), local_position(1500), odometry(), vision(1))) == 1
    assert one.source.rejected == 0


class TestPositionWithAttitude:
    """LOCAL_POSITION_NED with the newest ATTITUDE_QUATERNION."""

    @pytest.mark.parametrize(("theirs", "ours"), SIGNS)
    def test_signs(self, listening, theirs, ours):
        """The velocity is the world's already, whatever the attitude."""
        (packet,) = listening("LOCAL_POSITION_NED").hear(
            attitude_quaternion(1000, YAW_RIGHT, theirs), local_position(1000, position=theirs, velocity=theirs)
        )
        assert packet.stamp == pytest.approx(1.0) and same_attitude(packet.attitude, (HALF, 0, 0, -HALF))
        assert all(close(vector, ours) for vector in (packet.position, packet.linear_velocity, packet.body_rates))

    @pytest.mark.parametrize("milliseconds", [-20, 20])
    def test_the_attitude_is_turned_to_the_time_of_the_position(self, listening, milliseconds):
        """At 10 rad/s to the right: by 0.2 rad, back or on."""
        sent = attitude_quaternion(1000, rates=(0, 0, 10)), local_position(1000 + milliseconds)
        (packet,) = listening("LOCAL_POSITION_NED").hear(*sent)
        half = -0.5 * 0.01 * milliseconds  # left is positive
        assert same_attitude(packet.attitude, (math.cos(half), 0, 0, math.sin(half)))

    @pytest.mark.parametrize(
        "attitude",
        [
            [],
            [attitude_quaternion(949)],
            [attitude_quaternion(1051)],
            [attitude_quaternion(1000, (0, 0, 0, 0))],
            [attitude_quaternion(1000, rates=(math.inf, 0, 0))],
            [attitude_quaternion(1000), attitude_quaternion(1000, (math.nan, 0, 0, 0))],
        ],
        ids=["none", "old", "early", "no attitude", "no rates", "no attitude any more"],
    )
    def test_a_position_without_an_attitude_is_counted(self, listening, attitude):
        one = listening("LOCAL_POSITION_NED")
        assert one.hear(*attitude, local_position(1000)) == [] and one.source.rejected == 1


class TestPosesWithoutVelocities:
    """VISION_POSITION_ESTIMATE and ATT_POS_MOCAP."""

    @pytest.mark.parametrize(("theirs", "ours"), SIGNS)
    @pytest.mark.parametrize(("name", "make"), [("VISION_POSITION_ESTIMATE", vision), ("ATT_POS_MOCAP", mocap)])
    def test_velocities_are_made_from_poses(self, listening, name, make, theirs, ours):
        """At 20 m/s along each axis in turn; the first pose says nothing of it."""
        one = listening(name)
        packets = one.hear(*(make(10_000 * n, position=0.2 * n * np.array(theirs)) for n in range(3)))
        assert [packet.stamp for packet in packets] == pytest.approx([0.01, 0.02]) and one.source.rejected == 1
        assert close(packets[1].position, 0.4 * np.array(ours))
        assert all(close(packet.linear_velocity, 20.0 * np.array(ours)) for packet in packets)
        assert all(close(packet.body_rates, 0.0) for packet in packets)

    @pytest.mark.parametrize(("theirs", "ours"), SIGNS)
    @pytest.mark.parametrize("name", ["VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP"])
    def test_rates_are_made_from_attitudes(self, listening, name, theirs, ours):
        """At 10 rad/s about each axis in turn."""
        angles = [0.1 * n * np.array(theirs) for n in range(3)]
        sent = [vision(10_000 * n, angles=angle) for n, angle in enumerate(angles)]
        if name == "ATT_POS_MOCAP":
            halves = [(math.cos(0.05 * n), *(math.sin(0.05 * n) * np.array(theirs))) for n in range(3)]
            sent = [mocap(10_000 * n, attitude=half) for n, half in enumerate(halves)]
        packets = listening(name).hear(*sent)
        assert all(np.allclose(packet.body_rates, 10.0 * np.array(ours), atol=1e-4) for packet in packets)
        assert len(packets) == 2

    def test_angles_are_yaw_then_pitch_then_roll(self, listening):
        """East, then nose up: forward is up, and the roof looks west; then rolled right: the roof looks south."""
        for roll, roof in ((0.0, (0, 1, 0)), (math.pi / 2, (-1, 0, 0))):
            angles = roll, math.pi / 2, math.pi / 2
            (packet,) = listening("VISION_POSITION_ESTIMATE").hear(
                vision(0, angles=angles), vision(9000, angles=angles)
            )
            assert close(rotation_matrix(packet.attitude)[:, 0], (0, 0, 1))
            assert close(rotation_matrix(packet.attitude)[:, 2], roof)

    def test_they_are_smoothed(self, listening):
        """One time constant after a step of 10 m/s, 63 % of it are there."""
        one = listening("ATT_POS_MOCAP", smoothing=0.02)
        packets = one.hear(*(mocap(20_000 * n, position=(x, 0, 0)) for n, x in enumerate((0.0, 0.0, 0.2))))
        assert packets[-1].linear_velocity[0] == pytest.approx(10.0 * (1 - math.exp(-1)), rel=1e-5)


SHARE = 25_000
"""Strings of each of four kinds."""


def hostile_messages(generator: np.random.Generator) -> list[bytes]:
    """Messages whose frame and checksum are right; a tenth of the numbers are not, of any bit pattern."""
    makers = (
        lambda stamp, v: attitude_quaternion(stamp, v[:4], v[4:7]),
        lambda stamp, v: odometry(1000 * stamp, v[4:7], v[:4], v[7:10], v[10:13]),
        lambda stamp, v: local_position(stamp, v[:3], v[3:6]),
        lambda stamp, v: vision(1000 * stamp, v[:3], v[3:6]),
        lambda stamp, v: mocap(1000 * stamp, v[4:7], v[:4]),
    )
    size = 5000, 13
    right = generator.normal(size=size)
    right[:, :4] /= np.linalg.norm(right[:, :4], axis=1, keepdims=True)
    special = generator.choice([0, math.nan, math.inf, -math.inf, 3e38, 1e-45, 1e6], size)
    wild = generator.integers(0, 2**32, size, dtype=np.uint32).view(np.float32)
    kind = generator.random(size)
    numbers = np.where(kind < 0.9, right, np.where(kind < 0.95, special, wild)).tolist()
    stamps = generator.integers(0, 100, len(numbers)).tolist()  # ms
    made = [pack(makers[n % 5](stamp, v)) for n, (stamp, v) in enumerate(zip(stamps, numbers, strict=True))]
    return made * (SHARE // len(made))


def fuzz(kind: str) -> list[bytes]:
    generator = np.random.default_rng(0)
    if kind == "hostile":
        return hostile_messages(generator)
    valid = pack(odometry(position=(1, 2, 3)))
    lengths = generator.integers(0, 80, SHARE).tolist()
    if kind == "noise":
        return [generator.bytes(length) for length in lengths]
    if kind == "headed":  # looks like an ODOMETRY to the last byte but those of the checksum
        return [valid[:10] + generator.bytes(len(valid) - 10) for _ in range(SHARE)]
    damaged = np.tile(np.frombuffer(valid, np.uint8), (SHARE, 1))
    places = generator.integers(0, len(valid), SHARE)
    damaged[np.arange(SHARE), places] ^= generator.integers(1, 256, SHARE, dtype=np.uint8)
    return [row.tobytes() for row in damaged]


@pytest.mark.parametrize("whole", [True, False], ids=["datagrams", "stream"])
@pytest.mark.parametrize("kind", ["noise", "headed", "damaged", "hostile"])
def test_a_hundred_thousand_hostile_strings(kind, whole):
    """None raises, and what passes is finite, of unit attitude and of a size that can be."""
    pieces, names = fuzz(kind), list(MESSAGES) if kind == "hostile" else ["ODOMETRY"]
    share = len(pieces) // len(names)
    for n, name in enumerate(names):
        source = MavlinkPose(Given(pieces[n * share : (n + 1) * share], whole), name)
        with np.errstate(all="raise", under="ignore"):  # nothing is calculated with what is too large
            packets = [received.packet for received in source.poll()]
        for packet in packets:
            numbers = np.concatenate(packet[2:])
            assert np.isfinite(numbers).all() and np.abs(numbers).max() < 2e6 and math.isfinite(packet.stamp)
            assert np.linalg.norm(packet.attitude) == pytest.approx(1.0)
        assert source.rejected > 100
        assert bool(packets) == (kind == "hostile"), f"{len(packets)} poses of {name}"


def poll_until(source, enough) -> list:
    """What has arrived by the time that it is enough: the kernel passes bytes on when it has time."""
    received, deadline = source.poll(), time.monotonic() + 5.0
    while not enough(received) and time.monotonic() < deadline:
        time.sleep(1e-3)
        received += source.poll()
    return received


def test_messages_come_in_pieces_amid_noise_over_a_serial_port(wire):
    pytest.importorskip("serial")
    far, path = wire
    source = make_poses("mavlink", device=path, baud=921_600)
    assert source.poll() == []
    sent = b"noise" + pack(odometry(1000)) + pack(odometry(2000))
    os.write(far, sent[:60])
    assert poll_until(source, lambda received: source.rejected == 1) == []
    os.write(far, sent[60:])
    received = poll_until(source, lambda received: len(received) == 2)
    assert [one.packet.stamp for one in received] == pytest.approx([0.001, 0.002])
    assert time.monotonic() - 1.0 < received[0].time <= time.monotonic()
    source.close()
    source.close()


def test_missing_pymavlink_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.common", None)
    with pytest.raises(ImportError, match=r"The pose source mavlink needs pymavlink: .*pip install .*\[hil\]'"):
        MavlinkPose(Given([]))
