"""What all links are made of: a way to write a command down, and a transport that takes the bytes without waiting."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np

from dreamer_racing.hil.battery import Reading
from dreamer_racing.hil.imu import ImuReading
from dreamer_racing.hil.links.telemetry import Telemetry
from dreamer_racing.hil.sticks import FIRST_SWITCH, RateMap, ThrustMap, channels
from dreamer_racing.hil.vehicle import Command, at_rest

ASK_EVERY = 5
"""Commands from one request for telemetry to the next, where a link has to ask [choice]: 5 to 10 a second."""


class Transport(Protocol):
    """Takes bytes to where they are heard, and gives those that come back."""

    def write(self, data: bytes) -> bool:
        """Hand over bytes without waiting; return whether they were taken, all of them.

        Raises:
            OSError: The device is gone; what may pass by itself is not raised.
        """
        ...

    def discard(self) -> None:
        """Throw away what was written and has not left yet.

        Raises:
            OSError: The device is gone.
        """
        ...

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield what has come back, as `Inlet.read` does.

        Raises:
            OSError: The device is gone.
        """
        ...

    def close(self) -> None:
        """Give back socket or device; may be called twice."""
        ...


class TransportLink(ABC):
    """A `Link` over a transport; a subclass says how a command is written.

    Args:
        transport: Takes the bytes; closed with the link.
        thrust: What motors and battery make of their command; None where thrust is sent as it is.
        telemetry: Reads what comes back; None if nothing does.

    Attributes:
        dropped: Commands so far that did not go out, because a buffer was full or nobody listened.
        thrust: As given, with the voltage of now.
    """

    def __init__(
        self, transport: Transport, thrust: ThrustMap | None = None, telemetry: Telemetry | None = None
    ) -> None:
        self.dropped = 0
        self.thrust = thrust
        self._transport, self._telemetry = transport, telemetry
        self._armed = False  # whether the last command was
        self._felt: list[ImuReading] = []

    @property
    def rejected(self) -> int:
        """What has come back so far and was not understood, see `Telemetry`."""
        return 0 if self._telemetry is None else self._telemetry.rejected

    @property
    def refusal(self) -> str:
        """Why the flight controller does not fly what it is told, or would not; empty as far as is known."""
        return "" if self._telemetry is None else self._telemetry.refusal(self._armed)

    def listen(self) -> list[Reading]:
        """Return the battery's voltages that have come back since the last call, oldest first, without waiting.

        Raises:
            OSError: The device is gone.
        """
        if self._telemetry is None:
            return []
        readings = []
        for time, data in self._transport.read():
            readings += [Reading(time, voltage) for voltage in self._telemetry.read(data)]
            self._felt += [ImuReading(time, sample) for sample in self._telemetry.felt]
            self._telemetry.felt.clear()
        return readings

    def feel(self) -> list[ImuReading]:
        """Return what the vehicle's IMU told until the last `listen`, oldest first."""
        felt, self._felt = self._felt, []
        return felt

    def reckon_with(self, voltage: float) -> None:
        """Let the thrust map reckon with a voltage, V, from now on, or with the nearest that it can (`ThrustMap.at`).

        A reading in flight never raises: beyond what `ThrustMap.check` allows it is the last that is allowed which
        counts, and what is not finite counts for nothing.
        """
        if self.thrust is not None and self.thrust.voltage != voltage:
            self.thrust = self.thrust.at(voltage)

    @property
    def longest(self) -> int:
        """Bytes of the longest command; for links whose commands differ in size."""
        return len(self.encode(at_rest()))

    @abstractmethod
    def encode(self, command: Command) -> bytes:
        """Return the bytes that say a command: `at_rest`, or an armed one whose numbers are finite."""

    def send(self, command: Command) -> bytes:
        """Send a command now, without waiting; return the bytes that went out, none if it was dropped.

        The first that disarms overtakes armed ones that still wait.

        Raises:
            ValueError: An armed command whose setpoint is not finite: no vehicle could be told that.
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
        """Give back socket or device; may be called twice."""
        self._transport.close()


class ChannelLink(TransportLink):
    """Says commands as the 16 channels of a radio.

    Args:
        transport: Takes the bytes.
        encode_channels: Writes 16 channels, in µs, in the protocol's form.
        rates: What the flight controller makes of the sticks.
        thrust: What it makes of the throttle.
        arm_channel: Index of the switch that arms, see `channels`.
        telemetry: See `TransportLink`.
        request: Asks for telemetry; goes out with the first of every `ASK_EVERY` commands.
        always: Asks for what is wanted at each command.
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
        """Return the frame of a command, and the request where that is due."""
        frame = self._encode_channels(channels(command, self._rates, self.thrust, self._arm_channel))
        due = self._encoded % ASK_EVERY == 0
        self._encoded += 1
        return frame + (self._request if due else b"") + self._always
