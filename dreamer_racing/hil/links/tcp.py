"""A transport over TCP to the serial port of a firmware on this machine."""

from __future__ import annotations

import time
from collections.abc import Iterator

from dreamer_racing.hil.betaflight.status import SerialOverTcp


class TcpTransport:
    """A `Transport` over `SerialOverTcp`.

    Args:
        serial: The port; closed with the transport.
    """

    def __init__(self, serial: SerialOverTcp) -> None:
        self._serial = serial

    def write(self, data: bytes) -> bool:
        """Write bytes; return whether they were sent."""
        return self._serial.write(data)

    def discard(self) -> None:
        """Do nothing: bytes leave at once."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the received bytes, with the time now, s (``time.monotonic``)."""
        if data := self._serial.read():
            yield time.monotonic(), data

    def close(self) -> None:
        """Close the connection."""
        self._serial.close()
