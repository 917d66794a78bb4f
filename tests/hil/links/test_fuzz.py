"""A hundred thousand hostile packets each for what listens: none counts as a pose or a command, and all are counted."""

from __future__ import annotations

import socket
import struct
import zlib
from collections.abc import Iterator

import numpy as np
import pytest

from dreamer_racing.hil.imu import decode_imu, encode_imu
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.operator import Operator, decode_operator, encode_operator
from dreamer_racing.hil.pose import PosePacket, UdpPose, decode_pose, encode_pose
from dreamer_racing.hil.stamping import PoseClock, Stamping
from dreamer_racing.hil.vehicle import Command, Setpoint
from dreamer_racing.plant.commands import CommandReceiver
from dreamer_racing.plant.vehicle import PlantVehicle

PACKETS = 20_000
"""Packets of each of five kinds."""
AT_A_TIME = 100  # that fit into a socket's buffer


def malformed(valid: list[bytes], random: np.random.Generator) -> Iterator[bytes]:
    """Noise of any length, and of the right one with the right beginning."""
    size = len(valid[0])
    for count in range(PACKETS):
        if count % 2:
            yield random.bytes(int(random.integers(0, 2 * size)))
        else:
            yield valid[0][:4] + random.bytes(size - 4)


def truncated(valid: list[bytes], random: np.random.Generator) -> Iterator[bytes]:
    """Beginnings of valid packets, empty ones among them, and valid ones with something behind."""
    size = len(valid[0])
    for count in range(PACKETS):
        packet = valid[count % len(valid)]
        yield packet + packet[:3] if count % 10 == 0 else packet[: int(random.integers(0, size))]


def damaged(valid: list[bytes], random: np.random.Generator) -> Iterator[bytes]:
    """One bit of each is flipped."""
    size = len(valid[0])
    for count, bit in enumerate(random.integers(0, 8 * size, PACKETS).tolist()):
        number = int.from_bytes(valid[count % len(valid)], "little") ^ 1 << bit
        yield number.to_bytes(size, "little")


def impossible(valid: list[bytes], random: np.random.Generator) -> Iterator[bytes]:
    """Numbers that are none, with the checksum that belongs to them: the sender knows the format."""
    size = len(valid[0])
    for count in range(PACKETS):
        packet = bytearray(valid[count % len(valid)])
        place = 8 * int(random.integers(0, (size - 4) // 8 - 1))
        struct.pack_into("<d", packet, size - 4 - 8 - place, (np.nan, np.inf, -np.inf)[count % 3])
        struct.pack_into("<I", packet, size - 4, zlib.crc32(packet[:-4]))
        yield bytes(packet)


def replayed(valid: list[bytes], random: np.random.Generator) -> Iterator[bytes]:
    """Packets that were heard before, in any order."""
    for index in random.integers(0, len(valid), PACKETS).tolist():
        yield valid[index]


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


LEVEL, ZERO = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)


@pytest.mark.parametrize(
    ("valid", "decode"),
    [
        (encode_pose(PosePacket(7, 12.5, ZERO, LEVEL, ZERO, ZERO)), decode_pose),
        (encode_operator(1, Operator(False, False)), decode_operator),
        (encode_imu(3, 1.5, np.ones(6)), decode_imu),
    ],
    ids=["pose", "operator", "imu"],
)
def test_a_hundred_thousand_packets_with_a_wrong_byte(valid, decode, random) -> None:
    assert decode(valid) is not None
    packets = np.tile(np.frombuffer(valid, np.uint8), (100_000, 1))
    places, wrong = random.integers(0, len(valid), 100_000), random.integers(1, 256, 100_000, dtype=np.uint8)
    packets[np.arange(100_000), places] ^= wrong
    assert not any(decode(packet.tobytes()) is not None for packet in packets)


def test_poses(random: np.random.Generator) -> None:
    """Through the socket and onto the loop's clock, as a flight has them."""
    valid = [encode_pose(PosePacket(7 + n, 0.005 * n, random.normal(size=3), LEVEL, ZERO, ZERO)) for n in range(100)]
    poses, clock = UdpPose(0), PoseClock(Stamping.receive, 0.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send(packets: list[bytes]) -> list[bool]:
            for packet in packets:
                sender.sendto(packet, poses.address)
            return [clock.read(received._replace(time=1.0)) is not None for received in poses.poll()]

        assert send(valid) == [True] * 100
        for kind in (malformed, truncated, damaged, impossible):
            rejected, packets = poses.rejected, list(kind(valid, random))
            for start in range(0, PACKETS, AT_A_TIME):
                assert send(packets[start : start + AT_A_TIME]) == [], kind.__name__
            assert poses.rejected - rejected == PACKETS, kind.__name__
        packets, rejected = list(replayed(valid, random)), poses.rejected
        for start in range(0, PACKETS, AT_A_TIME):
            assert not any(send(packets[start : start + AT_A_TIME]))
        assert clock.out_of_order == PACKETS and poses.rejected == rejected
    poses.close()


def test_commands(random: np.random.Generator) -> None:
    """The vehicle does what the one valid sender said last, whatever else it hears."""
    vehicle = PlantVehicle("circle", "easy")
    receiver = CommandReceiver(vehicle)
    given: list[Command] = []
    vehicle.command = given.append
    setpoints = [Setpoint(9.0 + 0.01 * n, np.zeros(3)) for n in range(100)]
    valid = [encode_command(CommandPacket(7 + n, 0.02 * n, Command(n > 0, each))) for n, each in enumerate(setpoints)]
    assert all(receiver.take(packet, 0.1) for packet in valid) and given[-1].setpoint.collective_thrust == 9.99
    given.clear()
    for kind in (malformed, truncated, damaged, impossible):
        before = receiver.malformed
        assert not any(receiver.take(packet, 0.1) for packet in kind(valid, random)), kind.__name__
        assert receiver.malformed - before == PACKETS, kind.__name__
    assert not any(receiver.take(packet, 0.1) for packet in replayed(valid, random))
    assert receiver.stale == PACKETS and receiver.malformed == 4 * PACKETS and receiver.received == 100
    assert given == [] and receiver.failsafe.deadline == pytest.approx(0.35)  # nor do they keep it alive
