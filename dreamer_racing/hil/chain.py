"""Processes each tick: poses in, one command out. No clock and no socket in here.

`FlightChain.tick` depends only on the inputs of this tick and of those before, so that a recorded flight can be
replayed through it: the same file gives the same commands, bit for bit.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dreamer_racing.envs.simulator.scene import frame_interval
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.battery import Battery, BatteryConfig, Reading
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.imu import ImuReading, check_at_rest
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received
from dreamer_racing.hil.progress import GateProgress
from dreamer_racing.hil.safety import Safety, SafetyLimits, Tick, Verdict
from dreamer_racing.hil.stamping import PoseClock, Stamping, extrapolate
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint
from dreamer_racing.settings import Range, check_setting

LIFT = 1.35
"""Multiple of the weight to which take-off thrust ramps up within `SafetyLimits.lift_time` [choice]. It starts at 1: a
vehicle of the assumed mass has risen 2 to 3 cm after a third of a second, at 0.2 m/s; a heavier one rises later."""

LIFT_LEAST, LIFT_MOST = 1.1, 1.5
"""Range of the lift, in weights [choice]: less is not seen in time, and a drone that needs more is not its actor's."""

RISE_TIME = 0.04
"""s for which all poses must show the vehicle rising before its flyer takes over [choice]: the false velocity after a
jump of 0.1 m, the largest that safety accepts, has decayed by then (`HilConfig.smoothing`)."""

RISE_HEIGHT = 0.01  # m above its stand that the vehicle must have reached by then [choice]

START_RATE = 2.0
"""rad/s above which even a slow vehicle has left the start [choice]: racers turn before they move, and in training no
episode begins, with empty memory, in a tilted vehicle. Noise of estimated rates stays below."""


class ChainConfig(NamedTuple):
    """Settings of a flight besides its flyer and its track."""

    limits: SafetyLimits
    stamping: Stamping = Stamping.receive  # how the measurement times of poses are determined
    latency: float = 0.0  # least time from a pose's measurement to its arrival, s
    laps: int | None = None  # laps after which the flight ends and the vehicle is disarmed; None: the operator ends it
    arm: bool = False  # whether the vehicle may be armed at all
    # battery settings, if the link reports a voltage and it is used; None otherwise
    battery: BatteryConfig | None = None
    # largest upward thrust, in weights, that is sent until the vehicle is seen to rise; 0: the flyer takes off by
    # itself
    lift: float = LIFT


class Inputs(NamedTuple):
    """The inputs of a tick."""

    time: float  # s, by the loop's clock
    received: list[Received]  # pose packets since the last tick, oldest first
    operator: Operator
    overrun: int  # deadlines missed because the tick before took longer than its period
    voltages: Sequence[Reading] = ()  # battery readings since the last tick, oldest first
    dropped: bool = False  # whether the command of the tick before was not sent
    imu: Sequence[ImuReading] = ()  # IMU samples since the last tick, oldest first; read only if the flyer uses them
    refusal: str = ""  # why the flight controller does not follow commands, see `Tick`


class Outputs(NamedTuple):
    """The outputs of a tick."""

    verdict: Verdict
    # the flyer's, even if the lift is sent instead; None if pose or IMU is missing, or motors are cut
    setpoint: Setpoint | None
    pose: Pose | None  # the newest pose, extrapolated to the tick, for which the setpoint was chosen
    measured: float  # when that pose was measured, s; NaN without a pose
    image: np.ndarray | None  # the flyer's input; None if it has no camera, or was not run
    target_gate: int  # index of the gate that comes next
    passes: int  # gates passed in this flight
    render_s: float  # rendering time, s; 0 if the image of an earlier tick is still shown
    act_s: float  # the flyer's computing time, s
    voltage: float | None = None  # V, by which the link converts thrust to throttle; None: unchanged


