"""The last check before a vehicle: whether its motors may turn, and which command is sent.

| `State` | what is sent | ends with |
|---|---|---|
| DISARMED | at rest | a new enable of the operator, and no finding against arming → FLYING |
| FLYING | the actor's setpoint, or the lift, within limits | pose or setpoint stale → HOLD; other findings → CUT |
| HOLD | level hover thrust, zero body rates | both fresh again → FLYING; lost, or any other finding → CUT |
| CUT | at rest | as DISARMED: it is latched until the operator starts a new flight |

`Tick.finish` disarms from FLYING and HOLD; the operator's kill leads to CUT from every state.
There is no clock and no I/O in here: the same ticks give the same verdicts, so a recorded flight can be replayed.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.motion import Motion, read_pose
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.safety_limits import (
    Findings,
    Reason,
    SafetyLimits,
    Vector,
    is_within,
    to_number,
    to_numbers,
)
from dreamer_racing.hil.vehicle import Command, Pose, Setpoint, at_rest, hover


class State(enum.Enum):
    """What a vehicle may do."""

    DISARMED = "disarmed"
    FLYING = "flying"
    HOLD = "hold"
    CUT = "cut"


_HOLDING = {Reason.POSE_STALE, Reason.NO_SETPOINT}
_OVER = "the flight is over"
MOVED = 0.1
"""m that a vehicle must be away from where it was to count as moving [choice]. Speeds would not do: estimated from
poses that are off by 1 mm, 200 a second, they exceed 0.2 m/s in 15 % of the ticks of a vehicle at rest."""
TIPPING = 2.0
"""Multiple of `SafetyLimits.start_tilt_degrees` above which a lifted vehicle counts as tipping over [choice]."""
# A hold sends zero rates and does not level: in its 0.1 s levelling would save some decimetres a second, and it would
# need the attitude, which is no longer known: after 0.05 s at 10 rad/s it is off by 30°.
_IDLE: Vector = (0.0, 0.0, 0.0, 0.0)
_HOVER: Vector = (hover().collective_thrust, 0.0, 0.0, 0.0)


class Tick(NamedTuple):
    """Safety's inputs at a tick of the loop."""

    now: float  # s, `time.monotonic`
    pose: Pose | None  # the newest measured pose; None if there is none
    pose_age: float  # s since it was measured. The time since `Pose.time` counts if it is longer
    setpoint: Setpoint | None  # the actor's setpoint; None if it gave none
    operator: Operator | None  # what the operator wants; None counts as no enable
    arm_requested: bool  # whether the program was started with `arm=true`
    contract_mismatch: str | None = None  # what of the actor's contract does not fit the vehicle; None if it fits
    loop_overrun: int = 0  # deadlines missed because the tick before took longer than its period
    finish: bool = False  # whether the flight is over
    command_dropped: bool = False  # whether the command of the tick before was not sent
    # why the flight controller does not follow commands, or would not if armed; empty if no reason is known
    refusal: str = ""
    # setpoint sent instead of the actor's, if that is usable, until the vehicle is seen to rise
    lift: Setpoint | None = None


class Verdict(NamedTuple):
    """The result of a tick."""

    state: State  # from this tick on
    command: Command  # to be sent now
    reasons: tuple[Reason, ...]  # why it cut, why it holds, or why it does not arm
    words: tuple[str, ...]  # a message for a person for each reason


