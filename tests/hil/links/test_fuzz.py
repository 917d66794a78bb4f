"""Hostile bytes: no link and no listener takes them for anything, and all are counted."""

from __future__ import annotations

import socket
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

from dreamer_racing.hil.links.crsf import decode_crsf, encode_crsf
from dreamer_racing.hil.links.msp import decode_msp, encode_msp
from dreamer_racing.hil.links.sbus import decode_sbus, encode_sbus
from dreamer_racing.hil.links.udp import CommandPacket, decode_command, encode_command
from dreamer_racing.hil.pose import PACKET_SIZE, PosePacket, UdpPose, encode_pose
from dreamer_racing.hil.stamping import PoseClock, Stamping
from dreamer_racing.hil.vehicle import Command, Setpoint
from dreamer_racing.plant.commands import CommandReceiver
from dreamer_racing.plant.vehicle import PlantVehicle

SHARE = 20_000
"""Strings of each of five kinds."""


class Codec(NamedTuple):
    """What is fed, and how many strings of noise that begin like a frame (``header``) may pass for one."""

    encode: Callable[[np.ndarray], bytes]
    decode: Callable[[bytes], Any]
    header: int
    passing: int


def encode_numbers(values: np.ndarray) -> bytes:
    command = Command(bool(values[0] > 1500), Setpoint(values[1] / 100, values[2:5] / 100))
    return encode_command(CommandPacket(int(values[5]), float(values[6]), command))


CODECS = {
    "crsf": Codec(encode_crsf, decode_crsf, 3, 120),  # 8 bits of CRC: 78 expected
    "msp": Codec(encode_msp, decode_msp, 5, 120),  # 8 bits of checksum: 78 expected
    "sbus": Codec(encode_sbus, decode_sbus, 1, 20),  # 12 bits that are always 0: 5 expected
    "udp": Codec(encode_numbers, decode_command, 4, 0),  # 32 bits of CRC
}


@pytest.fixture(params=CODECS)
def codec(request):
    return request.param, CODECS[request.param]


@pytest.fixture
def frames(codec):
    """Valid frames to be damaged, and random numbers to do it with."""
    generator = np.random.default_rng(0)
    frames = [codec[1].encode(values) for values in generator.uniform(1000, 2000, (200, 16))]
    assert all(codec[1].decode(frame) is not None for frame in frames)
    return frames, generator


def test_noise(codec, frames):
    """Of any length, and of a frame's length with a frame's header."""
    name, (_, decode, header, passing) = codec
    valid, generator = frames
    size = len(valid[0])
    noise, tails = generator.bytes(2 * SHARE * size), generator.bytes(SHARE * size)
    lengths = generator.integers(0, 2 * size, SHARE).tolist()
    starts = range(0, len(noise), 2 * size)
    assert [n for n, length in zip(starts, lengths, strict=True) if decode(noise[n : n + length]) is not None] == []

    begin = valid[0][:header]
    passed = sum(decode(begin + tails[n + header : n + size]) is not None for n in range(0, len(tails), size))
    assert passed <= passing, f"{passed} of {SHARE} strings of noise passed for {name}"


def test_truncated(codec, frames):
    _, (_, decode, _, _) = codec
    valid, generator = frames
    lengths = generator.integers(0, len(valid[0]), SHARE).tolist()
    assert all(decode(valid[n % len(valid)][:length]) is None for n, length in enumerate(lengths))


def test_one_bit_flipped(codec, frames):
    """All are found, but for those in an SBUS frame's channels and flags, which no checksum guards."""
    name, (_, decode, _, _) = codec
    valid, generator = frames
    size = len(valid[0])
    bits = generator.integers(0, 8 * size, SHARE).tolist()
    passed = set()
    for n, bit in enumerate(bits):
        damaged = int.from_bytes(valid[n % len(valid)], "little") ^ 1 << bit
        if decode(damaged.to_bytes(size, "little")) is not None:
            passed.add(bit)
    assert passed == (set(range(8, 8 * 23 + 4)) if name == "sbus" else set())


def test_replayed(codec, frames):
    """A copy says what the original said; in UDP, with the sequence number by which it is known."""
    _, (_, decode, _, _) = codec
    valid, generator = frames
    said = [plain(decode(frame)) for frame in valid]
    order = generator.integers(0, len(valid), SHARE).tolist()
    assert all(plain(decode(valid[index])) == said[index] for index in order)


def plain(decoded: Any) -> Any:
    """What a frame says, in a form that compares."""
    return encode_command(decoded) if isinstance(decoded, CommandPacket) else decoded


# A hundred thousand hostile packets each for what listens: none counts as a pose or a command, and all are counted.


PACKETS = 25_000
"""Packets of each of four kinds."""
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


def test_poses(random: np.random.Generator) -> None:
    """Through the socket and onto the loop's clock, as a flight has them."""
    level, zero = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    valid = [encode_pose(PosePacket(7 + n, 0.005 * n, random.normal(size=3), level, zero, zero)) for n in range(100)]
    poses, clock, arrived = UdpPose(0), PoseClock(Stamping.receive, 0.0), []
    assert len(valid[0]) == PACKET_SIZE
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send(packets: list[bytes]) -> list[bool]:
            for packet in packets:
                sender.sendto(packet, poses.address)
            arrived.extend(packets)
            return [clock.read(received._replace(time=1.0)) is not None for received in poses.poll()]

        assert send(valid) == [True] * 100
        for kind in (malformed, truncated, impossible):
            rejected, packets = poses.rejected, list(kind(valid, random))
            for start in range(0, PACKETS, AT_A_TIME):
                assert send(packets[start : start + AT_A_TIME]) == [], kind.__name__
            assert poses.rejected - rejected == PACKETS, kind.__name__
        packets, rejected = list(replayed(valid, random)), poses.rejected
        for start in range(0, PACKETS, AT_A_TIME):
            assert not any(send(packets[start : start + AT_A_TIME]))
        assert clock.out_of_order == PACKETS and poses.rejected == rejected and len(arrived) == 4 * PACKETS + 100
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
    for kind in (malformed, truncated, impossible):
        before = receiver.malformed
        assert not any(receiver.take(packet, 0.1) for packet in kind(valid, random)), kind.__name__
        assert receiver.malformed - before == PACKETS, kind.__name__
    assert not any(receiver.take(packet, 0.1) for packet in replayed(valid, random))
    assert receiver.stale == PACKETS and receiver.malformed == 3 * PACKETS and receiver.received == 100
    assert given == [] and receiver.failsafe.deadline == pytest.approx(0.35)  # nor do they keep it alive
