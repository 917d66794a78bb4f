"""Poses: their packets, the time they were taken, and what is made of them."""

from __future__ import annotations

import errno
import math
import os
import re
import socket
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.hil.attitude import rotation_matrix
from dreamer_racing.hil.pose import PACKET, PosePacket, Received, UdpPose, decode_pose, encode_pose, make_packet
from dreamer_racing.hil.stamping import PoseClock, Stamping, extrapolate
from dreamer_racing.hil.vehicle import Pose


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


def test_the_layout_is_as_documented_and_a_packet_survives_the_way():
    sent = packet()._replace(attitude=np.array([0.5, -0.5, 0.5, 0.5]), linear_velocity=np.array([-1e6, 0.1, 1e6]))
    data = encode_pose(sent)
    assert len(data) == PACKET.size == 124
    assert data[:4] == b"DRP1" and data[4:8] == (7).to_bytes(4, "little")
    assert struct.unpack("<14d", data[8:120]) == (12.5, *np.concatenate(sent[2:]))
    assert data[120:] == zlib.crc32(data[:120]).to_bytes(4, "little")
    read = decode_pose(data)
    assert read is not None and read[:2] == (7, 12.5)
    assert all(np.array_equal(one, other) for one, other in zip(sent[2:], read[2:], strict=True))


@pytest.mark.parametrize(
    "spoilt",
    [
        {"position": (math.nan, 0.0, 0.0)},
        {"attitude": (2.0, 0.0, 0.0, 0.0)},
        {"stamp": math.nan},
        {"position": (0.0, -1.001e6, 0.0)},
        {"body_rates": (0.0, 1e200, 1e200)},
    ],
)
def test_impossible_numbers_are_no_pose(spoilt):
    sent = packet()._replace(**{name: np.array(value) if name != "stamp" else value for name, value in spoilt.items()})
    assert decode_pose(encode_pose(sent)) is None


def test_attitudes_come_out_at_unit_length():
    read = decode_pose(encode_pose(packet()._replace(attitude=np.array([0.0, 1.05, 0.0, 0.0]))))
    assert read is not None and read.attitude.tolist() == [0.0, 1.0, 0.0, 0.0]


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


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "Ports below 1024 are reserved"),
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


# Times of poses and what is made of them, by hand.


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def received(sequence: int, stamp: float, time: float) -> Received:
    packet = make_packet(sequence, stamp, np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))
    assert packet is not None
    return Received(time, packet)


def pose(time: float = 0.0, velocity: tuple = (0, 0, 0), rates: tuple = (0, 0, 0)) -> Pose:
    return Pose(time, np.zeros(3), LEVEL, np.array(velocity, float), np.array(rates, float))


def times(clock: PoseClock, packets: list[Received]) -> list[float | None]:
    return [None if (read := clock.read(packet)) is None else round(read.time, 9) for packet in packets]


def test_by_arrival_a_fixed_latency_is_taken_off():
    assert times(PoseClock(Stamping.receive, 0.004), [received(0, 77.0, 10.0)]) == [9.996]


def test_by_stamp_the_least_delay_tells_the_clocks_apart():
    packets = [received(0, 0.00, 100.007), received(1, 0.01, 100.012), received(2, 0.02, 100.029)]
    # delays of 7, 2 and 9 ms: from the second on the clocks are known to be 100.002 s apart
    assert times(PoseClock(Stamping.sender, 0.0, drift_max=0.0), packets) == [100.007, 100.012, 100.022]
    assert times(PoseClock(Stamping.sender, 0.002, drift_max=0.0), packets) == [100.005, 100.01, 100.02]


def test_old_and_repeated_packets_are_left_out_and_wrapping_is_no_step_back():
    clock = PoseClock(Stamping.receive, 0.0)
    wrapped = [
        received(2**32 - 1, 0.0, 1.0),
        received(0, 0.1, 1.1),
        received(0, 0.1, 1.2),
        received(2**32 - 2, 0.0, 1.3),
    ]
    assert times(clock, wrapped) == [1.0, 1.1, None, None]
    assert clock.out_of_order == 2


def test_what_arrived_earlier_than_the_newest_pose_is_left_out_whatever_its_number():
    """A wall clock that is set ages what waits: 0.3 s here, in a packet that is newer by its number."""
    for stamping in Stamping:
        clock = PoseClock(stamping, 0.0)
        packets = [received(0, 7.0, 10.0), received(1, 7.02, 9.72), received(2, 7.04, 10.04), received(3, 7.05, 10.05)]
        assert times(clock, packets) == [10.0, None, 10.04, 10.05]
        assert clock.out_of_order == 1


def test_a_piece_that_holds_several_poses_gives_the_last_of_them():
    assert times(PoseClock(Stamping.receive, 0.0), [received(k, 7.0 + 0.01 * k, 10.0) for k in range(3)]) == [10.0] * 3


