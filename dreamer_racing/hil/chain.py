"""What happens at each tick: poses in, one command out. No clock and no socket in here.

`FlightChain.tick` is a function of what came in at this tick and of the ticks before, so that a recorded flight can be
played through it again: the same file gives the same commands, bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dreamer_racing.envs.simulator.scene import frame_interval
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.battery import Battery, BatteryConfig, Reading
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.imu import ImuReading, unlike_rest
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received
from dreamer_racing.hil.progress import GateProgress
from dreamer_racing.hil.safety import Safety, SafetyLimits, Tick, Verdict
from dreamer_racing.hil.stamping import PoseClock, Stamping, extrapolate
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint
from dreamer_racing.settings import Range, check_setting

LIFT = 1.35
"""Weights of thrust that the lift off the stand grows to within `SafetyLimits.lift_time` [choice]. It begins at one: a
vehicle that is as believed rises gently, at 0.2 m/s after a third of a second and 2 to 3 cm, a heavier one later."""

LIFT_LEAST, LIFT_MOST = 1.1, 1.5
"""Weights: less would not be seen in time, and what needs more is another drone than its actor's [choice]."""

RISE_TIME = 0.04
"""s for which all poses must show that a vehicle rises before its flyer takes over [choice]: the velocity that follows
from a jump of 0.1 m, the largest that safety lets pass, has decayed by then (`PoseConfig.smoothing`)."""

RISE_HEIGHT = 0.01
"""m above its stand at which it must be by then [choice]."""

START_RATE = 2.0
"""rad/s above which a vehicle has left the start, be it slow still [choice]: racers turn before they move, and an actor
whose memory begins when it is tilted already has never seen such a start. Noise of estimated rates stays below."""


LATENCY = Range(0, 1)
"""s, of poses."""


class ChainConfig(NamedTuple):
    """What of a flight is more than its flyer and its track.

    Args:
        limits: Of safety.
        stamping: When poses count as measured.
        latency: s, from a pose's measurement to its arrival at the least.
        laps: After which the flight is over and the vehicle is disarmed; None: when the operator says so.
        arm: Whether it may arm at all.
        battery: What is known of it, where its voltage comes back and counts; None: nobody asks for it.
        lift: Weights of thrust, straight up, that are sent at the most until the vehicle is seen to rise; 0: the flyer
            takes off by itself.
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
        imu: What the IMU told since the last tick, oldest first; asked for only if the flyer needs it.
        refusal: Of the flight controller, see `Tick`.
    """

    time: float
    received: list[Received]
    operator: Operator
    overrun: int
    voltages: Sequence[Reading] = ()
    dropped: bool = False
    imu: Sequence[ImuReading] = ()
    refusal: str = ""


