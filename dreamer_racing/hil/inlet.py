"""Where bytes come in, without ever waiting: UDP; a serial port is `links.serial_port.SerialPort`."""

from __future__ import annotations

import errno
import socket
import struct
import sys
import time
from collections.abc import Iterator
from typing import Protocol

_REMEDIES = {
    errno.EACCES: "Ports below 1024 are the system's: choose one above.",
    errno.EPERM: "This user may not listen there: choose a port above 1024.",
    errno.EADDRNOTAVAIL: "This machine has no such address: 127.0.0.1 is its own, 0.0.0.0 all that it has.",
    errno.EADDRINUSE: "Another program uses it: is another flight, or plant, still running?",
}
RECEIVED_AT = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python's socket does not name


class Inlet(Protocol):
    """Gives the bytes that have arrived.

    Attributes:
        whole: Whether pieces hold whole messages, as datagrams do; else a message may end in a later piece.
    """

    whole: bool

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield what has arrived, oldest first, with the time at which it did (s, ``time.monotonic``).

        Raises:
            OSError: The device is gone.
        """
        ...

    def close(self) -> None:
        """Give back socket or device; may be called twice."""
        ...


class UdpInlet:
    """Listens on a UDP port; pieces are datagrams, with the time at which the kernel received them.

    Linux begins to do so a few ms after the machine's first socket has asked for it; until then the time is that of
    reading.

    Args:
        port: To listen on; 0 for a free one.
        host: Address to listen on; other machines reach it only if this says so.

    Attributes:
        address: Host and port that it listens on.

    Raises:
        OSError: The port is in use, or may not be used; the message names it.
    """

    whole = True
    _MOST = 1024  # datagrams taken in at a time: a flood must not stop the loop
    _SIZE = 2048  # bytes; more than an Ethernet frame holds

    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self._arrivals = Arrivals()
        self._socket = bind(host, port)
        self.address: tuple[str, int] = self._socket.getsockname()
        if RECEIVED_AT is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, RECEIVED_AT, 1)

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield datagrams."""
        for _ in range(self._MOST):
            began = time.monotonic()
            try:
                data, ancillary, _, _ = self._socket.recvmsg(self._SIZE, 64)
            except (BlockingIOError, ConnectionRefusedError):
                self._arrivals.emptied(began)
                return
            yield self._arrivals.of(ancillary), data

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
        remedy = _REMEDIES.get(error.errno or 0, "") if isinstance(error, OSError) else ""
        raise OSError(f"cannot listen on {host}:{port}: {error}. {remedy}".rstrip()) from error
    listening.setblocking(False)
    return listening


class Arrivals:
    """Puts the kernel's times of arrival, which are the wall clock's, on the monotonic clock; the first may be set.

    What arrived did so after the queue was last empty. A time that the wall clock of now puts before that, or into the
    future, was stamped before the clock was set: there the difference of the clocks as it was then counts.
    """

    _SLACK = 1e-3  # s, to which the two clocks can be compared [choice]: reading both may be interrupted

    def __init__(self) -> None:
        self.emptied(time.monotonic())

    def emptied(self, since: float) -> None:
        """Say that nothing was waiting any more at a time, s (``time.monotonic``)."""
        self._since = since
        self._ahead = time.time() - time.monotonic()  # s, of the wall clock before the monotonic one

    def of(self, ancillary: list[tuple[int, int, bytes]]) -> float:
        """Return when a datagram that was read just now arrived; now, if the kernel does not say."""
        now = time.monotonic()
        stamp = kernel_stamp(ancillary)
        if stamp is None:
            return now
        arrived = stamp - (time.time() - now)
        if not self._since - self._SLACK <= arrived <= now + self._SLACK:
            arrived = stamp - self._ahead
        return min(max(arrived, self._since), now)


def kernel_stamp(ancillary: list[tuple[int, int, bytes]]) -> float | None:
    """Return when the kernel received a datagram, s by the wall clock; None if it does not say."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == RECEIVED_AT and len(data) >= 16:
            seconds, nanoseconds = struct.unpack_from("@ll", data)
            return seconds + 1e-9 * nanoseconds
    return None
