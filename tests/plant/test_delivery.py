"""Poses on their way out: noise, loss, latency and jitter have the statistics that they are set to."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dreamer_racing.hil.pose import PosePacket, decode_pose
from dreamer_racing.hil.vehicle import Pose
from dreamer_racing.plant.delivery import Delivery, PoseDelivery

ATTITUDE = np.array((0.8, 0.0, 0.6, 0.0))
NUMBER = 4000


def pose(time: float) -> Pose:
    return Pose(time, np.array((1.0, 2.0, 3.0)), ATTITUDE, np.array((4.0, 5.0, 6.0)), np.array((0.1, 0.2, 0.3)))


def deliver(number: int = NUMBER, tick: float = 1e-4, **settings: float) -> tuple[list[PosePacket], list[float]]:
    """What arrives of so many poses, and how old it is at departure, in steps of `tick` s."""
    delivery = PoseDelivery(Delivery(**settings))
    packets, ages = [], []
    offset = settings.get("clock_offset", 0.0)
    step = 0
    while delivery.next_measurement < number / Delivery(**settings).rate or delivery.next_departure < math.inf:
        time = step * tick
        if delivery.next_measurement <= time + 1e-9 and delivery.next_measurement < number / Delivery(**settings).rate:
            delivery.measure(pose(time), time)
        for data in delivery.depart(time + 1e-9):
            packet = decode_pose(data)
            assert packet is not None
            packets.append(packet)
            ages.append(time - (packet.stamp - offset))
        step += 1
    assert delivery.sent == len(packets) and delivery.sent + delivery.dropped == number
    return packets, ages


def test_nothing_is_changed_unless_asked_for() -> None:
    packets, ages = deliver(50)
    assert [packet.sequence for packet in packets] == list(range(50))
    assert max(ages) < 1e-6
    for count, packet in enumerate(packets):
        assert packet.stamp == pytest.approx(count / 200.0)
        for sent, true in zip(packet[2:], pose(0.0)[1:], strict=True):
            assert sent == pytest.approx(true)


def test_loss_is_the_share_that_never_leaves() -> None:
    packets, _ = deliver(packet_loss=0.1, seed=3)
    lost = 1.0 - len(packets) / NUMBER
    assert lost == pytest.approx(0.1, abs=4 * math.sqrt(0.1 * 0.9 / NUMBER))
    assert [packet.sequence for packet in packets] == sorted(packet.sequence for packet in packets)
    assert packets[-1].sequence > NUMBER - 50  # gaps in the sequence show it


def test_latency_holds_all_back_alike() -> None:
    _, ages = deliver(500, latency=0.012)
    assert min(ages) == pytest.approx(0.012, abs=1e-4) and max(ages) == pytest.approx(0.012, abs=1.1e-4)


def test_jitter_is_uniform_on_top_of_latency_and_lets_packets_overtake() -> None:
    packets, ages = deliver(latency=0.005, jitter=0.01, seed=1)
    assert 0.005 - 1e-6 <= min(ages) < 0.0055 and 0.0145 < max(ages) <= 0.015 + 1e-4
    assert np.mean(ages) == pytest.approx(0.01, abs=2e-4)
    assert np.std(ages) == pytest.approx(0.01 / math.sqrt(12.0), rel=0.05)
    sequence = [packet.sequence for packet in packets]
    assert sequence != sorted(sequence) and sorted(sequence) == list(range(NUMBER))


def test_noise_has_its_deviation_and_keeps_attitudes_at_unit_length() -> None:
    packets, _ = deliver(position_noise=0.01, attitude_noise=0.02, seed=2)
    errors = np.array([packet.position for packet in packets]) - pose(0.0).position
    assert errors.mean(0) == pytest.approx(np.zeros(3), abs=4 * 0.01 / math.sqrt(NUMBER))
    assert errors.std(0) == pytest.approx(np.full(3, 0.01), rel=0.06)
    attitudes = np.array([packet.attitude for packet in packets])
    assert np.linalg.norm(attitudes, axis=1) == pytest.approx(np.ones(NUMBER))
    angles = 2.0 * np.arccos(np.clip(np.abs(attitudes @ ATTITUDE), 0.0, 1.0))
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.02 * math.sqrt(3.0), rel=0.06)
    assert all(packet.linear_velocity == pytest.approx((4.0, 5.0, 6.0)) for packet in packets[:20])


def test_stamps_are_of_a_clock_of_its_own() -> None:
    packets, _ = deliver(20, clock_offset=-1234.5)
    assert packets[7].stamp == pytest.approx(7 / 200.0 - 1234.5)


def test_a_seed_makes_it_the_same_again() -> None:
    settings = {"packet_loss": 0.2, "jitter": 0.004, "position_noise": 0.1, "attitude_noise": 0.1}
    first, again, other = (deliver(100, seed=seed, **settings) for seed in (5, 5, 6))
    assert first[1] == again[1] and first[1] != other[1]
    assert all((one.position == two.position).all() for one, two in zip(first[0], again[0], strict=True))
