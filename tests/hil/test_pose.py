"""Pose packets: what they say, and that nothing else is taken for one."""

from __future__ import annotations

import errno
import math
import os
import socket
import time
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_racing.hil.pose import PACKET_SIZE, PosePacket, UdpPose, decode_pose, encode_pose, make_packet

NUMBERS = st.floats(-1e6, 1e6)


def packet(sequence: int = 7, stamp: float = 12.5, position: tuple[float, ...] = (1.0, 2.0, 3.0)) -> PosePacket:
    made = make_packet(sequence, stamp, np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.ones(3))
    assert made is not None
    return made


@pytest.fixture
def poses():
    source = UdpPose(0)
    yield source
    source.close()


@pytest.fixture
def sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        yield sending


def test_the_layout_is_as_documented():
    data = encode_pose(packet())
    assert len(data) == PACKET_SIZE == 124
    assert data[:4] == b"DRP1" and data[4:8] == (7).to_bytes(4, "little")
    assert data[120:] == zlib.crc32(data[:120]).to_bytes(4, "little")


@given(sequence=st.integers(0, 2**32 - 1), stamp=NUMBERS, numbers=st.lists(NUMBERS, min_size=9, max_size=9))
def test_a_packet_survives_the_way(sequence, stamp, numbers):
    attitude = np.array([0.5, -0.5, 0.5, 0.5])
    sent = PosePacket(sequence, stamp, np.array(numbers[:3]), attitude, np.array(numbers[3:6]), np.array(numbers[6:]))
    read = decode_pose(encode_pose(sent))
    assert read is not None and (read.sequence, read.stamp) == (sequence, stamp)
    assert all(np.array_equal(one, other) for one, other in zip(sent[2:], read[2:], strict=True))


@pytest.mark.parametrize(
    "spoilt",
    [
        {"position": (math.nan, 0.0, 0.0)},
        {"linear_velocity": (0.0, math.inf, 0.0)},
        {"attitude": (0.0, 0.0, 0.0, 0.0)},
        {"attitude": (2.0, 0.0, 0.0, 0.0)},
        {"stamp": math.nan},
        {"position": (0.0, -1.001e6, 0.0)},
        {"linear_velocity": (1e200, 0.0, 0.0)},
        {"body_rates": (0.0, 1e200, 1e200)},
    ],
)
def test_impossible_numbers_are_no_pose(spoilt):
    sent = packet()._replace(**{name: np.array(value) if name != "stamp" else value for name, value in spoilt.items()})
    assert decode_pose(encode_pose(sent)) is None


def test_attitudes_come_out_at_unit_length():
    read = decode_pose(encode_pose(packet()._replace(attitude=np.array([0.0, 1.05, 0.0, 0.0]))))
    assert read is not None and read.attitude.tolist() == [0.0, 1.0, 0.0, 0.0]


@settings(max_examples=300)
@given(data=st.binary(max_size=PACKET_SIZE + 8))
def test_any_bytes_are_no_pose(data):
    assert decode_pose(data) is None  # a right CRC by chance: 2⁻³²


@given(position=st.integers(0, PACKET_SIZE - 1), flip=st.integers(1, 255))
def test_a_damaged_packet_is_no_pose(position, flip):
    data = bytearray(encode_pose(packet()))
    data[position] ^= flip
    assert decode_pose(bytes(data)) is None


def test_a_hundred_thousand_hostile_packets_are_ignored():
    generator = np.random.default_rng(0)
    good = np.frombuffer(encode_pose(packet()), np.uint8)
    damaged = np.tile(good, (100_000, 1))
    damaged[np.arange(100_000), generator.integers(0, PACKET_SIZE, 100_000)] ^= generator.integers(
        1, 256, 100_000, dtype=np.uint8
    )
    assert not any(decode_pose(row.tobytes()) for row in damaged)


def test_packets_carry_the_time_of_their_arrival(poses, sender, kernel_stamps):
    before = time.monotonic()
    sender.sendto(encode_pose(packet(1)), poses.address)
    sender.sendto(b"nonsense", poses.address)
    after = time.monotonic()
    time.sleep(0.05)  # the loop is busy
    sender.sendto(encode_pose(packet(2)), poses.address)
    first, second = poses.poll()
    assert (first.packet.sequence, second.packet.sequence, poses.rejected) == (1, 2, 1)
    assert before - 2e-3 < first.time < after + 2e-3
    assert second.time - first.time > 0.045
    assert poses.poll() == []


@pytest.mark.parametrize("step", [-3600.0, -0.02, 0.02, 0.5, 3600.0])
def test_a_wall_clock_that_is_set_does_not_move_arrivals(poses, sender, kernel_stamps, monkeypatch, step):
    """What waits was stamped by the clock of before, what comes later by the one of after."""
    assert poses.poll() == []
    real = time.time
    before = time.monotonic()
    sender.sendto(encode_pose(packet(1)), poses.address)
    after = time.monotonic()
    time.sleep(0.01)
    monkeypatch.setattr(time, "time", lambda: real() + step)  # for the inlet; the kernel's own stays as it is
    (waited,) = poses.poll()
    monkeypatch.undo()
    sender.sendto(encode_pose(packet(2)), poses.address)
    time.sleep(0.01)
    (late,) = poses.poll()
    assert before - 2e-3 < waited.time < after + 2e-3
    assert after < late.time < time.monotonic() - 0.005


def test_a_port_in_use_is_said(poses):
    with pytest.raises(OSError, match=rf"cannot listen on 127.0.0.1:{poses.address[1]}: .*in use"):
        UdpPose(poses.address[1])


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "Ports below 1024 are the system's"),
        (errno.EADDRINUSE, "Another program uses it"),
        (errno.EADDRNOTAVAIL, "This machine has no such address"),
        (errno.ENOBUFS, os.strerror(errno.ENOBUFS) + "."),
    ],
)
def test_each_reason_not_to_listen_has_its_own_remedy(monkeypatch, number, remedy):
    """Root may listen anywhere, so the kernel's answer is made up."""

    class Refusing(socket.socket):
        def bind(self, address):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr("dreamer_racing.hil.inlet.socket.socket", Refusing)
    with pytest.raises(OSError, match=r"cannot listen on 127.0.0.1:80: ") as refused:
        UdpPose(80)
    assert remedy in str(refused.value) and ("Another program" in str(refused.value)) == (number == errno.EADDRINUSE)
