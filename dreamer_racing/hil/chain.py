"""What happens at each tick: poses in, one command out. No clock and no socket in here.

`FlightChain.tick` is a function of what came in at this tick and of the ticks before, so that a recorded flight can be
played through it again: the same file gives the same commands, bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.battery import Battery, BatteryConfig, Reading
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received
from dreamer_racing.hil.progress import GateProgress
from dreamer_racing.hil.reasons import Reason
from dreamer_racing.hil.safety import Safety, SafetyLimits, State, Tick, Verdict
from dreamer_racing.hil.stamping import PoseClock, Stamping, extrapolate
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint

LIFT = 1.4
"""Weights of thrust that the lift off the stand grows to [choice]. It begins at one: a vehicle that is as believed
rises gently, at 0.2 m/s after a third of a second and 2 to 3 cm, and so does a heavier one, later."""

LIFT_TIME = 1.0
"""s in which it grows to that [choice]; `benchmarks/start_of_flight.py` flies it."""

LIFT_MOST = 1.5
"""Weights: what needs more to rise cannot be flown by an actor that was trained on another drone [choice]."""

RISING = 2
"""Poses in a row by which a vehicle must rise before its flyer takes over: one may be wrong."""

START_RATE = 2.0
"""rad/s above which a vehicle has left the start, be it slow still [choice]: racers turn before they move, and an actor
whose memory begins when it is tilted already has never seen such a start. Noise of estimated rates stays below."""


class ChainConfig(NamedTuple):
    """What of a flight is more than its flyer and its track.

    Args:
        limits: Of safety.
        stamping: When poses count as measured.
        latency: s, from a pose's measurement to its arrival at the least.
        laps: After which the flight is over and the vehicle is disarmed; None: when the operator says so.
        arm: Whether it may arm at all.
        battery: What is known of it, where its voltage comes back and counts; None: nobody asks for it.
        lift: Weights of thrust, straight up, that it grows to until the vehicle is seen to rise; 0: the flyer takes off
            by itself.
    """

    limits: SafetyLimits
    stamping: Stamping = Stamping.receive
    latency: float = 0.0
    laps: int | None = None
    arm: bool = False
    battery: BatteryConfig | None = None
    lift: float = LIFT


class Inputs(NamedTuple):
    """What came in at a tick.

    Args:
        time: s, by the loop's clock.
        received: Pose packets since the last tick, oldest first.
        operator: What the operator wants.
        overrun: Deadlines that the tick before missed, as it took longer than its period.
        voltages: Of the battery since the last tick, oldest first.
        dropped: Whether the command of the tick before did not go out.
    """

    time: float
    received: list[Received]
    operator: Operator
    overrun: int
    voltages: Sequence[Reading] = ()
    dropped: bool = False


class Outputs(NamedTuple):
    """What came of a tick.

    Args:
        verdict: State, command and reasons.
        setpoint: What the flyer wanted, or the lift off the stand; None without a pose, or if it is cut anyway.
        pose: For which it was chosen: the newest one, extrapolated to the tick.
        measured: When that was measured, s; not a number without a pose.
        image: What the flyer saw; None if it has no camera, or was not asked.
        target_gate: Index of the gate that comes next.
        passes: Gates passed in this flight.
        render_s: s that drawing the image took.
        act_s: s that the flyer took.
        voltage: V, by which the link is to turn thrust into a throttle; None: as it is set.
    """

    verdict: Verdict
    setpoint: Setpoint | None
    pose: Pose | None
    measured: float
    image: np.ndarray | None
    target_gate: int
    passes: int
    render_s: float
    act_s: float
    voltage: float | None = None


class FlightChain:
    """Pose → image → flyer → safety.

    A flyer's flight begins when its vehicle moves. On the stand it would be shown the first image again and again, and
    its first action would fly for as many ticks as motion takes to be seen, which no episode of training begins with.
    So the vehicle is lifted straight up first, ever harder, and the flyer, which is asked all along, is begun anew when
    it rises. What is not seen to rise is cut after `SafetyLimits.lift_off_time`.

    Args:
        flyer: Who flies.
        track: Where.
        config: The rest.
        camera: Draws what the flyer sees; None if it needs no image.

    Raises:
        ValueError: The lift lifts nothing, or is more than is sensible or safety lets through.

    Attributes:
        progress: Which gates were passed.
        clock: Of the poses.
        safety: Has the last word.
        battery: Its voltage; None if nobody asks for it.
    """

    def __init__(self, flyer: Flyer, track: Track, config: ChainConfig, camera: NoseCamera | None) -> None:
        self.progress = GateProgress(track)
        self.clock = PoseClock(config.stamping, config.latency, config.limits.clock_drift_max)
        self.safety = Safety(config.limits)
        self.battery = None if config.battery is None else Battery(config.battery)
        self._flyer, self._camera, self._config = flyer, camera, config
        drawn = None if camera is None else camera.camera
        self._mismatch = None if flyer.camera in (None, drawn) else f"it sees by {flyer.camera}, drawn is {drawn}"
        self._gates_in_all = None if config.laps is None else config.laps * track.num_gates
        self._newest: Pose | None = None
        self._flying = False  # whether the vehicle has been armed and has left the start
        self._lifting = False  # whether the last tick's setpoint was the lift's
        self._armed_at: float | None = None
        self._rising = 0  # poses in a row by which it rises
        most = min(LIFT_MOST, config.limits.thrust_max / GRAVITY)
        if config.lift and not 1.0 < config.lift <= most:
            raise ValueError(
                f"lift={config.lift:g}: must be more than 1 weight and at most {LIFT_MOST:g}, within "
                f"limits.thrust_max={config.limits.thrust_max:g} m/s²; 0: the flyer takes off by itself."
            )

    def warm_up(self) -> None:
        """Do once what a tick does, before the first one: libraries take their time then."""
        level = np.array([1.0, 0.0, 0.0, 0.0])
        start = np.array(self._config.limits.start_position, float)
        self._choose(Pose(0.0, start, level, np.zeros(3), np.zeros(3)))
        self._flyer.reset()

    def tick(self, inputs: Inputs) -> Outputs:
        """Take in what came, choose, and let safety judge."""
        on_stand = not self._flying  # until the vehicle moves or turns, each tick is the first of the flight
        if on_stand or self._lifting:
            self._flyer.reset()
        if on_stand:
            self.progress.reset()
        for received in inputs.received:
            pose = self.clock.read(received)
            if pose is not None:
                self.progress.update(pose)
                self._newest = pose
                self._rising = self._rising + 1 if pose.linear_velocity[2] > self._config.limits.start_speed else 0
        pose = None if self._newest is None else extrapolate(self._newest, inputs.time)
        finish = self._gates_in_all is not None and len(self.progress.passes) >= self._gates_in_all
        tick = Tick(
            now=inputs.time,
            pose=self._newest,
            pose_age=np.inf if self._newest is None else inputs.time - self._newest.time,
            setpoint=None,
            operator=inputs.operator,
            arm_requested=self._config.arm,
            contract_mismatch=self._mismatch,
            loop_overrun=inputs.overrun,
            finish=finish,
            command_dropped=inputs.dropped,
        )
        findings = self.safety.examine(tick)
        # What is cut anyway does not wait for drawing and choosing.
        setpoint, image, render_s, act_s = self._choose(None if self.safety.cuts(findings) else pose)
        self._lifting = on_stand and bool(self._config.lift) and self._armed_at is not None
        if self._lifting and setpoint is not None:
            setpoint = self._lift(inputs.time)
        verdict = self.safety.judge(tick._replace(setpoint=setpoint), findings)
        armed = verdict.command.armed
        if not armed:
            self._armed_at = None
        elif self._armed_at is None:
            self._armed_at = inputs.time
        self._flying = finish or (armed and (self._flying or self._has_left(verdict)))
        measured = math.nan if self._newest is None else self._newest.time
        target, passes = self.progress.target, len(self.progress.passes)
        voltage = None if self.battery is None else self.battery.update(inputs.time, inputs.voltages)
        return Outputs(verdict, setpoint, pose, measured, image, target, passes, render_s, act_s, voltage)

    def _lift(self, now: float) -> Setpoint:
        """Return the lift at a tick: one weight when its first command is let through, and then ever more."""
        assert self._armed_at is not None
        share = (now - self._armed_at - self._config.limits.arm_time) / LIFT_TIME
        weights = 1.0 + (self._config.lift - 1.0) * min(max(share, 0.0), 1.0)
        return Setpoint(weights * GRAVITY, np.zeros(3))

    def _has_left(self, verdict: Verdict) -> bool:
        """Whether the vehicle has left the start: rises, where it is lifted, and is told to do so."""
        if self._newest is None:
            return False
        if self._config.lift:
            lifted = verdict.state is State.FLYING and Reason.ARMING not in verdict.reasons
            return lifted and self._rising >= RISING
        speed, rate = (float(np.linalg.norm(part)) for part in (self._newest.linear_velocity, self._newest.body_rates))
        return speed > self._config.limits.start_speed or rate > START_RATE

    def _choose(self, pose: Pose | None) -> tuple[Setpoint | None, np.ndarray | None, float, float]:
        """Return setpoint and image, and how long drawing and choosing took, s."""
        if pose is None:
            return None, None, 0.0, 0.0
        start = time.perf_counter()
        image = None if self._camera is None else self._camera.see(pose)
        drawn = time.perf_counter()
        setpoint = self._flyer.act(pose, image, self.progress.target)
        return setpoint, image, drawn - start, time.perf_counter() - drawn

    def prepare(self) -> None:
        """Do what the next tick needs and can be done before it, once the command of this one is out."""
        self._flyer.prepare()

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()


def describe_inputs(inputs: Inputs) -> dict[str, Any]:
    """Return what came in as JSON values, from which `read_inputs` makes it again."""
    return {
        "time": inputs.time,
        "received": [[received.time, *_numbers(received.packet)] for received in inputs.received],
        "operator": list(inputs.operator),
        "overrun": inputs.overrun,
        "voltages": [list(reading) for reading in inputs.voltages],
        "dropped": inputs.dropped,
    }


def read_inputs(message: dict[str, Any]) -> Inputs:
    """Return what came in from what `describe_inputs` made of it; flights of old say less."""
    received = []
    for arrived, sequence, stamp, *numbers in message["received"]:
        values = np.array(numbers)
        packet = PosePacket(sequence, stamp, values[:3], values[3:7], values[7:10], values[10:])
        received.append(Received(arrived, packet))
    voltages = [Reading(*reading) for reading in message.get("voltages", ())]
    operator, dropped = Operator(*message["operator"]), message.get("dropped", False)
    overrun = int(message["overrun"])  # flights of old say whether
    return Inputs(message["time"], received, operator, overrun, voltages, dropped)


def describe_outputs(outputs: Outputs) -> dict[str, Any]:
    """Return what came of a tick as JSON values, but for how long it took: the same again when it is played back."""
    command = outputs.verdict.command
    return {
        "state": outputs.verdict.state.value,
        "reasons": [reason.value for reason in outputs.verdict.reasons],
        "setpoint": None if outputs.setpoint is None else _flat(outputs.setpoint),
        "command": [command.armed, *_flat(command.setpoint)],
        "pose": None if outputs.pose is None else [number for part in outputs.pose[1:] for number in part.tolist()],
        "target_gate": outputs.target_gate,
        "passes": outputs.passes,
        "voltage": outputs.voltage,
    }


def _numbers(packet: PosePacket) -> list[float]:
    return [packet.sequence, packet.stamp, *(number for vector in packet[2:] for number in vector.tolist())]


def _flat(setpoint: Setpoint) -> list[float]:
    return [float(setpoint.collective_thrust), *(float(rate) for rate in setpoint.body_rates)]
