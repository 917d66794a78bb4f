"""A transport over TCP to the first serial port of a firmware on this machine."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator


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
