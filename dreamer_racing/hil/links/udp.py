"""Commands over UDP: the packet in SI units for a simulated vehicle, and a non-blocking socket.

The packet, little endian, 53 bytes: ``b"DRC1"``, sequence number u32, the sender's ``time.monotonic`` f64 (s), armed u8
(0 or 1), collective thrust f64 (m/s²), body rates 3 f64 (rad/s), and CRC-32 u32 of all before it (`hil.packets`).
Frames and units are those of `Setpoint`.
"""

from __future__ import annotations

import errno
import math
import socket
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.imu import decode_imu
from dreamer_racing.hil.links.link import Telemetry, TransportLink
from dreamer_racing.hil.packets import PacketFormat
from dreamer_racing.hil.vehicle import Command, Setpoint

PACKET = PacketFormat(b"DRC1", "IdB4d")
_TRANSIENT_ERRORS = {
    errno.EAGAIN,
    errno.ECONNREFUSED,
    errno.ENOBUFS,
    errno.ENETDOWN,
    errno.ENETUNREACH,
    errno.EHOSTUNREACH,
}


class CommandPacket(NamedTuple):
    """The content of a command packet."""

    sequence: int  # counts packets, modulo 2³²; one that is not newer than the last is a repeated or late one
    stamp: float  # s, the sender's own clock
    command: Command


def encode_command(packet: CommandPacket) -> bytes:
    """Return the bytes of a packet."""
    armed, (thrust, rates) = packet.command
    return PACKET.pack(packet.sequence % 2**32, packet.stamp, bool(armed), thrust, *rates)


def decode_command(data: bytes) -> CommandPacket | None:
    """Return a packet's content; None if it has another size or kind, is damaged, or has impossible numbers."""
    if (content := PACKET.unpack(data)) is None:
        return None
    sequence, stamp, armed, thrust, *rates = content
    if armed > 1 or thrust < 0 or not all(math.isfinite(number) for number in (stamp, thrust, *rates)):
        return None
    return CommandPacket(sequence, stamp, Command(bool(armed), Setpoint(thrust, np.array(rates))))


class UdpTransport:
    """Sends datagrams to one address, and receives its replies.

    Raises:
        OSError: There is no such host; the message names it.
    """

    _MOST = 64  # datagrams read per call, so that a flood cannot stall the loop
    _SIZE = 2048  # bytes; more than an Ethernet frame holds

    def __init__(self, host: str, port: int) -> None:
        self._heard = True  # whether the last datagram reached a listener, as far as is known
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise OSError(f"host={host}, port={port}: cannot send there: {error}") from error

    def write(self, data: bytes) -> bool:
        """Send a datagram; return whether that worked: not if buffers are full or the last one reached no listener."""
        heard, self._heard = self._heard, True
        try:
            try:
                self._socket.send(data)
            except ConnectionRefusedError:  # is of the last datagram; this one was not sent
                heard = False
                self._socket.send(data)
        except OSError as error:
            if error.errno not in _TRANSIENT_ERRORS:
                raise
            return False
        return heard

    def discard(self) -> None:
        """Do nothing: datagrams leave at once, or not at all."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the received datagrams, with the time now, s (``time.monotonic``).

        An error of an earlier datagram is reported by the next `write`.
        """
        for _ in range(self._MOST):
            try:
                data = self._socket.recv(self._SIZE)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in _TRANSIENT_ERRORS:
                    raise
                self._heard = False
                return
            yield time.monotonic(), data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class PacketTelemetry(Telemetry):
    """Reads the packets of `hil.imu`, one per datagram."""

    def read(self, data: bytes) -> list[float]:
        """Parse a datagram, which has no voltages."""
        self._add(self.imu_samples, decode_imu(data))
        return []


class UdpLink(TransportLink):
    """Sends command packets to a vehicle that takes setpoints in SI units, and receives IMU samples, if wanted.

    Example:
        >>> link = UdpLink("127.0.0.1", 9100)
        >>> len(link.send(Command(True, Setpoint(9.81, np.zeros(3)))))
        53
        >>> link.close()
    """

    def __init__(self, host: str, port: int, imu: bool = False) -> None:
        super().__init__(UdpTransport(host, port), telemetry=PacketTelemetry() if imu else None)
        self._sequence = 0

    def encode(self, command: Command) -> bytes:
        """Return the next packet."""
        packet = CommandPacket(self._sequence, time.monotonic(), command)
        self._sequence += 1
        return encode_command(packet)
