"""All thresholds of `safety.Safety`, distances, speeds, ages and durations, and the reasons that it gives.

Unless noted otherwise, the numbers are this project's own choice, for a track of some metres in a room.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, fields
from typing import Any, Self

from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.vehicle import GRAVITY
from dreamer_racing.settings import Range, check_settings, setting

Vector = tuple[float, ...]

BELOW_FLOOR = 0.2
"""m below a track's floor where its fence ends [choice]: a vehicle on the floor may be measured a little lower."""

_SECONDS, _TOLERANCE, _DEGREES = Range(0, 1, open_below=True), Range(0, 10), Range(0, 180, open_below=True)
_MOST = Range(0, 1e4, open_below=True)


@dataclass(frozen=True, kw_only=True)
class SafetyLimits:
    """All thresholds of `Safety`. Fence and start position have no default."""

    fence_low: Vector  # (3,) m, world: lower corner of the box that the vehicle must not leave
    fence_high: Vector  # (3,) m, world: its upper corner
    start_position: Vector  # (3,) m, world: where the vehicle stands before a flight
    start_yaw_degrees: float = setting(0.0, Range(-360, 360))  # its heading then, from world x, positive to the left
    start_box: float = setting(0.3, _TOLERANCE)  # m, from the start along each axis, within which it may arm
    start_yaw_tolerance_degrees: float = setting(15.0, _DEGREES)  # difference from that heading within which it may arm
    start_tilt_degrees: float = setting(10.0, _DEGREES)  # tilt from level within which it may arm
    start_speed: float = setting(0.2, _TOLERANCE)  # m/s above which it does not arm, or rises or takes off
    # s for which the enable must be released before it counts: a flicker starts no flight
    release_time: float = setting(0.2, Range(0, 10))
    # s after arming in which no thrust is sent: Betaflight arms at low throttle only
    arm_time: float = setting(0.1, _SECONDS)
    hold_after: float = setting(0.050, _SECONDS)  # s, age of the newest pose above which safety holds
    # s above which safety cuts, for the age of the newest pose, the time in which poses repeat, and the time without a
    # setpoint or without a command accepted by the link
    cut_after: float = setting(0.150, _SECONDS)
    # s for which the flight controller may report in flight that it does not follow commands; it is asked with every
    # fifth command
    refusal_time: float = setting(0.75, _SECONDS)
    # s from tick to tick above which the clock has jumped, or the loop has stalled, see `hil.watchdog`
    tick_max: float = setting(0.200, _SECONDS)
    # deadlines that the loop may miss within `overrun_window`; a long tick misses several
    overruns_max: int = setting(3, Range(0, 1000))
    overrun_window: float = setting(1.0, Range(0, 60, open_below=True))  # s
    # ppm by which the clock of a pose sender may run slower than ours, see `stamping.PoseClock`
    clock_drift_max: float = setting(200.0, Range(0, 1e5))
    # m/s. On Figure 8 in simulation the included agent reaches 12.4, the scripted pilot 12.7
    speed_max: float = setting(15.0, _MOST)
    # m by which two poses may be further apart than `speed_max` allows in the time between them
    jump_tolerance: float = setting(0.1, _TOLERANCE)
    turn_rate_max: float = setting(15.0, _MOST)  # rad/s about any axis, fastest possible turn between two poses
    # deg by which two attitudes may be further apart than `turn_rate_max` allows
    turn_tolerance_degrees: float = setting(20.0, _DEGREES)
    # m/s by which reported velocities may differ from those of the positions
    velocity_tolerance: float = setting(4.0, _MOST)
    # rad/s by which reported body rates may differ from those of the attitudes, as long as no two poses are more than
    # `hold_after` apart
    rate_tolerance: float = setting(5.0, _MOST)
    velocity_window: float = setting(0.075, _SECONDS)  # s over which both are compared, see `motion.Odometer`
    tilt_max_degrees: float = setting(100.0, _DEGREES)  # tilt from level that may be exceeded for `tilt_time` only
    tilt_time: float = setting(0.2, _TOLERANCE)  # s
    # s without moving (`safety.MOVED`) after which a vehicle that has flown counts as crashed: racers never hover
    still_time: float = setting(1.0, Range(0, 3600, open_below=True))
    # s after arming by which it must have moved: a vehicle that is held fast must stop its motors
    lift_off_time: float = setting(3.0, Range(0, 3600, open_below=True))
    # s of a lift off the stand by which a rise must have been seen: until then the lift is open-loop
    lift_time: float = setting(0.9, Range(0.5, 2.0))
    thrust_min: float = setting(0.0, Range(0, 100))  # m/s², least collective thrust in flight
    thrust_max: float = setting(30.0, Range(0, 1000, open_below=True))  # m/s², largest collective thrust
    # m/s³, how fast thrust may change; by default the included actors may use its full range in 1/25 s
    thrust_slew: float = setting(700.0, _MOST)
    rate_max: Vector = (10.0, 10.0, 4.0)  # (3,) rad/s, largest body rates about x, y, z: those of the included actors
    rate_slew: float = setting(500.0, _MOST)  # rad/s², how fast each body rate may change; default as for `thrust_slew`

    @classmethod
    def of_track(cls, track: Track, **changed: Any) -> Self:
        """Return the limits for a track: its bounds, lowered by `BELOW_FLOOR`, and its start.

        Raises:
            ValueError: A name in ``changed`` is no limit.
        """
        names = {field.name for field in fields(cls)}
        if unknown := sorted(set(changed) - names):
            raise ValueError(f"limits.{unknown[0]}: no such limit; must be one of {', '.join(sorted(names))}.")
        x, y, z = track.bounds_low
        own: dict[str, Any] = {
            "fence_low": (x, y, z - BELOW_FLOOR),
            "fence_high": track.bounds_high,
            "start_position": track.start_position,
            "start_yaw_degrees": (track.start_yaw_degrees + 180.0) % 360.0 - 180.0,
        }
        return cls(**{**own, **{name: tuple(v) if isinstance(v, list) else v for name, v in changed.items()}})

    def reach(self, elapsed: float) -> float:
        """Return the largest distance, m, allowed between two poses that are ``elapsed`` s apart."""
        return self.speed_max * elapsed + self.jump_tolerance

    def check(self) -> None:
        """Refuse limits that give no protection, or that make flight impossible.

        Raises:
            ValueError: The message gives the limit, its value, and what is allowed.
        """
        check_settings(self, "limits.")
        for name in ("fence_low", "fence_high", "start_position", "rate_max"):
            if to_numbers(getattr(self, name), 3) is None:
                raise ValueError(f"limits.{name}={getattr(self, name)}: must be three finite numbers.")
        for wrong, message in (
            (not self.hold_after < self.cut_after, f"hold_after={self.hold_after}: must be below cut_after"),
            (
                not is_within(self.start_position, self.fence_low, self.fence_high),
                "start_position: must be in the fence",
            ),
            (min(self.rate_max) <= 0.0, f"rate_max={self.rate_max}: must be above 0 about each axis"),
            (
                not max(self.rate_max) <= self.turn_rate_max,
                f"turn_rate_max={self.turn_rate_max}: must be at least the largest of rate_max={self.rate_max}",
            ),
            (not self.thrust_min < GRAVITY, f"thrust_min={self.thrust_min}: must be below {GRAVITY} (hover)"),
            (not self.thrust_max > GRAVITY, f"thrust_max={self.thrust_max}: must be above {GRAVITY} (hover)"),
        ):
            if wrong:
                raise ValueError(f"limits.{message}.")


