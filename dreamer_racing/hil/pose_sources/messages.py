"""The base class of message-based pose sources, which makes pose packets from the content of messages.

Velocities and body rates that a message lacks are estimated from successive poses.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.attitude import rotation_between, rotation_matrix
from dreamer_racing.hil.pose import PosePacket, Received, make_packet
from dreamer_racing.hil.stamping import SILENCE

SMOOTHING = 0.01
"""s, time constant of velocities estimated from poses [choice]: two poses of a motion capture at 200 Hz."""

GAP = 0.1  # s between two poses beyond which their difference says nothing about the present velocity [choice]

SPEED_MAX = 50.0
"""m/s above which a pose has jumped instead of moved [choice]: more than twice what racing drones reach."""

RATE_MAX = 50.0  # rad/s above which an attitude has jumped instead of turned [choice]: almost three times 1000 deg/s


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


class Velocity(NamedTuple):
    """A vehicle's velocity and body rates."""

    linear_velocity: np.ndarray  # (3,) m/s, world
    body_rates: np.ndarray  # (3,) rad/s, body frame


class VelocityEstimator:
    """Differentiates successive poses, and smooths the result with a first-order low-pass.

    The filter starts at the first difference, so that steady motion is known exactly from the second pose on. The
    estimate lags by half the time between two poses, plus the time constant.

    Args:
        time_constant: s, of the low-pass, after which 63 % of a step has passed; 0 disables the filter.

    Example:
        >>> level = np.array([1.0, 0.0, 0.0, 0.0])
        >>> estimator = VelocityEstimator(time_constant=0.01)
        >>> estimator.update(0.0, np.zeros(3), level) is None
        True
        >>> estimator.update(0.5**4, np.array([0.25, 0.0, 0.0]), level).linear_velocity.tolist()
        [4.0, 0.0, 0.0]
    """

    def __init__(self, time_constant: float) -> None:
        self._time_constant = time_constant
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None
        self._velocity: Velocity | None = None

    def update(self, time: float, position: np.ndarray, attitude: np.ndarray) -> Velocity | None:
        """Add a pose: when it was measured, s, position (3,), m, and attitude (4,) wxyz of unit length and either sign.

        Returns:
            None for the first pose, and after a gap, a jump or a step back in time, where estimation starts anew.
        """
        last, self._last = self._last, (time, position, attitude)
        elapsed = math.inf if last is None else time - last[0]
        if last is None or not 0.0 < elapsed <= GAP:
            self._velocity = None
            return None
        moved, turned = position - last[1], rotation_between(last[2], attitude)
        if np.linalg.norm(moved) > SPEED_MAX * elapsed or np.linalg.norm(turned) > RATE_MAX * elapsed:
            self._velocity = None
            return None
        measured = Velocity(moved / elapsed, turned / elapsed)
        if self._velocity is None or self._time_constant == 0.0:
            self._velocity = measured
        else:
            gain = -math.expm1(-elapsed / self._time_constant)  # exact for a constant input
            pairs = zip(self._velocity, measured, strict=True)
            self._velocity = Velocity(*(old + gain * (new - old) for old, new in pairs))
        return self._velocity
