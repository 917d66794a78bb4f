"""Poses over UDP: the packet, and a non-blocking receiver.

The packet, little endian, 124 bytes: ``b"DRP1"``, sequence number u32, the sender's time f64 (s, of any clock that does
not jump), position 3 f64, attitude 4 f64 (wxyz), linear velocity 3 f64, body rates 3 f64, and CRC-32 u32 of all before
it (`hil.packets`). Frames and units are those of `Pose`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from dreamer_racing.hil.inlet import UdpInlet
from dreamer_racing.hil.packets import PacketFormat

PACKET = PacketFormat(b"DRP1", "Id13d")

LARGEST = 1e6  # m, m/s, rad/s or rad beyond which a number is no measurement of a drone [choice]


class PosePacket(NamedTuple):
    """The content of a pose packet."""

    sequence: int  # counts packets, modulo 2³²
    stamp: float  # s, the sender's own clock
    position: np.ndarray  # (3,) m, world
    attitude: np.ndarray  # (4,) wxyz
    linear_velocity: np.ndarray  # (3,) m/s, world
    body_rates: np.ndarray  # (3,) rad/s, body frame


class Received(NamedTuple):
    """A packet and when it arrived."""

    time: float  # s, `time.monotonic`
    packet: PosePacket


class PoseSource(Protocol):
    """A source of pose packets.

    Attributes:
        rejected: Number of messages so far that gave no pose: malformed, damaged, not `plausible`, or with an attitude
            that is not of unit length.
    """

    rejected: int

    def poll(self) -> list[Received]:
        """Return the packets that arrived since the last call, oldest first, without blocking."""

    def close(self) -> None:
        """Close the socket or device; may be called twice."""


def encode_pose(packet: PosePacket) -> bytes:
    """Return the bytes of a packet."""
    numbers = (*packet.position, *packet.attitude, *packet.linear_velocity, *packet.body_rates)
    return PACKET.pack(packet.sequence % 2**32, packet.stamp, *numbers)


def decode_pose(data: bytes) -> PosePacket | None:
    """Return a packet's content; None if it has another size or kind, is damaged, or has impossible numbers."""
    if (content := PACKET.unpack(data)) is None:
        return None
    sequence, stamp, *numbers = content
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
    """Return a packet with its attitude normalised; None if a number is implausible or the attitude far from unit."""
    if not (np.isfinite(stamp) and plausible(position, attitude, linear_velocity, body_rates)):
        return None
    length = float(np.linalg.norm(attitude))
    if not 0.9 < length < 1.1:
        return None
    return PosePacket(sequence, stamp, position, attitude / length, linear_velocity, body_rates)


def plausible(*vectors: np.ndarray) -> bool:
    """Return whether all numbers are finite, and of size `LARGEST` at most."""
    return all(bool((np.abs(vector) <= LARGEST).all()) for vector in vectors)


class UdpPose:
    """Receives poses by a `UdpInlet`, whose arguments it takes, each with the kernel's receive timestamp.

    Attributes:
        address: Host and port that it listens on.
        rejected: See `PoseSource`.
    """

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.rejected = 0
        self._inlet = UdpInlet(port, host)
        self.address = self._inlet.address

    def poll(self) -> list[Received]:
        """Return the packets that arrived since the last call, oldest first, without blocking."""
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
