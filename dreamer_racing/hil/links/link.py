"""Base classes of links, which encode commands and send the bytes over a non-blocking transport, and of telemetry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

import numpy as np

from dreamer_racing.hil.battery import Reading
from dreamer_racing.hil.imu import ImuReading
from dreamer_racing.hil.sticks import FIRST_SWITCH, RateMap, ThrustMap, channels
from dreamer_racing.hil.vehicle import Command, at_rest

T = TypeVar("T")
ASK_EVERY = 5  # commands per telemetry request, for links that have to ask [choice]: 5 to 10 requests a second


class Transport(Protocol):
    """Sends bytes to a vehicle, and receives those that come back; raises `OSError` only if the device is gone."""

    def write(self, data: bytes) -> bool:
        """Send bytes without blocking; return whether all of them were accepted."""

    def discard(self) -> None:
        """Discard bytes that were written but not sent yet."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield the received bytes, as `Inlet.read` does."""

    def close(self) -> None:
        """Close the socket or device; may be called twice."""


class Telemetry(ABC):
    """Extracts battery voltages and IMU samples from bytes that arrive in chunks. Other frames are ignored.

    Attributes:
        imu_samples: IMU samples (6,) found so far, oldest first, see `hil.imu`; whoever reads them clears the list.
        rejected: Number of frames that were damaged or without a usable value, and of byte runs that were no frame.
        unanswered: Number of requests sent since the last answer that a subclass counts; see `ChannelLink`.
    """

    def __init__(self) -> None:
        self.rejected = self.unanswered = 0
        self.imu_samples: list[np.ndarray] = []

    @abstractmethod
    def read(self, data: bytes) -> list[float]:
        """Parse bytes; return the voltages in them, V, oldest first. It never raises."""

    def _add(self, values: list[T], value: T | None) -> None:
        """Add a frame's value to a list, or count the frame if it gave none."""
        values += [] if value is None else [value]
        self.rejected += value is None

    def refusal(self, armed: bool) -> str:
        """Return why the flight controller does not (if not ``armed``: would not) follow commands, if it is known."""
        return ""


class FrameReader:
    """Splits a stream of bytes into frames. Damaged bytes are skipped up to the next intact frame.

    Args:
        size_of: Returns the size of the frame at the start of the given bytes, up to 8; 0 if more bytes are needed to
            tell; None if no frame starts there.
        is_whole: Returns whether the checksum of a frame is right.
    """

    def __init__(self, size_of: Callable[[bytes], int | None], is_whole: Callable[[bytes], bool]) -> None:
        self.size_of, self.is_whole = size_of, is_whole
        self._buffer = bytearray()
        self._lost = False  # whether the last byte was skipped: consecutive ones count once

    def read(self, data: bytes) -> Iterator[bytes | None]:
        """Add bytes; yield the intact frames in them, oldest first, and None for damaged ones and runs of no frame."""
        self._buffer += data
        while self._buffer:
            size = self.size_of(bytes(self._buffer[:8]))
            if size is not None and not 0 < size <= len(self._buffer):
                return  # the rest is on its way
            frame = bytes(self._buffer[: size or 0])
            if size is None or not self.is_whole(frame):
                counts, self._lost = size is not None or not self._lost, True
                del self._buffer[0]
                if counts:
                    yield None
                continue
            del self._buffer[:size]
            self._lost = False
            yield frame


