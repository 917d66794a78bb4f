"""Control of the drone by command packets, and the failsafe when they stop."""

from __future__ import annotations

import logging
import math
from typing import Protocol

from dreamer_racing.hil.links.udp import decode_command
from dreamer_racing.hil.vehicle import at_rest
from dreamer_racing.plant.vehicle import PlantVehicle

logger = logging.getLogger(__name__)

TIMEOUT = 0.25  # s without a valid message after which motors are cut [choice]: twelve commands at 50 Hz


class Failsafe:
    """Decides whether motors may turn: not after a silence of ``timeout`` s, and not before a disarmed message.

    As with a radio's arm switch, it is not enough to be armed from the first message on, or again after a silence.

    Attributes:
        events: Number of silences so far while the vehicle was cleared to arm.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._heard = -math.inf
        self._cleared = self._complained = False
        self.events = 0

    @property
    def deadline(self) -> float:
        """When motors are cut if nothing is heard until then, s; infinite if the vehicle is not cleared to arm."""
        return self._heard + self._timeout if self._cleared else math.inf

    def hear(self, armed: bool, time: float) -> bool:
        """Note a valid message; return whether the vehicle may be armed."""
        self._heard = time
        if not armed:
            self._cleared = True
        elif not (self._cleared or self._complained):
            self._complained = True
            logger.warning("plant: armed before any disarmed message: motors stay off until one arrives")
        return armed and self._cleared

    def expire(self, time: float) -> bool:
        """Return whether a silence has just become too long."""
        if time < self.deadline:
            return False
        self._cleared = self._complained = False
        self.events += 1
        logger.warning("plant: no message for %.2f s: motors are cut until disarmed and armed again", self._timeout)
        return True


class Controls(Protocol):
    """A receiver of the messages that control the vehicle."""

    @property
    def due(self) -> float:
        """When `act` is to be called next, s of physics time."""

    def act(self, time: float) -> None:
        """Do what is due at a time, s of physics time."""

    def take(self, data: bytes, time: float) -> bool:
        """Process a datagram; return whether it was accepted."""

    def summary(self) -> str:
        """Return a phrase on what was received."""


class CommandReceiver:
    """Flies the vehicle by command packets (`hil.links.udp`).

    Attributes:
        received: Number of valid packets that were newer than any before.
        lost: Number of packets that never came, by the gaps in the sequence.
        stale: Number of valid packets that were not newer; they are ignored, so that none acts twice or late.
        malformed: Number of messages that were not commands.
    """

    def __init__(self, vehicle: PlantVehicle, timeout: float = TIMEOUT) -> None:
        self._vehicle = vehicle
        self._newest: int | None = None
        self.failsafe = Failsafe(timeout)
        self.received = self.lost = self.stale = self.malformed = 0

    @property
    def due(self) -> float:
        """When motors are to be cut, s of physics time."""
        return self.failsafe.deadline

    def act(self, time: float) -> None:
        """Cut the motors if nothing was heard for too long; then a sender may restart its sequence."""
        if self.failsafe.expire(time):
            self._newest = None
            self._vehicle.cut()

    def take(self, data: bytes, time: float) -> bool:
        """Process a datagram; return whether the vehicle got its command."""
        packet = decode_command(data)
        if packet is None:
            self.malformed += 1
            return False
        ahead = 1 if self._newest is None else (packet.sequence - self._newest) % 2**32
        if not 0 < ahead < 2**31:
            self.stale += 1
            return False
        self._newest = packet.sequence
        self.received += 1
        self.lost += ahead - 1
        armed = self.failsafe.hear(packet.command.armed, time)
        self._vehicle.command(packet.command if armed else at_rest())
        return True

    def summary(self) -> str:
        """Return a phrase on what was received."""
        return (
            f"{self.received} commands ({self.lost} lost, {self.stale} stale, {self.malformed} malformed), "
            f"{self.failsafe.events} failsafe(s)"
        )
