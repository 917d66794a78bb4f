"""Poses over UDP: the packet, and the socket that takes them in without ever waiting.

The packet, little endian, 124 bytes: ``b"DRP1"``, sequence number u32, the sender's time f64 (s, of any clock that does
not jump), position 3 f64, attitude 4 f64 (wxyz), linear velocity 3 f64, body rates 3 f64, and CRC-32 u32 of all before
it. Frames and units are those of `Pose`.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple, Protocol

import numpy as np

from dreamer_racing.hil.inlet import UdpInlet

MAGIC = b"DRP1"
_BODY = struct.Struct("<4sId13d")
_CHECK = struct.Struct("<I")
PACKET_SIZE = _BODY.size + _CHECK.size
"""Bytes of a packet: 124."""

LARGEST = 1e6
"""m, m/s, rad/s or rad beyond which a number is no measurement of a drone [choice]."""


class PosePacket(NamedTuple):
    """What a pose packet says.

    Args:
        sequence: Counts packets, modulo 2³².
        stamp: s, the sender's own clock.
        position: (3,) m, world.
        attitude: (4,) wxyz.
        linear_velocity: (3,) m/s, world.
        body_rates: (3,) rad/s, body frame.
    """

    sequence: int
    stamp: float
    position: np.ndarray
    attitude: np.ndarray
    linear_velocity: np.ndarray
    body_rates: np.ndarray


class Received(NamedTuple):
    """A packet and when it arrived.

    Args:
        time: s, ``time.monotonic``.
        packet: What it says.
    """

    time: float
    packet: PosePacket


class PoseSource(Protocol):
    """Where poses come from.

    Attributes:
        rejected: Messages so far that were no pose: malformed, damaged, with numbers that are not `plausible`, or of an
            attitude that is none.
    """

    rejected: int

    def poll(self) -> list[Received]:
        """Return what has arrived since the last call, oldest first, without waiting."""
        ...

    def close(self) -> None:
        """Give back socket or device; may be called twice."""
        ...


def encode_pose(packet: PosePacket) -> bytes:
    """Return the bytes of a packet."""
    numbers = (*packet.position, *packet.attitude, *packet.linear_velocity, *packet.body_rates)
    body = _BODY.pack(MAGIC, packet.sequence % 2**32, packet.stamp, *(float(number) for number in numbers))
    return body + _CHECK.pack(zlib.crc32(body))


def decode_pose(data: bytes) -> PosePacket | None:
    """Return what a packet says; None if it is none: of another size or kind, damaged, or with impossible numbers."""
    if (
        len(data) != PACKET_SIZE
        or data[:4] != MAGIC
        or _CHECK.unpack_from(data, _BODY.size)[0] != zlib.crc32(data[: _BODY.size])
    ):
        return None
    _, sequence, stamp, *numbers = _BODY.unpack_from(data)
    values = np.array(numbers)
    return make_packet(sequence, stamp, values[:3], values[3:7], values[7:10], values[10:])


def make_packet(
    sequence: int,
    stamp: float,
    position: np.ndarray,
    attitude: np.ndarray,
    linear_velocity: np.ndarray,
    body_rates: np.ndarray,
) -> PosePacket | None:
    """Return a packet with its attitude at unit length; None if a number is not plausible or the attitude is none."""
    if not (np.isfinite(stamp) and plausible(position, attitude, linear_velocity, body_rates)):
        return None
    length = float(np.linalg.norm(attitude))
    if not 0.9 < length < 1.1:
        return None
    return PosePacket(sequence, stamp, position, attitude / length, linear_velocity, body_rates)


def plausible(*vectors: np.ndarray) -> bool:
    """Whether all numbers are finite, and of a size that can be calculated with."""
    return all(bool((np.abs(vector) <= LARGEST).all()) for vector in vectors)


class UdpPose:
    """Takes poses from a UDP socket, each with the time at which the kernel received it.

    Args:
        port: To listen on; 0 for a free one.
        host: Address to listen on; other machines reach it only if this says so.

    Attributes:
        address: Host and port that it listens on.
        rejected: See `PoseSource`.

    Raises:
        OSError: The port is in use, or may not be used; the message names it.
    """

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.rejected = 0
        self._inlet = UdpInlet(port, host)
        self.address = self._inlet.address

    def poll(self) -> list[Received]:
        """Return what has arrived since the last call, oldest first, without waiting."""
        received = []
        for time, data in self._inlet.read():
            packet = decode_pose(data)
            if packet is None:
                self.rejected += 1
            else:
                received.append(Received(time, packet))
        return received

    def close(self) -> None:
        """Close the socket."""
        self._inlet.close()
