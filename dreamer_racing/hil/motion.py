"""Plausibility checks of poses for `safety.Safety`: could a vehicle have moved from one pose to the next?

The odometers check whether the velocities and body rates of a source agree with its own positions and attitudes.
"""

from __future__ import annotations

import math
from collections import deque
from typing import ClassVar, NamedTuple

from dreamer_racing.hil.attitude import conjugate, product
from dreamer_racing.hil.safety_limits import Findings, Reason, SafetyLimits, Vector, to_number, to_numbers
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


class _Mark(NamedTuple):
    """A pose's position or attitude, its reported velocity or body rates, and the integral of those so far."""

    time: float
    place: Vector
    rate: Vector
    integral: Vector


class Odometer:
    """Compares reported velocities, integrated by trapezoids over a time window, with the change of position.

    Args:
        window: Least length of the window, s; it is up to one pose interval longer.
        gap: s between two poses beyond which the comparison starts anew.

    Example:
        >>> odometer = Odometer(window=0.0625)
        >>> odometer.mismatch(0.0, (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)) is None
        True
        >>> odometer.mismatch(0.0625, (0.25, 0.0, 0.0), (5.0, 0.0, 0.0))  # it went at 4 m/s
        1.0
    """

    _start: ClassVar[Vector] = (0.0, 0.0, 0.0)

    def __init__(self, window: float, gap: float = math.inf) -> None:
        self._window, self._gap = window, gap
        self._marks: deque[_Mark] = deque()

    def mismatch(self, time: float, place: Vector, rate: Vector) -> float | None:
        """Add a pose newer than the last: its time, s, position, m, and reported velocity, m/s.

        Returns:
            The difference of the mean velocities over the window, m/s; None until the poses since the first one, or
            since a gap, span it.
        """
        marks = self._marks
        last = marks[-1] if marks else None
        if last is None or time - last.time > self._gap:
            marks.clear()
            integral = self._start
        else:
            half = 0.5 * (time - last.time)
            step = tuple(half * (old + new) for old, new in zip(last.rate, rate, strict=True))
            integral = self._integrate(last.integral, step)
        marks.append(_Mark(time, place, rate, integral))
        while len(marks) > 2 and time - marks[1].time >= self._window:
            marks.popleft()
        first, elapsed = marks[0], time - marks[0].time
        if elapsed < self._window or elapsed <= 0.0:
            return None
        return self._distance(self._change(first.place, place), self._change(first.integral, integral)) / elapsed

    @staticmethod
    def _integrate(integral: Vector, step: Vector) -> Vector:
        """Return the integral after one more step."""
        return tuple(here + more for here, more in zip(integral, step, strict=True))

    @staticmethod
    def _change(first: Vector, last: Vector) -> Vector:
        """Return the displacement from one place to another."""
        return tuple(there - here for here, there in zip(first, last, strict=True))

    @staticmethod
    def _distance(travelled: Vector, integrated: Vector) -> float:
        """Return the distance between two displacements."""
        return math.dist(travelled, integrated)


class TurnOdometer(Odometer):
    """An `Odometer` for body rates, rad/s in the body frame, and attitudes, wxyz of unit length.

    Rates about changing axes do not add up, so rotations are composed; the mismatch is the angle between the two
    resulting rotations, per time.

    Example:
        >>> odometer = TurnOdometer(window=0.0625)
        >>> odometer.mismatch(0.0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 8.0)) is None
        True
        >>> round(odometer.mismatch(0.0625, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 8.0)), 6)  # it did not turn
        8.0
    """

    _start: ClassVar[Vector] = (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def _integrate(integral: Vector, step: Vector) -> Vector:
        angle = math.hypot(*step)
        if not math.isfinite(angle):
            return 4 * (math.nan,)
        scale = math.sin(0.5 * angle) / angle if angle else 0.0
        return product(integral, (math.cos(0.5 * angle), *(scale * part for part in step)))

    @staticmethod
    def _change(first: Vector, last: Vector) -> Vector:
        turned = product(conjugate(first), last)
        return turned if turned[0] >= 0.0 else tuple(-part for part in turned)  # both are the same rotation

    @staticmethod
    def _distance(travelled: Vector, integrated: Vector) -> float:
        distance = math.dist(travelled, integrated)
        return 4.0 * math.asin(min(1.0, 0.5 * distance)) if math.isfinite(distance) else math.inf
