"""Betaflight's firmware in a process of its own (SITL): channels to its UDP port 9004, and MSP by its TCP port 5761.

The packet, 40 bytes, little endian: a time stamp f64 and 16 u16 µs. The stamp is constant: where the firmware reads the
time from stamps, their jitter becomes its clock's.

Reference: Betaflight, src/platform/SIMULATOR/sitl.c (rc_packet).
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress

from dreamer_racing.hil.links.msp import IMU_REQUEST
from dreamer_racing.hil.links.udp import UdpTransport

RC_PORT, MSP_PORT = 9004, 5761
_PACKET = struct.Struct("<d16H")
_STAMP = 0.0


def encode_sitl(channels: Sequence[float]) -> bytes:
    """Return the packet of 16 channels in µs, rounded to 1 µs."""
    return _PACKET.pack(_STAMP, *(round(value) for value in channels))


class FeelingTransport:
    """A `Transport`: datagrams to the firmware, with each of which it is asked over MSP what its IMU tells.

    Args:
        channels: Takes the datagrams.
        host: Of the firmware.
        port: Of its MSP.

    Raises:
        OSError: Nobody answers there.
    """

    _SIZE = 4096  # bytes read at a time: many answers

    def __init__(self, channels: UdpTransport, host: str, port: int = MSP_PORT) -> None:
        self._channels = channels
        try:
            self._serial = socket.create_connection((host, port), timeout=2.0)
        except OSError as error:
            channels.close()
            raise OSError(f"host={host}, port={port}: no firmware answers there, for its IMU: {error}") from error
        self._serial.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._serial.setblocking(False)

    def write(self, data: bytes) -> bool:
        """Send a datagram, and ask; return whether the datagram went out."""
        with suppress(BlockingIOError, ConnectionError):  # what is not answered grows old, and counts as lost
            self._serial.send(IMU_REQUEST)
        return self._channels.write(data)

    def discard(self) -> None:
        """Do nothing: datagrams leave at once, or not at all."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the answers that have come, with the time now, s (``time.monotonic``)."""
        try:
            data = self._serial.recv(self._SIZE)
        except (BlockingIOError, ConnectionError):
            return
        if data:
            yield time.monotonic(), data

    def close(self) -> None:
        """Close both."""
        self._serial.close()
        self._channels.close()
