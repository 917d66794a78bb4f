"""The base class of message-based pose sources, which makes pose packets from the content of messages."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.attitude import rotation_matrix
from dreamer_racing.hil.pose import PosePacket, Received, make_packet
from dreamer_racing.hil.stamping import SILENCE
from dreamer_racing.hil.velocity import VelocityEstimator

SMOOTHING = 0.01
"""s, time constant of velocities estimated from poses [choice]: two poses of a motion capture at 200 Hz."""


class Measurement(NamedTuple):
    """The content of a message, in the frames of `Pose`; not yet checked."""

    stamp: float  # s, the sender's own clock
    position: np.ndarray  # (3,) m, world
    attitude: np.ndarray  # (4,) wxyz
    # (3,) m/s, world, or body if `in_body`; None: estimated from poses, as are body rates
    linear_velocity: np.ndarray | None = None
    body_rates: np.ndarray | None = None  # (3,) rad/s, body frame
    in_body: bool = False  # whether `linear_velocity` is along the body's axes


class MessagePose(ABC):
    """A `PoseSource` of messages without sequence numbers; subclasses read the messages.

    Packets are numbered by counting. A message whose timestamp is not newer than the newest one is rejected, as
    repeated or late; only after a silence may timestamps restart, as in `PoseClock`.

    Args:
        smoothing: s, time constant of velocities estimated from poses, see `VelocityEstimator`.

    Attributes:
        rejected: Number of messages that gave no pose: as in `PoseSource`, those with an old timestamp, and, without
            velocities, the first one and those after a gap or a jump.
    """

    def __init__(self, smoothing: float) -> None:
        self.rejected = 0
        self._velocities = VelocityEstimator(smoothing)
        self._sequence = 0
        self._newest = (-math.inf, -math.inf)  # arrival and stamp, s

    @abstractmethod
    def listen(self) -> Iterator[tuple[float, Measurement | None]]:
        """Yield the messages that have arrived, without waiting.

        Yields:
            Arrival time (s, ``time.monotonic``) and content; None if that is damaged or unusable.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the socket or device; may be called twice."""

    def poll(self) -> list[Received]:
        """Return the packets that arrived since the last call, oldest first, without blocking."""
        received = []
        for arrival, measured in self.listen():
            packet = None if measured is None else self._packet(arrival, measured)
            if packet is None:
                self.rejected += 1
            else:
                received.append(Received(arrival, packet))
        return received

    def _packet(self, arrival: float, measured: Measurement) -> PosePacket | None:
        """Return the pose packet of a measurement; None if it gives no pose."""
        stamp, position, attitude, velocity, rates, in_body = measured
        velocity, rates = (np.zeros(3) if vector is None else vector for vector in (velocity, rates))
        packet = make_packet(self._sequence, stamp, position, attitude, velocity, rates)
        if packet is None or not self._is_new(arrival, stamp):
            return None
        if measured.linear_velocity is None or measured.body_rates is None:
            estimated = self._velocities.update(stamp, packet.position, packet.attitude)
            if estimated is None:
                return None
            packet = packet._replace(**estimated._asdict())
        elif in_body:
            packet = packet._replace(linear_velocity=rotation_matrix(packet.attitude) @ velocity)
        self._sequence += 1
        return packet

    def _is_new(self, arrival: float, stamp: float) -> bool:
        newest_arrival, newest_stamp = self._newest
        if stamp <= newest_stamp and arrival - newest_arrival < SILENCE:
            return False
        self._newest = arrival, stamp
        return True
