"""What comes in and goes out: command packets and poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.pose import PosePacket, decode_pose
from dreamer_racing.hil.vehicle import Command, Pose, Setpoint
from dreamer_racing.plant.commands import CommandReceiver
from dreamer_racing.plant.delivery import Delivery, PoseDelivery
from dreamer_racing.plant.vehicle import PlantVehicle


def packet(sequence: int, armed: bool = True, thrust: float = GRAVITY) -> bytes:
    return encode_command(CommandPacket(sequence, 0.0, Command(armed, Setpoint(thrust, np.zeros(3)))))


def armed_after(vehicle: PlantVehicle) -> bool:
    vehicle.advance(0.002)
    return vehicle.armed


def test_it_arms_after_a_disarmed_command_only(fresh: PlantVehicle, caplog: pytest.LogCaptureFixture) -> None:
    receiver = CommandReceiver(fresh)
    for sequence in range(3):
        assert receiver.take(packet(sequence), 0.0)
    assert not armed_after(fresh)
    assert caplog.text.count("armed before any disarmed message") == 1  # once is enough
    receiver.take(packet(3, armed=False), 0.0)
    assert not armed_after(fresh)
    receiver.take(packet(4), 0.0)
    assert armed_after(fresh)


def test_silence_cuts_the_motors_at_its_time_until_disarmed_and_armed_again(fresh: PlantVehicle) -> None:
    receiver = CommandReceiver(fresh, timeout=0.3)
    assert receiver.due == np.inf  # nothing to cut
    receiver.take(packet(0, armed=False), 1.0)
    receiver.take(packet(1), 1.1)
    assert receiver.due == pytest.approx(1.4)
    receiver.act(1.39)
    assert armed_after(fresh) and receiver.failsafe.events == 0
    receiver.act(receiver.due)
    assert not armed_after(fresh) and receiver.failsafe.events == 1 and receiver.due == np.inf
    receiver.act(2.0)
    receiver.take(packet(2), 2.1)
    assert not armed_after(fresh) and receiver.failsafe.events == 1
    receiver.take(packet(3, armed=False), 2.2)
    receiver.take(packet(4), 2.2)
    assert armed_after(fresh)


def test_lost_and_stale_commands_are_counted_across_the_end_of_the_sequence(fresh: PlantVehicle) -> None:
    receiver = CommandReceiver(fresh)
    for sequence in (2**32 - 3, 2**32 - 1, 2**32 - 2, 2**32 - 1, 1):
        receiver.take(packet(sequence, armed=False), 0.0)
    assert (receiver.received, receiver.lost, receiver.stale) == (3, 2, 2)
    assert "3 commands (2 lost, 2 stale, 0 malformed), 0 failsafe(s)" in receiver.summary()


def test_a_sender_that_begins_anew_is_heard_after_the_failsafe(fresh: PlantVehicle) -> None:
    receiver = CommandReceiver(fresh)
    receiver.take(packet(5000, armed=False), 0.0)
    assert not receiver.take(packet(0, armed=False), 0.1)
    receiver.act(0.25)
    assert receiver.take(packet(1, armed=False), 0.3) and receiver.lost == 0


# Poses on their way out: noise, loss, latency and jitter have the statistics that they are set to.


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


@pytest.mark.parametrize(("latency", "offset"), [(0.0, 0.0), (0.012, -1234.5)])
def test_nothing_is_changed_unless_asked_for(latency: float, offset: float) -> None:
    packets, ages = deliver(50, latency=latency, clock_offset=offset)
    assert [packet.sequence for packet in packets] == list(range(50))
    assert ages == pytest.approx([latency] * 50, abs=1.1e-4)
    for count, packet in enumerate(packets):
        assert packet.stamp == pytest.approx(count / 200.0 + offset)
        for sent, true in zip(packet[2:], pose(0.0)[1:], strict=True):
            assert sent == pytest.approx(true)


def test_loss_is_the_share_that_never_leaves() -> None:
    packets, _ = deliver(packet_loss=0.1, seed=3)
    lost = 1.0 - len(packets) / NUMBER
    assert lost == pytest.approx(0.1, abs=4 * math.sqrt(0.1 * 0.9 / NUMBER))
    assert [packet.sequence for packet in packets] == sorted(packet.sequence for packet in packets)
    assert packets[-1].sequence > NUMBER - 50  # gaps in the sequence show it


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


def test_a_seed_makes_it_the_same_again() -> None:
    settings = {"packet_loss": 0.2, "jitter": 0.004, "position_noise": 0.1, "attitude_noise": 0.1}
    first, again, other = (deliver(100, seed=seed, **settings) for seed in (5, 5, 6))
    assert first[1] == again[1] and first[1] != other[1]
    assert all((one.position == two.position).all() for one, two in zip(first[0], again[0], strict=True))
