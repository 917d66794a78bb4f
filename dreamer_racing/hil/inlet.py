"""Non-blocking receivers of bytes: UDP here, serial ports in `links.serial_port.SerialPort`."""

from __future__ import annotations

import errno
import socket
import struct
import sys
import time
from collections.abc import Iterator
from typing import Protocol

_REMEDIES = {
    errno.EACCES: "Ports below 1024 are reserved for the system: choose a higher one.",
    errno.EPERM: "This user may not listen there: choose a port above 1024.",
    errno.EADDRNOTAVAIL: "This machine has no such address: 127.0.0.1 is this machine only, 0.0.0.0 all its addresses.",
    errno.EADDRINUSE: "Another program uses it: is another flight, or plant, still running?",
}
RECEIVED_AT = 35 if sys.platform == "linux" else None  # SO_TIMESTAMPNS, which Python's socket does not name


class Inlet(Protocol):
    """A non-blocking receiver of bytes.

    Attributes:
        whole: Whether each chunk holds whole messages, as datagrams do; else a message may span several chunks.
    """

    whole: bool

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the received chunks, oldest first, each with its arrival time (s, ``time.monotonic``).

        Raises:
            OSError: The device is gone.
        """

    def close(self) -> None:
        """Close the socket or device; may be called twice."""


class UdpInlet:
    """Receives datagrams on a UDP port, each with the kernel's receive timestamp.

    Linux starts to timestamp a few ms after the machine's first socket asks for it; until then, the time of reading is
    used.

    Args:
        port: To listen on; 0 picks a free one.
        host: Address to listen on; the default accepts datagrams from this machine only.

    Attributes:
        address: Host and port that it listens on.

    Raises:
        OSError: The port is in use, or may not be used; the message names it.
    """

    whole = True
    _MOST = 1024  # datagrams read per call, so that a flood cannot stall the loop
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
    """Return a non-blocking UDP socket bound to an address; an error names it, and what would help."""
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
    """Converts the kernel's receive timestamps from the wall clock to the monotonic clock, even if the former is set.

    A datagram arrived after the queue was last empty. If the present clock difference puts it before that, or into the
    future, it was stamped before the wall clock was set, and the clock difference of that time is used.
    """

    _SLACK = 1e-3  # s, tolerance of comparing the two clocks [choice]: reading both may be interrupted

    def __init__(self) -> None:
        self.emptied(time.monotonic())

    def emptied(self, since: float) -> None:
        """Note that the queue was empty at a time, s (``time.monotonic``)."""
        self._since = since
        self._ahead = time.time() - time.monotonic()  # s, wall clock minus monotonic clock

    def of(self, ancillary: list[tuple[int, int, bytes]]) -> float:
        """Return the arrival time of a datagram that was just read; now, if the kernel gave no timestamp."""
        now = time.monotonic()
        stamp = kernel_stamp(ancillary)
        if stamp is None:
            return now
        arrived = stamp - (time.time() - now)
        if not self._since - self._SLACK <= arrived <= now + self._SLACK:
            arrived = stamp - self._ahead
        return min(max(arrived, self._since), now)


def kernel_stamp(ancillary: list[tuple[int, int, bytes]]) -> float | None:
    """Return the kernel's receive timestamp of a datagram, s by the wall clock; None if there is none."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == RECEIVED_AT and len(data) >= 16:
            seconds, nanoseconds = struct.unpack_from("@ll", data)
            return seconds + 1e-9 * nanoseconds
    return None
