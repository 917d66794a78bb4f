"""Plausibility checks of poses for `safety.Safety`: could a vehicle have moved from one pose to the next?"""

from __future__ import annotations

import math
from typing import NamedTuple

from dreamer_racing.hil.odometer import Odometer, TurnOdometer
from dreamer_racing.hil.reasons import Findings, Reason
from dreamer_racing.hil.safety_limits import SafetyLimits, Vector, to_number, to_numbers
from dreamer_racing.hil.vehicle import Pose


class PlainPose(NamedTuple):
    """A `Pose` in plain Python numbers, with an attitude of unit length."""

    time: float
    position: Vector
    attitude: Vector
    velocity: Vector
    body_rates: Vector

    @property
    def speed(self) -> float:
        """m/s."""
        return math.hypot(*self.velocity)

    @property
    def tilt_degrees(self) -> float:
        """Angle between body z and world z."""
        _, x, y, _ = self.attitude
        return math.degrees(2.0 * math.asin(min(1.0, math.hypot(x, y))))

    @property
    def yaw_degrees(self) -> float:
        """Heading of body x from world x, positive to the left."""
        w, x, y, z = self.attitude
        return math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def degrees_from(self, other: PlainPose) -> float:
        """Return the angle between this attitude and another, about any axis, the short way round."""
        cosine = sum(here * there for here, there in zip(self.attitude, other.attitude, strict=True))
        return math.degrees(2.0 * math.acos(min(1.0, abs(cosine))))


def read_pose(pose: Pose) -> PlainPose | None:
    """Return a pose in plain numbers; None if one is not finite, or the attitude is far from unit length."""
    time = to_number(pose.time)
    position, velocity, rates = (
        to_numbers(value, 3) for value in (pose.position, pose.linear_velocity, pose.body_rates)
    )
    attitude = to_numbers(pose.attitude, 4)
    if position is None or velocity is None or rates is None or attitude is None or not math.isfinite(time):
        return None
    length = math.hypot(*attitude)
    if not 0.9 < length < 1.1:
        return None
    return PlainPose(time, position, tuple(value / length for value in attitude), velocity, rates)


class Motion:
    """Compares each pose with those before it.

    Args:
        limits: How far and how fast a vehicle may go and turn.

    Attributes:
        newest: Newest pose; None before the first.
        repeats: Whether the newest pose exactly repeats the one before; real measurements never do.
        changed_at: s, since when poses have not changed.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.newest: PlainPose | None = None
        self.repeats = False
        self.changed_at = -math.inf
        self._limits = limits
        self._odometer = Odometer(limits.velocity_window, gap=limits.cut_after)
        self._turns = TurnOdometer(limits.velocity_window, gap=limits.hold_after)

    def check_pose(self, pose: PlainPose) -> Findings:
        """Add a pose that is newer than the last; return findings of motion that is impossible for a vehicle."""
        last, self.newest = self.newest, pose
        self.repeats = last is not None and (pose.position, pose.attitude) == (last.position, last.attitude)
        if not self.repeats:
            self.changed_at = pose.time
        findings = {} if last is None else self._check_step(last, pose)
        return findings | self._check_claims(pose)

    def _check_claims(self, pose: PlainPose) -> Findings:
        """Compare reported velocities and body rates, by which poses are extrapolated, with how the poses changed."""
        limits = self._limits
        moved = self._odometer.mismatch(pose.time, pose.position, pose.velocity)
        turned = self._turns.mismatch(pose.time, pose.attitude, pose.body_rates)
        words = [
            *_differ("velocities and positions", "m/s", moved, limits.velocity_tolerance),
            *_differ("body rates and attitudes", "rad/s", turned, limits.rate_tolerance),
        ]
        return {Reason.POSE_CONTRADICTION: ", and ".join(words)} if words else {}

    def _check_step(self, last: PlainPose, pose: PlainPose) -> Findings:
        """Compare distance and angle between two poses with what is possible in the time between them."""
        limits, elapsed = self._limits, pose.time - last.time
        findings: Findings = {}
        moved, turned = math.dist(pose.position, last.position), pose.degrees_from(last)
        allowed = limits.reach(elapsed)
        if not moved <= allowed:
            findings[Reason.POSE_JUMP] = f"the pose jumped by {moved:.3g} m (allowed since the last one: {allowed:.3g})"
        allowed = math.degrees(limits.turn_rate_max * elapsed) + limits.turn_tolerance_degrees
        if not turned <= allowed:
            findings[Reason.ATTITUDE_JUMP] = (
                f"the attitude jumped by {turned:.0f}° (allowed since the last one: {allowed:.0f})"
            )
        return findings


def _differ(names: str, unit: str, mismatch: float | None, allowed: float) -> list[str]:
    if mismatch is None or mismatch <= allowed:
        return []
    return [f"{names} of poses differ by {mismatch:.3g} {unit} (allowed: {allowed:g})"]
