"""When a pose was measured, by the loop's own clock, and where the vehicle is by now.

A motion-capture system stamps poses with a clock of its own, and the network delays them by more or less. What is known
is when a packet arrived; what is wanted is when it was measured.
"""

from __future__ import annotations

import math
from enum import Enum

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.pose import Received
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Pose

SILENCE = 0.5
"""s without a packet after which a sender may begin anew, with lower numbers [choice]; the vehicle is cut by then."""


class Stamping(Enum):
    """What a pose's time is."""

    receive = "receive"  # when it arrived, less a fixed latency
    sender = "sender"  # the sender's stamp, put on our clock by the least delay so far


class PoseClock:
    """Puts packets on the loop's clock.

    Args:
        stamping: How.
        latency: s, of the least delayed packet from measurement to arrival: what no stamp shows.
        drift_max: ppm, by which the sender's clock may go slower than ours. The least delay is forgotten no faster
            than this accounts for: what grows faster is delay, and poses become that much older.

    Attributes:
        out_of_order: Packets so far that were older than one before, or the same again, or of a clock that was set back
            more than once in half a second; they are left out.
    """

    def __init__(self, stamping: Stamping, latency: float, drift_max: float = SafetyLimits.clock_drift_max) -> None:
        self.stamping = stamping
        self.latency = latency
        self.out_of_order = 0
        self._drift_max = 1e-6 * drift_max
        self._offset = math.inf  # s, arrival less stamp of the least delayed packet
        self._newest: Received | None = None
        self._set_back_at = -math.inf  # s, when the sender's clock was last
        self._latest = -math.inf  # s, of the poses so far

    def read(self, received: Received) -> Pose | None:
        """Return the pose of a packet; None if its number is not newer than the newest one's, or its time is older.

        Only after a silence may numbers and stamps begin anew: else a replayed packet would be taken for a new sender.
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
                # What waits in a queue is as old as what came before it, until it shows to be less.
                self._offset += self._newest.packet.stamp + waited - packet.stamp
                self._set_back_at = received.time
            self._offset += self._drift_max * waited
        self._newest = received
        measured = self._measured(received)
        if measured < self._latest:  # a packet that was delayed less tells more of the clocks; its pose is an older one
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
    """Return where the vehicle is by then, if it goes on as it did: with its velocity, turning with its body rates.

    Args:
        pose: As measured.
        time: s, by the loop's clock; before the pose's own, the pose is returned as it is.
    """
    elapsed = time - pose.time
    if elapsed <= 0.0:
        return pose
    return pose._replace(
        time=time,
        position=pose.position + elapsed * pose.linear_velocity,
        attitude=turn(pose.attitude, elapsed * pose.body_rates),
    )
