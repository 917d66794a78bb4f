"""Poses over UDP: the packet, and the socket that takes them in without ever waiting.

The packet, little endian, 124 bytes: ``b"DRP1"``, sequence number u32, the sender's time f64 (s, of any clock that does
not jump), position 3 f64, attitude 4 f64 (wxyz), linear velocity 3 f64, body rates 3 f64, and CRC-32 u32 of all before
it. Frames and units are those of `Pose`.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
import zlib
from typing import NamedTuple, Protocol

import numpy as np

MAGIC = b"DRP1"
_BODY = struct.Struct("<4sId13d")
_CHECK = struct.Struct("<I")
_RECEIVED_AT = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python's socket does not name
PACKET_SIZE = _BODY.size + _CHECK.size
"""Bytes of a packet: 124."""


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
        rejected: Messages so far that were no pose: malformed, damaged, not finite, or of an attitude that is none.
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
    """Return a packet with its attitude at unit length; None if a number is not finite or the attitude is none."""
    vectors = (position, attitude, linear_velocity, body_rates)
    length = float(np.linalg.norm(attitude)) if all(np.isfinite(vector).all() for vector in vectors) else 0.0
    if not np.isfinite(stamp) or not 0.9 < length < 1.1:
        return None
    return PosePacket(sequence, stamp, position, attitude / length, linear_velocity, body_rates)


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

    _MOST = 1024  # packets taken in at a time: a flood must not stop the loop

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.rejected = 0
        self._socket = bind(host, port)
        self.address: tuple[str, int] = self._socket.getsockname()
        if _RECEIVED_AT is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, _RECEIVED_AT, 1)

    def poll(self) -> list[Received]:
        """Return what has arrived since the last call, oldest first, without waiting."""
        received = []
        for _ in range(self._MOST):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(PACKET_SIZE + 1, 64)
            except (BlockingIOError, ConnectionRefusedError):
                break
            packet = decode_pose(data)
            if packet is None:
                self.rejected += 1
            else:
                received.append(Received(_arrival(ancillary), packet))
        return received

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def bind(host: str, port: int) -> socket.socket:
    """Return a UDP socket that listens and never waits.

    Raises:
        OSError: It cannot; the message names host and port.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind((host, port))
    except (OSError, OverflowError) as error:
        listening.close()
        raise OSError(f"cannot listen on {host}:{port}: {error}. Is another program using it?") from error
    listening.setblocking(False)
    return listening


def _arrival(ancillary: list[tuple[int, int, bytes]]) -> float:
    """Return when the kernel received a packet, by the monotonic clock; now, if it does not say."""
    now = time.monotonic()
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _RECEIVED_AT and len(data) >= 16:
            seconds, nanoseconds = struct.unpack_from("@ll", data)
            age = time.time() - (seconds + 1e-9 * nanoseconds)
            return now - min(max(age, 0.0), 1.0)  # a stepped wall clock must not make it older than it can be
    return now