def test_poses_never_step_back_when_a_faster_packet_tells_more_of_the_clocks():
    clock = PoseClock(Stamping.sender, 0.0)
    packets = [received(0, 0.00, 100.050), received(1, 0.01, 100.051), received(2, 0.02, 100.020)]
    packets += [received(3, 0.03, 100.052), received(4, 0.06, 100.070)]
    assert times(clock, packets) == [100.05, 100.051, None, 100.052, 100.07]


def test_a_sender_may_begin_anew_after_a_silence_only():
    clock = PoseClock(Stamping.sender, 0.0, drift_max=0.0)
    assert times(clock, [received(5000, 900.0, 1.0), received(0, 3.0, 1.4)]) == [1.0, None]
    assert times(clock, [received(0, 3.0, 1.5), received(1, 3.01, 1.515)]) == [1.5, 1.51]


@pytest.mark.parametrize(("drift", "behind"), [(100e-6, 0.0), (-100e-6, 0.0), (500e-6, 20.0 * 300e-6)])
def test_a_clock_that_drifts_is_followed_as_far_as_clocks_do(drift, behind):
    """By 200 ppm; beyond them, poses seem ever older."""
    clock = PoseClock(Stamping.sender, 0.0, drift_max=200.0)
    read = times(clock, [received(k, 0.005 * k * (1 - drift), 50.0 + 0.005 * k) for k in range(4001)])
    assert 70.0 - read[-1] == pytest.approx(behind, abs=1e-5)


def test_a_delay_that_grows_is_seen_as_age_and_not_forgotten():
    """40 ms a second up to 300 ms, as a filling queue does; then it stays for 10 s, in which 200 ppm are 2 ms."""
    clock = PoseClock(Stamping.sender, 0.0, drift_max=200.0)
    ages = []
    for k in range(3500):
        stamp = 0.005 * k
        delay = min(0.3, 0.04 * stamp)
        (time,) = times(clock, [received(k, stamp, 50.0 + stamp + delay)])
        ages.append(50.0 + stamp + delay - time)
    assert ages[1500] == pytest.approx(0.3, abs=0.002) and ages[-1] == pytest.approx(0.3, abs=0.004)


def test_a_clock_that_is_set_back_does_not_make_what_waits_look_fresh():
    """In a queue of 120 ms; before the step and after it, and until packets wait less."""
    clock = PoseClock(Stamping.sender, 0.0, drift_max=0.0)
    ages = []
    for k in range(100):
        delay = 0.0 if k == 0 else 0.12 if k < 80 else 0.01
        stamp = 0.01 * k - 0.02 * (k >= 50)
        arrived = 50.0 + 0.01 * k + delay
        (time,) = times(clock, [received(k, stamp, arrived)])
        ages.append(None if time is None else round(arrived - time, 6))
    assert ages[1:80] == [0.12] * 79 and ages[91:] == [0.01] * 9


def test_a_clock_that_is_set_back_again_and_again_tells_nothing():
    clock = PoseClock(Stamping.sender, 0.0)
    packets = [received(k, 7.0 - 0.001 * k, 10.0 + 0.01 * k) for k in range(40)]
    assert times(clock, packets)[:2] == [10.0, 10.01] and clock.out_of_order == 38


def test_by_arrival_stamps_say_nothing():
    packets = [received(k, 7.0 - 0.001 * k, 10.0 + 0.01 * k) for k in range(40)]
    assert None not in times(PoseClock(Stamping.receive, 0.0), packets)


def test_what_was_known_of_another_clock_is_forgotten_after_a_silence():
    clock = PoseClock(Stamping.sender, 0.0)
    assert times(clock, [received(0, 3.0, 10.0), received(1, 3.6, 10.9), received(2, 3.7, 11.0)]) == [10.0, 10.9, 11.0]


def test_extrapolation_flies_on():
    later = extrapolate(pose(1.0, velocity=(8.0, 0.0, -1.0), rates=(0.0, 0.0, math.pi)), 1.5)
    assert later.time == 1.5 and later.position == pytest.approx([4.0, 0.0, -0.5])
    assert rotation_matrix(later.attitude)[:, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)  # a quarter to the left
    assert extrapolate(pose(1.0, velocity=(8, 0, 0)), 0.9).position.tolist() == [0.0, 0.0, 0.0]


def test_the_program_of_the_page_on_wiring_sends_poses(poses):
    page = (Path(__file__).parents[2] / "docs" / "hil_wiring.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert "range(2000)" in program and '("127.0.0.1", 9100)' in program
    exec(program.replace("range(2000)", "range(3)").replace("9100", str(poses.address[1])), {})
    heard = poses.poll()
    assert [each.packet.sequence for each in heard] == [0, 1, 2] and poses.rejected == 0
    assert rotation_matrix(heard[0].packet.attitude)[:, 0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
