"""Estimates when a pose was measured, by the loop's clock, and extrapolates it to now; see docs/hil_wiring.md."""

from __future__ import annotations

import math
from enum import Enum

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.pose import Received
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Pose

SILENCE = 0.5  # s without packets after which a sender may restart with lower numbers [choice]; motors are cut by then


class Stamping(Enum):
    """How the measurement time of a pose is determined."""

    receive = "receive"  # arrival time minus a fixed latency
    sender = "sender"  # the sender's timestamp, mapped to our clock by the least delay so far


class PoseClock:
    """Converts the times of packets to the loop's clock.

    Args:
        stamping: Method of conversion.
        latency: s from measurement to arrival of the least delayed packet, which timestamps cannot show.
        drift_max: ppm by which the sender's clock may run slower than ours. The assumed least delay grows at most this
            fast; faster growth is taken as network delay, which makes poses older.

    Attributes:
        out_of_order: Number of packets ignored so far: older than one before, repeated, or of a clock that was set back
            more than once in half a second.
    """

    def __init__(self, stamping: Stamping, latency: float, drift_max: float = SafetyLimits.clock_drift_max) -> None:
        self.stamping = stamping
        self.latency = latency
        self.out_of_order = 0
        self._drift_max = 1e-6 * drift_max
        self._offset = math.inf  # s, arrival time minus timestamp of the least delayed packet
        self._newest: Received | None = None
        self._set_back_at = -math.inf  # s, when the sender's clock was last set back
        self._latest = -math.inf  # s, newest measurement time so far

    def read(self, received: Received) -> Pose | None:
        """Return the pose of a packet; None if its number is not newer than the newest one's, or its time is older.

        Numbers and timestamps may restart only after a silence: else a replayed packet would pass for a new sender.
        """
        packet = received.packet
        if self._newest is not None:
            newer = 0 < (packet.sequence - self._newest.packet.sequence) % 2**32 < 2**31
            waited = received.time - self._newest.time
            set_back = self.stamping is Stamping.sender and newer and packet.stamp < self._newest.packet.stamp
            again = set_back and received.time - self._set_back_at < SILENCE
            if waited < 0.0 or ((again or not newer) and waited < SILENCE):
                self.out_of_order += 1
                return None
            if waited >= SILENCE:
                self._offset = math.inf  # it may be another clock
            elif set_back:
                # Assume the same delay as of the packet before, until a less delayed packet arrives.
                self._offset += self._newest.packet.stamp + waited - packet.stamp
                self._set_back_at = received.time
            self._offset += self._drift_max * waited
        self._newest = received
        measured = self._measured(received)
        if measured < self._latest:  # a less delayed packet improved the clock offset, but its pose is older
            self.out_of_order += 1
            return None
        self._latest = measured
        return Pose(measured, packet.position, packet.attitude, packet.linear_velocity, packet.body_rates)

    def _measured(self, received: Received) -> float:
        if self.stamping is Stamping.receive:
            return received.time - self.latency
        self._offset = min(self._offset, received.time - received.packet.stamp)
        return min(received.packet.stamp + self._offset, received.time) - self.latency


def extrapolate(pose: Pose, time: float) -> Pose:
    """Extrapolate a pose to a time, s, with constant velocity and body rates; unchanged if that is not later."""
    elapsed = time - pose.time
    if elapsed <= 0.0:
        return pose
    return pose._replace(
        time=time,
        position=pose.position + elapsed * pose.linear_velocity,
        attitude=turn(pose.attitude, elapsed * pose.body_rates),
    )