class FlightChain:
    """Runs pose → image → flyer → safety at each tick.

    A flyer's flight begins when its vehicle moves. On the stand it would see the first image again and again, and its
    first action would be repeated until motion is seen, which no episode of training begins with. So the vehicle is
    first lifted straight up with growing thrust; the flyer runs at each tick, and is reset until the vehicle rises. If
    no rise is seen within `SafetyLimits.lift_time`, motors are cut.

    Args:
        flyer: Chooses the setpoints; if it has a camera, that draws the track for it.
        track: To fly.
        config: Settings.
        renderer: As in `NoseCamera`.

    Raises:
        ValueError: The camera's frame rate does not fit the flyer's rate, the latency is out of range, or the lift is
            not within its range and safety's limits.
        RendererUnavailableError: The camera's images cannot be rendered here.

    Attributes:
        progress: Counts the gates passed.
        clock: Determines the measurement times of poses.
        safety: Checks and limits each command.
        battery: Tracks its voltage; None if that is not used.
        needs_imu: Whether the flyer needs IMU samples.
    """

    def __init__(self, flyer: Flyer, track: Track, config: ChainConfig, renderer: str = "auto") -> None:
        check_setting("latency", config.latency, Range(0, 1))
        self.progress = GateProgress(track, config.limits)
        self.clock = PoseClock(config.stamping, config.latency, config.limits.clock_drift_max)
        self.safety = Safety(config.limits)
        self.battery = None if config.battery is None else Battery(config.battery)
        self._flyer, self._config = flyer, config
        self._frame_interval = 1 if flyer.camera is None else frame_interval(flyer.camera, flyer.rate)
        self.needs_imu = bool(getattr(flyer, "needs_imu", False))
        self._newest_imu: ImuReading | None = None  # newest IMU sample
        self._image: np.ndarray | None = None  # shown to the flyer; None before a flight's first
        self._shown = 0  # ticks for which it has been shown
        self._gates_in_all = None if config.laps is None else config.laps * track.num_gates
        self._newest: Pose | None = None
        self._flying = False  # whether the vehicle has been armed and has left the start
        self._lifting = False  # whether the vehicle was being lifted at the last tick
        self._stand_height = math.inf  # m, of the newest pose before the lift
        self._rises_since = math.inf  # s, measurement time of the first of consecutive rising poses
        most = min(LIFT_MOST, config.limits.thrust_max / GRAVITY)
        if config.lift and not LIFT_LEAST <= config.lift <= most:
            raise ValueError(
                f"lift={config.lift:g}: must be {LIFT_LEAST:g} to {LIFT_MOST:g} times the weight, within "
                f"limits.thrust_max={config.limits.thrust_max:g} m/s², or 0 if the flyer takes off by itself."
            )
        self._camera = None if flyer.camera is None else NoseCamera(track, flyer.camera, renderer)

    def warm_up(self) -> None:
        """Render and run the flyer once before the first tick, because libraries are slow at first use."""
        level = np.array([1.0, 0.0, 0.0, 0.0])
        start = np.array(self._config.limits.start_position, float)
        self._newest_imu = ImuReading(0.0, np.array((0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY)))
        self._choose(Pose(0.0, start, level, np.zeros(3), np.zeros(3)))
        self._newest_imu = None
        self._begin()

    def tick(self, inputs: Inputs) -> Outputs:
        """Process the inputs, let the flyer choose, and let safety decide."""
        if not self._flying:  # until take-off, each tick is the flight's first
            self._begin()
        poses = [pose for received in inputs.received if (pose := self.clock.read(received)) is not None]
        for pose in poses:
            self._newest = pose
            self._track_rise(pose)
            self.progress.update(pose, judged=pose is poses[-1])
        self._flying |= self._has_risen()
        pose = None if self._newest is None else extrapolate(self._newest, inputs.time)
        imu_fault = self._check_imu(inputs) if self.needs_imu else None
        finish = self._gates_in_all is not None and len(self.progress.passes) >= self._gates_in_all
        tick = Tick(
            now=inputs.time,
            pose=self._newest,
            pose_age=np.inf if self._newest is None else inputs.time - self._newest.time,
            setpoint=None,
            operator=inputs.operator,
            arm_requested=self._config.arm,
            # a silent IMU in flight leaves the setpoint out instead: safety holds, then cuts
            contract_mismatch=None if self.safety.armed else imu_fault,
            loop_overrun=inputs.overrun,
            finish=finish,
            command_dropped=inputs.dropped,
            refusal=inputs.refusal,
            lift=None if self._flying else self._lift(inputs.time),
        )
        findings = self.safety.examine(tick)
        # If safety cuts anyway, rendering and flyer are skipped.
        setpoint, image, render_s, act_s = self._choose(None if imu_fault or self.safety.cuts(findings) else pose)
        verdict = self.safety.judge(tick._replace(setpoint=setpoint), findings)
        self._lifting = tick.lift is not None and self.safety.sends_setpoint
        self._flying = finish or (verdict.command.armed and (self._flying or self._has_moved()))
        measured = math.nan if self._newest is None else self._newest.time
        target, passes = self.progress.target, len(self.progress.passes)
        voltage = None if self.battery is None else self.battery.update(inputs.time, inputs.voltages)
        return Outputs(verdict, setpoint, pose, measured, image, target, passes, render_s, act_s, voltage)

    def _lift(self, now: float) -> Setpoint | None:
        """Return the lift's setpoint, which ramps up from one weight; None if unarmed or without a lift."""
        config = self._config
        if not config.lift or not self.safety.armed:
            return None
        share = (now - self.safety.sends_from) / config.limits.lift_time
        weights = 1.0 + (config.lift - 1.0) * min(max(share, 0.0), 1.0)
        return Setpoint(weights * GRAVITY, np.zeros(3))

    def _track_rise(self, pose: Pose) -> None:
        """Note since when consecutive poses during the lift show the vehicle rising."""
        if not self._lifting:
            self._stand_height = float(pose.position[2])
        rises = self._lifting and pose.linear_velocity[2] > self._config.limits.start_speed
        self._rises_since = min(self._rises_since, pose.time) if rises else math.inf

    def _has_risen(self) -> bool:
        """Return whether the lifted vehicle has been seen to rise for long enough."""
        if self._newest is None or not self._lifting:
            return False
        risen = float(self._newest.position[2]) - self._stand_height
        return self._newest.time - self._rises_since >= RISE_TIME and risen >= RISE_HEIGHT

    def _has_moved(self) -> bool:
        """Return whether a vehicle that takes off without the lift has left the start."""
        if self._newest is None or self._config.lift:
            return False
        speed, rate = (float(np.linalg.norm(part)) for part in (self._newest.linear_velocity, self._newest.body_rates))
        return speed > self._config.limits.start_speed or rate > START_RATE

    def _choose(self, pose: Pose | None) -> tuple[Setpoint | None, np.ndarray | None, float, float]:
        """Return setpoint, image, rendering time and the flyer's time, s."""
        if pose is None:
            return None, None, 0.0, 0.0
        start = time.perf_counter()
        image = self._update_image(pose)
        drawn = time.perf_counter()
        imu = () if not self.needs_imu or self._newest_imu is None else (self._newest_imu.sample,)
        act: Callable[..., Setpoint] = self._flyer.act  # takes the IMU sample, too, if the flyer needs it
        setpoint = act(pose, image, self.progress.target, *imu)
        render_s = 0.0 if self._shown else drawn - start
        return setpoint, image, render_s, time.perf_counter() - drawn

    def _check_imu(self, inputs: Inputs) -> str | None:
        """Store the newest IMU sample; return why the flyer cannot use it, None if it can."""
        if inputs.imu:
            self._newest_imu = inputs.imu[-1]
        most = self._config.limits.hold_after
        if self._newest_imu is None or inputs.time - self._newest_imu.time > most:
            return f"it needs IMU samples, and none has arrived for more than {most:g} s"
        return None if self.safety.armed else check_at_rest(self._newest_imu.sample)

    def _begin(self) -> None:
        """Reset flyer and progress for a new flight."""
        self._flyer.reset()
        self.progress.reset()
        self._image = None

    def _update_image(self, pose: Pose) -> np.ndarray | None:
        """Return the flyer's image: a new one, or the last one if the camera is slower than the ticks."""
        if self._camera is None:
            return None
        self._shown += 1
        if self._image is None or self._shown >= self._frame_interval:
            self._image, self._shown = self._camera.see(pose), 0
        return self._image

    def prepare(self) -> None:
        """Do the part of the next tick that can be done ahead, once this tick's command is sent."""
        self._flyer.prepare()

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()