class TransportLink(ABC):
    """A `Link` over a transport; subclasses encode the commands.

    Args:
        transport: Sends the bytes; closed with the link.
        thrust: Map from motor command to thrust; None if thrust is sent in SI units.
        telemetry: Parses received bytes; None if there are none.

    Attributes:
        dropped: Number of commands so far that were not sent, because a buffer was full or nobody listened.
    """

    def __init__(
        self, transport: Transport, thrust: ThrustMap | None = None, telemetry: Telemetry | None = None
    ) -> None:
        self.dropped = 0
        self.thrust = thrust
        self._transport, self._telemetry = transport, telemetry
        self._armed = False  # whether the last command was armed
        self._imu_samples: list[ImuReading] = []

    @property
    def rejected(self) -> int:
        """Number of received frames that could not be read, see `Telemetry`."""
        return 0 if self._telemetry is None else self._telemetry.rejected

    @property
    def refusal(self) -> str:
        """Why the flight controller does not follow commands, or would not if armed; empty if no reason is known."""
        return "" if self._telemetry is None else self._telemetry.refusal(self._armed)

    def listen(self) -> list[Reading]:
        """Return the battery voltages received since the last call, oldest first, without blocking."""
        if self._telemetry is None:
            return []
        readings = []
        for time, data in self._transport.read():
            readings += [Reading(time, voltage) for voltage in self._telemetry.read(data)]
            self._imu_samples += [ImuReading(time, sample) for sample in self._telemetry.imu_samples]
            self._telemetry.imu_samples.clear()
        return readings

    def read_imu(self) -> list[ImuReading]:
        """Return the IMU samples received up to the last `listen`, oldest first."""
        samples, self._imu_samples = self._imu_samples, []
        return samples

    def set_voltage(self, voltage: float) -> None:
        """Set the thrust map's voltage, V, or the nearest that it can have (`ThrustMap.at`).

        A reading in flight never raises: one beyond what `ThrustMap` allows is clipped, one that is not finite is
        ignored.
        """
        if self.thrust is not None and self.thrust.voltage != voltage:
            self.thrust = self.thrust.at(voltage)

    @property
    def longest(self) -> int:
        """Bytes of the longest command; for links whose commands differ in size."""
        return len(self.encode(at_rest()))

    @abstractmethod
    def encode(self, command: Command) -> bytes:
        """Return the bytes of a command: `at_rest`, or an armed one with finite numbers."""

    def send(self, command: Command) -> bytes:
        """Send a command without blocking; return the bytes sent, none if it was dropped.

        The first disarming command discards armed ones that still wait.

        Raises:
            ValueError: The command is armed and its setpoint is not finite.
            OSError: The device is gone.
        """
        thrust, rates = command.setpoint
        if command.armed and not (np.isfinite(thrust) and np.isfinite(rates).all()):
            raise ValueError(f"collective_thrust={thrust}, body_rates={rates}: an armed command must be finite.")
        data = self.encode(command if command.armed else at_rest())
        if self._armed and not command.armed:
            self._transport.discard()
        self._armed = command.armed
        if self._transport.write(data):
            return data
        self.dropped += 1
        return b""

    def close(self) -> None:
        """Close the socket or device; may be called twice."""
        self._transport.close()


class ChannelLink(TransportLink):
    """Sends commands as the 16 channels of a radio.

    Args:
        transport: Sends the bytes.
        encode_channels: Encodes 16 channels, in µs, in the protocol's format.
        rates, thrust, arm_channel: See `channels`.
        telemetry: See `TransportLink`.
        request: Telemetry request, sent with the first of every `ASK_EVERY` commands.
        always: Request sent with every command.
    """

    thrust: ThrustMap

    def __init__(
        self,
        transport: Transport,
        encode_channels: Callable[[Sequence[float]], bytes],
        rates: RateMap,
        thrust: ThrustMap,
        arm_channel: int = FIRST_SWITCH,
        telemetry: Telemetry | None = None,
        request: bytes = b"",
        always: bytes = b"",
    ) -> None:
        super().__init__(transport, thrust, telemetry)
        self._encode_channels, self._rates, self._arm_channel = encode_channels, rates, arm_channel
        self._request, self._always, self._encoded = request, always, 0

    def encode(self, command: Command) -> bytes:
        """Return the frame of a command, with the requests that are due."""
        frame = self._encode_channels(channels(command, self._rates, self.thrust, self._arm_channel))
        due = self._encoded % ASK_EVERY == 0
        self._encoded += 1
        if due and self._request and self._telemetry is not None:
            self._telemetry.unanswered += 1
        return frame + (self._request if due else b"") + self._always
