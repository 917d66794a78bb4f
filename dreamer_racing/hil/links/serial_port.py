"""Serial ports: the settings of each protocol, and a non-blocking port to write to and to read from."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from dreamer_racing.commands import import_extra


class SerialSettings(NamedTuple):
    """Settings of a serial line with 8 data bits."""

    baud: int  # bits a second
    parity: str  # `N` for none, `E` for even
    stop_bits: int  # 1 or 2

    def seconds(self, size: int) -> float:
        """Return how long ``size`` bytes take, s: each with a start bit, 8 data bits, any parity bit, and stop bits."""
        return size * (9 + (self.parity != "N") + self.stop_bits) / self.baud


PROTOCOLS = {
    "crsf": SerialSettings(420_000, "N", 1),
    "sbus": SerialSettings(100_000, "E", 2),
    "msp": SerialSettings(115_200, "N", 1),
    "msp_override": SerialSettings(115_200, "N", 1),
    "mavlink": SerialSettings(57_600, "N", 1),  # PX4's default on TELEM1
}
"""Settings by name of the protocol."""


def serial_settings(protocol: str, baud: int | None) -> SerialSettings:
    """Return the settings of a protocol, at another baud rate if one is given."""
    settings = PROTOCOLS[protocol]
    return settings if baud is None else settings._replace(baud=baud)


BACKLOG = 2
"""Commands that may wait in a port's buffer when the next one is written [choice]: one being sent, and one more."""

_REMEDIES = {
    errno.ENOENT: "there is no such device. Is it plugged in? Look into /dev/serial/by-id",
    errno.EACCES: "you have no permission to use it: sudo usermod -aG dialout $USER, and log in again",
    errno.EAGAIN: "another program uses it: a configurator, or another flight?",
    errno.EBUSY: "another program uses it: a configurator, or another flight?",
}


class SerialPort:
    """A `Transport` and an `Inlet` over a serial port; arrival times are those of reading, up to a tick late.

    Paths in /dev/serial/by-id/ stay the same when a device is plugged in again.

    Raises:
        ImportError: pyserial is not installed.
        OSError: The device is missing, unusable, or in use; the message says which.
        ValueError: The device has no such baud rate.
    """

    whole = False

    def __init__(self, device: str, settings: SerialSettings) -> None:
        self._device = device
        self._port = open_port(device, settings)
        self._left = 0  # bytes that waited after the last write, if a backlog was discarded before it

    def write(self, data: bytes) -> bool:
        """Write bytes; return whether the buffer took them all, and is being sent.

        If not, or if more than a `BACKLOG` waits, the waiting bytes are old: they are discarded, so that the next
        command is received at once.
        """
        descriptor = self._port.fileno()
        waiting = self._waiting()
        stuck = waiting > BACKLOG * len(data) or 0 < self._left <= waiting
        if stuck:
            self.discard()
        self._left = len(data) if stuck else 0
        try:
            # Not pyserial's own write, which retries until the buffer has room.
            written = os.write(descriptor, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise OSError(f"device={self._device}: it is gone: {error.strerror}.") from error
        if written < len(data):
            self.discard()
        return written == len(data) and not stuck

    def discard(self) -> None:
        """Discard bytes that wait to be sent, so that the next command is received at once."""
        import termios

        try:
            self._port.reset_output_buffer()
        except termios.error as error:  # not an OSError
            raise OSError(f"device={self._device}: it is gone: {error}.") from error

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the bytes in the buffer, if there are any, with the time now, s (``time.monotonic``)."""
        try:
            data = self._port.read(self._port.in_waiting)
        except OSError as error:
            raise OSError(f"device={self._device}: it is gone: {error}.") from error
        if data:
            yield time.monotonic(), data

    def _waiting(self) -> int:
        """Return how many bytes wait to be sent, as far as the driver knows; an adapter may hold more."""
        try:
            return int(self._port.out_waiting)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):  # the driver does not report it
                return 0
            raise OSError(f"device={self._device}: it is gone: {error.strerror}.") from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def open_port(device: str, settings: SerialSettings) -> Any:
    """Return an open port of pyserial; raises as `SerialPort` does."""
    serial = import_extra("serial", "hil", "A serial link needs pyserial")
    try:
        return serial.Serial(
            device,
            settings.baud,
            parity=settings.parity,
            stopbits=settings.stop_bits,
            timeout=0,
            write_timeout=0,
            exclusive=True,
        )
    except (ValueError, OverflowError) as error:
        raise ValueError(f"baud={settings.baud}: {device} has no such rate: {error}") from error
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, str(error))
        raise OSError(f"device={device}: {remedy}.") from error