def describe_inputs(inputs: Inputs) -> dict[str, Any]:
    """Return a tick's inputs as JSON values, which `read_inputs` reads back."""
    return {
        "time": inputs.time,
        "received": [[received.time, *_numbers(received.packet)] for received in inputs.received],
        "operator": list(inputs.operator),
        "overrun": inputs.overrun,
        "voltages": [list(reading) for reading in inputs.voltages],
        "dropped": inputs.dropped,
        **({"imu": [[reading.time, *reading.sample.tolist()] for reading in inputs.imu]} if inputs.imu else {}),
        **({"refusal": inputs.refusal} if inputs.refusal else {}),
    }


def read_inputs(message: dict[str, Any]) -> Inputs:
    """Return a tick's inputs from the values of `describe_inputs`."""
    received = []
    for arrived, sequence, stamp, *numbers in message["received"]:
        values = np.array(numbers)
        packet = PosePacket(sequence, stamp, values[:3], values[3:7], values[7:10], values[10:])
        received.append(Received(arrived, packet))
    operator, voltages = Operator(*message["operator"]), [Reading(*reading) for reading in message["voltages"]]
    imu = [ImuReading(arrived, np.array(sample)) for arrived, *sample in message.get("imu", ())]
    rest = message["overrun"], voltages, message["dropped"], imu, message.get("refusal", "")
    return Inputs(message["time"], received, operator, *rest)


def describe_outputs(outputs: Outputs) -> dict[str, Any]:
    """Return a tick's outputs as JSON values, without timings, so that a replay gives the same."""
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


def first_difference(chain: FlightChain, ticks: Iterable[dict[str, Any]]) -> str | None:
    """Pass recorded ticks through a chain; return in words where its outputs first differ, None if nowhere.

    Outputs are compared bit for bit, as JSON values.
    """
    for index, tick in enumerate(ticks):
        again = json.loads(json.dumps(describe_outputs(chain.tick(read_inputs(tick["in"])))))
        for name, value in tick["out"].items():
            if json.dumps(value) != json.dumps(again.get(name)):  # NaN equals NaN
                return f"tick {index}: {name} was {value}, and is {again.get(name)} now"
    return None


def _numbers(packet: PosePacket) -> list[float]:
    return [packet.sequence, packet.stamp, *(number for vector in packet[2:] for number in vector.tolist())]


def _flat(setpoint: Setpoint) -> list[float]:
    return [float(setpoint.collective_thrust), *(float(rate) for rate in setpoint.body_rates)]
