"""What all links are made of: a way to write a command down, and a transport that takes the bytes without waiting."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from dreamer_racing.hil.sticks import FIRST_SWITCH, RateMap, ThrustMap, channels
from dreamer_racing.hil.vehicle import Command, at_rest


class Transport(Protocol):
    """Takes bytes to where they are heard."""

    def write(self, data: bytes) -> bool:
        """Hand over bytes without waiting; return whether they were taken, all of them.

        Raises:
            OSError: The device is gone; what may pass by itself is not raised.
        """
        ...

    def close(self) -> None:
        """Give back socket or device; may be called twice."""
        ...


class TransportLink(ABC):
    """A `Link` over a transport; a subclass says how a command is written.

    Args:
        transport: Takes the bytes; closed with the link.

    Attributes:
        dropped: Commands so far that did not go out, because a buffer was full or nobody listened.
    """

    def __init__(self, transport: Transport) -> None:
        self.dropped = 0
        self._transport = transport

    @abstractmethod
    def encode(self, command: Command) -> bytes:
        """Return the bytes that say a command: `at_rest`, or an armed one whose numbers are finite."""

    def send(self, command: Command) -> bytes:
        """Send a command now, without waiting; return the bytes that went out, none if it was dropped.

        Raises:
            ValueError: An armed command whose setpoint is not finite: no vehicle could be told that.
            OSError: The device is gone.
        """
        thrust, rates = command.setpoint
        if command.armed and not (np.isfinite(thrust) and np.isfinite(rates).all()):
            raise ValueError(f"collective_thrust={thrust}, body_rates={rates}: an armed command must be finite.")
        data = self.encode(command if command.armed else at_rest())
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

    Attributes:
        thrust: May be replaced in flight, as the battery's voltage sinks.
    """

    def __init__(
        self,
        transport: Transport,
        encode_channels: Callable[[Sequence[float]], bytes],
        rates: RateMap,
        thrust: ThrustMap,
        arm_channel: int = FIRST_SWITCH,
    ) -> None:
        super().__init__(transport)
        self.thrust = thrust
        self._encode_channels, self._rates, self._arm_channel = encode_channels, rates, arm_channel

    def encode(self, command: Command) -> bytes:
        """Return the frame of a command."""
        return self._encode_channels(channels(command, self._rates, self.thrust, self._arm_channel))
