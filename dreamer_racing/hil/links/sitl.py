"""Betaflight's firmware in a process of its own (SITL): channels to UDP port 9004, its status by MSP from TCP 5761.

A firmware that hears channels while it boots may stay in its receiver failsafe for good (betaflight#12401), so that
none are sent before it has said what its status is.

The packet, 40 bytes, little endian: a time stamp f64 and 16 u16 µs. The stamp is constant: where the firmware reads the
time from stamps, their jitter becomes its clock's.

Reference: Betaflight, src/platform/SIMULATOR/sitl.c (rc_packet).
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Iterator, Sequence

from dreamer_racing.hil.betaflight.status import REQUEST, SerialOverTcp
from dreamer_racing.hil.links.link import ASK_EVERY, Transport

logger = logging.getLogger(__name__)

RC_PORT, SERIAL_PORT = 9004, 5761
_PACKET = struct.Struct("<d16H")
_STAMP = 0.0


def encode_sitl(channels: Sequence[float]) -> bytes:
    """Return the packet of 16 channels in µs, rounded to 1 µs."""
    return _PACKET.pack(_STAMP, *(round(value) for value in channels))


class SitlTransport:
    """A `Transport` of channels to a firmware on this machine, which holds them back until it has booted.

    Args:
        channels: To where it hears channels.
        serial: Its first serial port.
    """

    def __init__(self, channels: Transport, serial: SerialOverTcp) -> None:
        self._channels, self._serial = channels, serial
        self._written, self._booted = 0, False

    def write(self, data: bytes) -> bool:
        """Send channels, and ask for the status now and then; return whether they went out."""
        if self._written % ASK_EVERY == 0:
            self._serial.write(REQUEST)
        self._written += 1
        return self._booted and self._channels.write(data)

    def discard(self) -> None:
        """Throw away what was written and has not left yet."""
        self._channels.discard()

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield what its serial port has said."""
        if data := self._serial.read():
            if not self._booted:
                logger.info("the firmware answers: it is sent channels from now on")
            self._booted = True
            yield time.monotonic(), data

    def close(self) -> None:
        """Give back the sockets."""
        self._channels.close()
        self._serial.close()
