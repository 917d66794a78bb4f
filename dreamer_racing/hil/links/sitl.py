"""The link to a Betaflight firmware in another process (SITL): channels to UDP port 9004, and MSP by TCP port 5761.

A firmware that receives channels while it boots may stay in its receiver failsafe for good (betaflight#12401): none are
sent before it reports that it has booted.

The packet, 40 bytes, little endian: a timestamp f64 and 16 u16 µs. The timestamp is constant: a firmware that reads the
time from timestamps would take over their jitter.

Reference: Betaflight, src/platform/SIMULATOR/sitl.c (rc_packet).
"""

from __future__ import annotations

import logging
import socket
import struct
import time
from collections.abc import Iterator, Sequence

from dreamer_racing.hil.betaflight.status import NOT_READY, REQUEST
from dreamer_racing.hil.links.link import ASK_EVERY, Transport
from dreamer_racing.hil.links.msp import IMU_REQUEST, MspTelemetry

logger = logging.getLogger(__name__)

RC_PORT, MSP_PORT = 9004, 5761
_PACKET = struct.Struct("<d16H")
_STAMP = 0.0


def encode_sitl(channels: Sequence[float]) -> bytes:
    """Return the packet of 16 channels in µs, rounded to 1 µs."""
    return _PACKET.pack(_STAMP, *(round(value) for value in channels))


class SerialOverTcp:
    """A `Transport` that never blocks, and connects again whenever the firmware closes the connection.

    The firmware takes one connection at a time, and closes another at once.
    """

    _RETRY_AFTER = 0.5  # s between attempts to connect

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None
        self._next = 0.0  # when to connect next, s of `time.monotonic`

    def write(self, data: bytes) -> bool:
        """Write bytes; return whether they were sent."""
        if self._socket is None:
            self._connect()
        try:
            return self._socket is not None and self._socket.send(data) == len(data)
        except BlockingIOError:
            return False
        except OSError:
            self._disconnect()
            return False

    def discard(self) -> None:
        """Do nothing: bytes leave at once."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the received bytes, if any, with the time now, s (``time.monotonic``)."""
        if self._socket is None:
            return
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            yield time.monotonic(), data
        else:
            self._disconnect()

    def close(self) -> None:
        """Close the connection; may be called twice."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _connect(self) -> None:
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + self._RETRY_AFTER
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.connect_ex(self._address)  # if nobody listens, the first write fails

    def _disconnect(self) -> None:
        self.close()
        self._next = time.monotonic() + self._RETRY_AFTER


class SitlTransport:
    """A `Transport` of channels to a firmware on this machine, which holds them back until that has booted.

    With each command it requests an IMU sample, if wanted.
    """

    ANSWERS_WITHIN = 10.0
    """s after the first request after which channels are sent even without an answer [choice]: another program may have
    the firmware's serial port, which takes one connection."""

    def __init__(self, channels: Transport, serial: SerialOverTcp, imu: bool = False) -> None:
        self._channels, self._serial = channels, serial
        self._always = IMU_REQUEST if imu else b""
        self._written = 0
        self._asked_at: float | None = None  # time of the first request, s
        self._boots: MspTelemetry | None = MspTelemetry()  # reads its status until it has booted

    def write(self, data: bytes) -> bool:
        """Send channels and the requests that are due; return whether the channels were sent."""
        request = (b"" if self._written % ASK_EVERY else REQUEST) + self._always
        self._written += 1
        if request and self._serial.write(request) and self._asked_at is None:
            self._asked_at = time.monotonic()
        self._check_boot()
        return self._boots is None and self._channels.write(data)

    def _check_boot(self) -> None:
        """Check whether the firmware has booted."""
        if self._boots is None or self._asked_at is None:
            return
        status = self._boots.status
        if status is not None and not NOT_READY & status.reasons.keys():
            logger.info("the firmware has booted: channels are sent to it from now on")
            self._boots = None
        elif status is None and time.monotonic() - self._asked_at > self.ANSWERS_WITHIN:
            logger.warning("the firmware does not report whether it has booted: channels are sent to it anyway")
            self._boots = None

    def discard(self) -> None:
        """Discard channels that were written but not sent yet."""
        self._channels.discard()

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the bytes from its serial port."""
        for arrival, data in self._serial.read():
            if self._boots is not None:
                self._boots.read(data)
            yield arrival, data

    def close(self) -> None:
        """Close both transports."""
        self._channels.close()
        self._serial.close()