class Safety:
    """Decides at each tick of the loop whether motors may turn and what is sent; it never raises after construction.

    Attributes:
        state: The present state.

    Raises:
        ValueError: The limits are invalid; see `SafetyLimits.check`.

    Example:
        >>> limits = SafetyLimits(fence_low=(-9, -8, -1), fence_high=(9, 8, 5), start_position=(0, 0, 0))
        >>> verdict = Safety(limits).step(Tick(0.0, None, 0.0, None, Operator(enable=False, kill=False), True))
        >>> verdict.state, verdict.command.armed, verdict.words[0]
        (<State.DISARMED: 'disarmed'>, False, 'the operator does not give the enable')
    """

    def __init__(self, limits: SafetyLimits) -> None:
        limits.check()
        self.limits = limits
        self.state = State.DISARMED
        self._now, self._elapsed = math.nan, 0.0
        self._overruns: deque[float] = deque(maxlen=int(limits.overruns_max) + 1)
        self._least: Vector = (float(limits.thrust_min), 0.0, 0.0, 0.0)  # thrust and body rates
        self._sent: Vector = _IDLE
        self._place: Vector | None = None  # where it was when it was last seen to move, or armed
        self._reset_history()

    @property
    def armed(self) -> bool:
        """Whether motors may turn."""
        return self.state in (State.FLYING, State.HOLD)

    def step(self, tick: Tick) -> Verdict:
        """Return the verdict on a tick."""
        return self.judge(tick, self.examine(tick))

    def examine(self, tick: Tick) -> Findings:
        """Check all of a tick but its setpoint: the first half of `step`, before the actor chooses."""
        findings = self._check_clock(tick) | self._check_people(tick) | self._check_loop(tick)
        return findings | self._take_pose(tick) | self._check_flight() | self._check_lift(tick)

    def cuts(self, findings: Findings) -> bool:
        """Return whether the findings cut an armed vehicle, whatever the actor would choose."""
        return self.armed and bool(findings.keys() - _HOLDING)

    def judge(self, tick: Tick, findings: Findings) -> Verdict:
        """Return the verdict on a tick from its findings: the second half of `step`."""
        if self.cuts(findings):
            self.state = State.CUT
        elif self.armed:
            findings |= self._check_setpoint(tick)
            self._continue_flight(findings, tick.finish)
        else:
            findings |= self._check_start(tick)
            self._maybe_arm(findings)
        if tick.operator is not None and tick.operator.enable:
            self._ready = False
        if self._arming:
            findings[Reason.ARMING] = f"armed: no thrust for {self.limits.arm_time:g} s"
        return Verdict(self.state, self._command(tick), tuple(findings), tuple(findings.values()))

    @property
    def sends_from(self) -> float:
        """When the time without thrust after arming ends, s; of the last flight if not armed."""
        return self._armed_at + self.limits.arm_time

    @property
    def sends_setpoint(self) -> bool:
        """Whether the last tick sent the wanted setpoint: neither arming nor holding."""
        return self.state is State.FLYING and not self._arming

    @property
    def _arming(self) -> bool:
        return self.armed and self._now - self._armed_at < self.limits.arm_time

    def _continue_flight(self, findings: Findings, finish: bool) -> None:
        if self.cuts(findings):
            self.state = State.CUT
        elif finish:
            self.state = State.DISARMED
            findings[Reason.FINISHED] = _OVER
        else:
            self.state = State.HOLD if findings else State.FLYING

    def _maybe_arm(self, findings: Findings) -> None:
        if Reason.KILL in findings:
            self.state = State.CUT
        elif not findings:
            self.state = State.FLYING
            self._armed_at = self._wanted_at = self._now
            self._left_at = self._first_motion_at = math.inf
            self._place = None

    def _command(self, tick: Tick) -> Command:
        """Return the command to send: the wanted setpoint, limited in value and in rate of change."""
        if not self.armed:
            self._sent = _IDLE
            return at_rest()
        wanted: Vector | None = _read_setpoint(tick.setpoint)
        if self._arming:  # flight controllers arm at zero throttle only, whatever limits.thrust_min is
            self._sent = _IDLE
            return Command(True, Setpoint(0.0, np.zeros(3)))
        if self.state is State.HOLD or wanted is None:
            wanted = _HOVER
        elif tick.lift is not None:
            wanted = _read_setpoint(tick.lift) or _HOVER
        limits = self.limits
        low = self._least[0], *(-rate for rate in limits.rate_max)
        high = limits.thrust_max, *limits.rate_max
        steps = (slew * self._elapsed for slew in (limits.thrust_slew, *3 * (limits.rate_slew,)))
        self._sent = tuple(
            _clip(_clip(want, *bounds), sent - step, sent + step)
            for want, sent, step, *bounds in zip(wanted, self._sent, steps, low, high, strict=True)
        )
        return Command(True, Setpoint(self._sent[0], np.array(self._sent[1:])))

    def _reset_history(self) -> None:
        """Reset all that was measured by a clock that has jumped or only just started."""
        self._motion = Motion(self.limits)
        self._measured_at = -math.inf
        self._overruns.clear()
        self._released_at: float | None = None
        self._ready = False  # the enable was released for long enough, and has not been given since
        self._upright_at = self._wanted_at = self._armed_at = self._delivered_at = self._accepted_at = self._now
        # when in this flight its position was first seen to change, and its position or its speed
        self._left_at = self._first_motion_at = math.inf
        self._moved_at = -math.inf  # when it was last seen to move
        self._place = None

    def _check_clock(self, tick: Tick) -> Findings:
        now = to_number(tick.now)
        step = now - self._now  # NaN at the first tick
        self._now = now
        forwards = 0.0 <= step <= self.limits.tick_max
        self._elapsed = step if forwards else 0.0
        if not forwards:
            self._reset_history()
        if math.isfinite(now) and (forwards or math.isnan(step)):
            return {}
        return {Reason.CLOCK: f"the clock moved by {step:g} s from tick to tick (allowed: {self.limits.tick_max:g})"}

    def _check_people(self, tick: Tick) -> Findings:
        """Check operator, arm request and contract, and note for how long the enable has been released."""
        operator = tick.operator if tick.operator is not None else Operator(enable=False, kill=False)
        findings: Findings = {}
        if operator.kill:
            findings[Reason.KILL] = "the operator killed the flight"
        if not operator.enable:
            findings[Reason.NO_ENABLE] = "the operator does not give the enable"
        if operator.kill or operator.enable:
            self._released_at = None
        elif self._released_at is None:
            self._released_at = self._now
        if operator.kill:
            self._ready = False
        elif self._released_at is not None:
            self._ready = self._now - self._released_at >= self.limits.release_time
        if not tick.arm_requested:
            findings[Reason.NOT_REQUESTED] = "arming was not requested: start with arm=true"
        if tick.contract_mismatch is not None:
            findings[Reason.CONTRACT] = f"the actor's contract does not fit: {tick.contract_mismatch}"
        return findings

    def _check_loop(self, tick: Tick) -> Findings:
        """Check whether the loop meets its deadlines, and whether link and flight controller accept its commands."""
        limits, overruns = self.limits, self._overruns
        findings: Findings = {}
        overruns.extend([self._now] * tick.loop_overrun)
        if len(overruns) == overruns.maxlen and self._now - overruns[0] <= limits.overrun_window:
            findings[Reason.OVERRUNS] = (
                f"the loop missed {len(overruns)} deadlines within {limits.overrun_window:g} s "
                f"(allowed: {limits.overruns_max})"
            )
        if not tick.command_dropped:
            self._delivered_at = self._now
        silent = self._now - self._delivered_at
        if silent > limits.cut_after:
            findings[Reason.LINK_LOST] = f"the link has accepted no command for {silent:.3g} s"
        if not tick.refusal:
            self._accepted_at = self._now
        elif not self.armed or self._now - max(self._accepted_at, self._armed_at) > limits.refusal_time:
            findings[Reason.REFUSED] = f"the flight controller refuses: {tick.refusal}"
        return findings

    def _take_pose(self, tick: Tick) -> Findings:
        """Check a pose that is newer than the last; an older one, or one from the future, is ignored."""
        if tick.pose is None:
            return {}
        seen, last = read_pose(tick.pose), self._motion.newest
        if seen is None:
            return {Reason.NOT_FINITE: "the pose has numbers that are not finite, or an invalid attitude"}
        if seen.time > self._now + self.limits.hold_after or (last is not None and seen.time <= last.time):
            return {}
        age = to_number(tick.pose_age)
        self._measured_at = min(seen.time, self._now - age) if math.isfinite(age) else -math.inf
        return self._motion.check_pose(seen)

    def _check_flight(self) -> Findings:
        limits, seen = self.limits, self._motion.newest
        age = self._now - self._measured_at
        findings: Findings = {}
        if age > limits.hold_after:
            reason = Reason.POSE_LOST if age > limits.cut_after else Reason.POSE_STALE
            known = f"the newest pose is {age:.3g} s old (allowed: {limits.hold_after:g})"
            findings[reason] = known if seen is not None else "there is no pose"
        if seen is None:
            self._upright_at = self._now
            return findings
        if not is_within(seen.position, limits.fence_low, limits.fence_high):
            at = ", ".join(f"{value:.3g}" for value in seen.position)
            findings[Reason.GEOFENCE] = f"at ({at}) m it is outside the fence"
        if seen.speed > limits.speed_max:
            findings[Reason.SPEED] = f"it moves at {seen.speed:.3g} m/s (allowed: {limits.speed_max:g})"
        if seen.tilt_degrees <= limits.tilt_max_degrees:
            self._upright_at = self._now
        elif self._now - self._upright_at > limits.tilt_time:
            findings[Reason.TILT] = f"it is tilted by {seen.tilt_degrees:.0f}° (allowed: {limits.tilt_max_degrees:g})"
        has_moved = self._place is not None and math.dist(seen.position, self._place) > MOVED
        if has_moved:
            self._moved_at = self._now
            self._left_at = min(self._left_at, self._now)
        if has_moved or seen.speed > limits.start_speed:
            self._first_motion_at = min(self._first_motion_at, self._now)
        if has_moved or self._place is None:
            self._place = seen.position
        return findings | self._check_stillness()

    def _check_stillness(self) -> Findings:
        """Find poses that repeat exactly in flight, and a vehicle that is held fast, or lies somewhere."""
        limits, motion, now = self.limits, self._motion, self._now
        if not self.armed:
            return {}
        findings: Findings = {}
        frozen = now - max(motion.changed_at, self._first_motion_at)
        if motion.repeats and frozen > limits.cut_after:
            findings[Reason.POSE_FROZEN] = (
                f"poses have been the same for {frozen:.3g} s (allowed: {limits.cut_after:g})"
            )
        has_left = math.isfinite(self._left_at)
        if now - self._moved_at > limits.still_time if has_left else now - self._armed_at > limits.lift_off_time:
            findings[Reason.STRANDED] = "it does not move: is it stuck, or lying on the ground?"
        return findings

    def _check_lift(self, tick: Tick) -> Findings:
        """Find a lifted vehicle that tips over, or does not rise; the lift itself is open-loop."""
        limits, seen = self.limits, self._motion.newest
        if tick.lift is None or not self.armed:
            return {}
        findings: Findings = {}
        if seen is not None and seen.tilt_degrees > TIPPING * limits.start_tilt_degrees:
            findings[Reason.TILT] = f"it is tilted by {seen.tilt_degrees:.0f}° during the lift"
        if self._now - self.sends_from > limits.lift_time:
            findings[Reason.STRANDED] = (
                f"no rise was measured within limits.lift_time={limits.lift_time:g} s: it is stuck, or heavier or "
                "weaker than assumed, or its poses do not follow it"
            )
        return findings

    def _check_setpoint(self, tick: Tick) -> Findings:
        if self._arming or _read_setpoint(tick.setpoint) is not None:
            self._wanted_at = self._now
            return {}
        missing = self._now - self._wanted_at
        reason = Reason.SETPOINT_LOST if missing > self.limits.cut_after else Reason.NO_SETPOINT
        return {reason: f"the actor has given no usable setpoint for {missing:.3g} s"}

    def _check_start(self, tick: Tick) -> Findings:
        """Return further findings against arming: an enable not released, a finished flight, a wrong start pose."""
        limits, seen = self.limits, self._motion.newest
        findings: Findings = {}
        if tick.finish:
            findings[Reason.FINISHED] = _OVER
        if not self._ready and tick.operator is not None and tick.operator.enable:
            findings[Reason.NOT_RELEASED] = f"release the enable for {limits.release_time:g} s and give it again"
        if seen is None:
            return findings
        away = max(abs(here - start) for here, start in zip(seen.position, limits.start_position, strict=True))
        turned = abs((seen.yaw_degrees - limits.start_yaw_degrees + 180.0) % 360.0 - 180.0)
        for reason, value, limit, text in (
            (Reason.OUTSIDE_START_BOX, away, limits.start_box, "it is {:.3g} m from the start along an axis"),
            (Reason.TURNED_AT_START, turned, limits.start_yaw_tolerance_degrees, "its yaw is {:.0f}° from the start's"),
            (Reason.TILTED_AT_START, seen.tilt_degrees, limits.start_tilt_degrees, "it stands tilted by {:.0f}°"),
            (Reason.MOVING_AT_START, seen.speed, limits.start_speed, "it moves at {:.3g} m/s"),
        ):
            if value > limit:
                findings[reason] = f"{text.format(value)} (allowed: {limit:g})"
        return findings


def _read_setpoint(setpoint: Setpoint | None) -> Vector | None:
    """Return thrust and body rates in plain numbers; None if there are none, or one is not finite."""
    if setpoint is None:
        return None
    thrust, rates = to_number(setpoint.collective_thrust), to_numbers(setpoint.body_rates, 3)
    return (thrust, *rates) if rates is not None and math.isfinite(thrust) else None


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