class Outputs(NamedTuple):
    """What came of a tick.

    Args:
        verdict: State, command and reasons.
        setpoint: What the flyer wanted, be it lifted instead; None without a pose, or if it is cut anyway.
        pose: For which it was chosen: the newest one, extrapolated to the tick.
        measured: When that was measured, s; not a number without a pose.
        image: What the flyer saw; None if it has no camera, or was not asked.
        target_gate: Index of the gate that comes next.
        passes: Gates passed in this flight.
        render_s: s that drawing the image took; 0 where that of a tick before is still shown.
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
    it rises. What is not seen to rise is cut after `SafetyLimits.lift_time`.

    Args:
        flyer: Who flies.
        track: Where.
        config: The rest.
        camera: Draws what the flyer sees; None if it needs no image.

    Raises:
        ValueError: The latency is no time, the camera's frames do not fit the flyer's rate, or the lift lifts nothing,
            or is more than is sensible or safety lets through.

    Attributes:
        progress: Which gates were passed.
        clock: Of the poses.
        safety: Has the last word.
        battery: Its voltage; None if nobody asks for it.
        feels: Whether the flyer needs what the IMU tells.
    """

    def __init__(self, flyer: Flyer, track: Track, config: ChainConfig, camera: NoseCamera | None) -> None:
        check_setting("latency", config.latency, LATENCY)
        self.progress = GateProgress(track, config.limits)
        self.clock = PoseClock(config.stamping, config.latency, config.limits.clock_drift_max)
        self.safety = Safety(config.limits)
        self.battery = None if config.battery is None else Battery(config.battery)
        self._flyer, self._camera, self._config = flyer, camera, config
        self._frame_interval = 1 if flyer.camera is None else frame_interval(flyer.camera, flyer.rate)
        self.feels = bool(getattr(flyer, "feels", False))
        self._felt: ImuReading | None = None  # the newest
        self._image: np.ndarray | None = None  # that is shown; None before the first of a flight
        self._shown = 0  # ticks for which it has been
        drawn = None if camera is None else camera.camera
        self._mismatch = None if flyer.camera in (None, drawn) else f"it sees by {flyer.camera}, drawn is {drawn}"
        self._gates_in_all = None if config.laps is None else config.laps * track.num_gates
        self._newest: Pose | None = None
        self._flying = False  # whether the vehicle has been armed and has left the start
        self._lifting = False  # whether the vehicle was being lifted at the last tick
        self._stand_height = math.inf  # m, of the newest pose before it was
        self._rises_since = math.inf  # s, measured: the first of the poses in a row by which it rises
        most = min(LIFT_MOST, config.limits.thrust_max / GRAVITY)
        if config.lift and not LIFT_LEAST <= config.lift <= most:
            raise ValueError(
                f"lift={config.lift:g}: must be {LIFT_LEAST:g} to {LIFT_MOST:g} weights of thrust, within "
                f"limits.thrust_max={config.limits.thrust_max:g} m/s², or 0: the flyer takes off by itself."
            )

    def warm_up(self) -> None:
        """Do once what a tick does, before the first one: libraries take their time then."""
        level = np.array([1.0, 0.0, 0.0, 0.0])
        start = np.array(self._config.limits.start_position, float)
        self._felt = ImuReading(0.0, np.array((0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY)))
        self._choose(Pose(0.0, start, level, np.zeros(3), np.zeros(3)))
        self._felt = None
        self._begin()

    def tick(self, inputs: Inputs) -> Outputs:
        """Take in what came, choose, and let safety judge."""
        if not self._flying:  # each tick is the first of the flight
            self._begin()
        poses = [pose for received in inputs.received if (pose := self.clock.read(received)) is not None]
        for pose in poses:
            self._newest = pose
            self._look_for_a_rise(pose)
            self.progress.update(pose, judged=pose is poses[-1])
        self._flying |= self._has_risen()
        pose = None if self._newest is None else extrapolate(self._newest, inputs.time)
        numb = self._feel(inputs) if self.feels else None
        finish = self._gates_in_all is not None and len(self.progress.passes) >= self._gates_in_all
        tick = Tick(
            now=inputs.time,
            pose=self._newest,
            pose_age=np.inf if self._newest is None else inputs.time - self._newest.time,
            setpoint=None,
            operator=inputs.operator,
            arm_requested=self._config.arm,
            # in flight there is no setpoint instead: it holds, then cuts
            contract_mismatch=self._mismatch if self.safety.armed else self._mismatch or numb,
            loop_overrun=inputs.overrun,
            finish=finish,
            command_dropped=inputs.dropped,
            refusal=inputs.refusal,
            lift=None if self._flying else self._lift(inputs.time),
        )
        findings = self.safety.examine(tick)
        # What is cut anyway does not wait for drawing and choosing.
        setpoint, image, render_s, act_s = self._choose(None if numb or self.safety.cuts(findings) else pose)
        verdict = self.safety.judge(tick._replace(setpoint=setpoint), findings)
        self._lifting = tick.lift is not None and self.safety.lets_through
        self._flying = finish or (verdict.command.armed and (self._flying or self._has_moved()))
        measured = math.nan if self._newest is None else self._newest.time
        target, passes = self.progress.target, len(self.progress.passes)
        voltage = None if self.battery is None else self.battery.update(inputs.time, inputs.voltages)
        return Outputs(verdict, setpoint, pose, measured, image, target, passes, render_s, act_s, voltage)

    def _lift(self, now: float) -> Setpoint | None:
        """Return the lift at a tick, one weight to begin with and ever more; None: the flyer takes off by itself."""
        config = self._config
        if not config.lift or not self.safety.armed:
            return None
        share = (now - self.safety.sends_from) / config.limits.lift_time
        weights = 1.0 + (config.lift - 1.0) * min(max(share, 0.0), 1.0)
        return Setpoint(weights * GRAVITY, np.zeros(3))

    def _look_for_a_rise(self, pose: Pose) -> None:
        """Note since when poses show that the vehicle rises, of those that it was lifted in."""
        if not self._lifting:
            self._stand_height = float(pose.position[2])
        rises = self._lifting and pose.linear_velocity[2] > self._config.limits.start_speed
        self._rises_since = min(self._rises_since, pose.time) if rises else math.inf

    def _has_risen(self) -> bool:
        """Whether the vehicle, which is lifted, has been seen to rise for long enough."""
        if self._newest is None or not self._lifting:
            return False
        risen = float(self._newest.position[2]) - self._stand_height
        return self._newest.time - self._rises_since >= RISE_TIME and risen >= RISE_HEIGHT

    def _has_moved(self) -> bool:
        """Whether the vehicle, which is not lifted, has left the start."""
        if self._newest is None or self._config.lift:
            return False
        speed, rate = (float(np.linalg.norm(part)) for part in (self._newest.linear_velocity, self._newest.body_rates))
        return speed > self._config.limits.start_speed or rate > START_RATE

    def _choose(self, pose: Pose | None) -> tuple[Setpoint | None, np.ndarray | None, float, float]:
        """Return setpoint and image, and how long drawing and choosing took, s."""
        if pose is None:
            return None, None, 0.0, 0.0
        start = time.perf_counter()
        image = self._look(pose)
        drawn = time.perf_counter()
        felt = () if not self.feels or self._felt is None else (self._felt.sample,)
        act: Callable[..., Setpoint] = self._flyer.act  # of one that feels, with the sample
        setpoint = act(pose, image, self.progress.target, *felt)
        render_s = 0.0 if self._shown else drawn - start
        return setpoint, image, render_s, time.perf_counter() - drawn

    def _feel(self, inputs: Inputs) -> str | None:
        """Take in what the IMU told; say why the flyer cannot fly by it, None if it can."""
        if inputs.imu:
            self._felt = inputs.imu[-1]
        most = self._config.limits.hold_after
        if self._felt is None or inputs.time - self._felt.time > most:
            return f"it flies by the IMU, and nothing was heard of that for more than {most:g} s"
        return None if self.safety.armed else unlike_rest(self._felt.sample)

    def _begin(self) -> None:
        """Begin a flight."""
        self._flyer.reset()
        self.progress.reset()
        self._image = None

    def _look(self, pose: Pose) -> np.ndarray | None:
        """Return the image that the flyer is shown, a frame of now or, of a camera that is slower, one of before."""
        if self._camera is None:
            return None
        self._shown += 1
        if self._image is None or self._shown >= self._frame_interval:
            self._image, self._shown = self._camera.see(pose), 0
        return self._image

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
        **({"imu": [[felt.time, *felt.sample.tolist()] for felt in inputs.imu]} if inputs.imu else {}),
        **({"refusal": inputs.refusal} if inputs.refusal else {}),
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
    felt = [ImuReading(arrived, np.array(sample)) for arrived, *sample in message.get("imu", ())]
    refusal = message.get("refusal", "")
    return Inputs(message["time"], received, operator, overrun, voltages, dropped, felt, refusal)


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