class Reason(enum.Enum):
    """Why a vehicle is in its state, or does not arm."""

    KILL = "kill"
    NO_ENABLE = "no enable"
    NOT_RELEASED = "enable not released before"
    NOT_REQUESTED = "arming not requested"
    CONTRACT = "contract"
    CLOCK = "clock"
    OVERRUNS = "overruns"
    LINK_LOST = "link lost"
    REFUSED = "refused"
    NOT_FINITE = "pose not finite"
    POSE_JUMP = "pose jump"
    ATTITUDE_JUMP = "attitude jump"
    POSE_CONTRADICTION = "pose contradiction"
    POSE_FROZEN = "pose frozen"
    POSE_STALE = "pose stale"
    POSE_LOST = "pose lost"
    GEOFENCE = "geofence"
    SPEED = "speed"
    TILT = "tilt"
    STRANDED = "stranded"
    NO_SETPOINT = "no setpoint"
    SETPOINT_LOST = "setpoint lost"
    OUTSIDE_START_BOX = "outside start box"
    TURNED_AT_START = "turned at start"
    TILTED_AT_START = "tilted at start"
    MOVING_AT_START = "moving at start"
    ARMING = "arming"
    FINISHED = "finished"


Findings = dict[Reason, str]  # reasons found at a tick, each with a message for a person


def to_number(value: Any) -> float:
    """Return a value as a float, NaN if it is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def to_numbers(values: Any, count: int) -> Vector | None:
    """Return ``count`` finite numbers; None if the values are not that."""
    try:
        numbers = tuple(to_number(value) for value in values)
    except TypeError:
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


def is_within(point: Vector, low: Vector, high: Vector) -> bool:
    """Return whether a point is inside a box, or on its faces."""
    return all(least <= value <= most for value, least, most in zip(point, low, high, strict=True))
