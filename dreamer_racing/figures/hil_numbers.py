"""Metrics of a recorded hardware-in-the-loop flight: latencies, gate passes, and tracking errors of the commands.

Shapes: T ticks of the loop, P measured poses, M samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.envs.tracks import Track, TrackError
from dreamer_racing.hil.chain import Inputs, read_inputs
from dreamer_racing.hil.loop import percentiles
from dreamer_racing.hil.progress import GatePass, GateProgress, flying_laps
from dreamer_racing.hil.recording import Flight
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.stamping import PoseClock, Stamping
from dreamer_racing.hil.vehicle import Pose

LAG_MAX, LAG_STEP = 0.3, 0.001  # s, of the lags tried between a command and the measured motion [choice]
FEWEST = 20  # measurements for a tracking error [choice]
ACCELERATION_WINDOW = 0.04  # s, two control steps: for the difference of velocities that gives the thrust [choice]
LIMITS = ("speed_max", "jump_tolerance", "clock_drift_max")  # safety limits that are read from a recording
STAGES = ("jitter", "render", "act", "sent")
"""Recorded times of each tick: its delay, and the durations of its stages."""
CHANNELS = {"collective_thrust": "m/s²", "body_rate_x": "rad/s", "body_rate_y": "rad/s", "body_rate_z": "rad/s"}
"""Channels of a command in order, with their units."""


@dataclass(frozen=True)
class FlownFlight:
    """Arrays of a recorded flight."""

    path: Path  # of the recording, or of its folder
    about: dict[str, Any]  # metadata from the recording
    whole: bool  # whether the recording is complete
    track: Track
    limits: SafetyLimits  # only `LIMITS` are read from the recording
    time: np.ndarray  # (T,) start of each tick on the loop's clock, s
    armed: np.ndarray  # (T,) bool
    command: np.ndarray  # (T, 4) commands sent: collective thrust in m/s² and body rates in rad/s
    seen: np.ndarray
    """(T, 13) pose used in each tick: position, attitude wxyz, velocity, body rates; NaN without a pose."""
    target_gate: np.ndarray  # (T,) int
    passes: np.ndarray  # (T,) int: the loop's count of gates passed
    took: dict[str, np.ndarray]  # (T,) s each, by `STAGES`
    overrun: np.ndarray  # (T,) int: deadlines missed in the previous tick
    pose_age: np.ndarray  # (T,) s from the newest pose's measurement to the tick; NaN without a pose
    poses: list[Pose]  # P, with timestamps on the loop's clock
    arrived: np.ndarray  # (P,) int: index of the tick that read each pose
    out_of_order: int  # number of poses that arrived out of order and were dropped
    ended: str | None
    """State and reasons with which the flight ended; None if it was armed until the last tick, or never."""

    @property
    def flown(self) -> slice:
        """Ticks from the first armed one to the one after the last armed one; empty if never armed."""
        armed = np.flatnonzero(self.armed)
        return slice(armed[0], armed[-1] + 2) if len(armed) else slice(0, 0)


class Response(NamedTuple):
    """Commands and measurements of one channel."""

    asked_time: np.ndarray  # (T',) time at which each armed command was sent, s
    asked: np.ndarray  # (T',) each holds until the next
    time: np.ndarray  # (M,) of the measurements, s
    measured: np.ndarray  # (M,)


def read_flown(path: Path) -> FlownFlight:
    """Read a recorded flight.

    Raises:
        FileNotFoundError: The recording does not exist.
        ValueError: The recording, or the track in it, is damaged, or there are no ticks.
    """
    flight = Flight(path)
    if not flight.ticks:
        raise ValueError(f"{path}: the flight has no ticks: its loop ended before the first one.")
    try:
        config = flight.about.get("config") or {}
        track = flight.track()
        set_then = config.get("limits") or {}
        names = [name for name in LIMITS if set_then.get(name) is not None]
        limits = SafetyLimits.of_track(track, **{name: float(set_then[name]) for name in names})
        stamping, latency = Stamping(config.get("stamping", "receive")), float(config.get("latency", 0.0))
        clock = PoseClock(stamping, latency, limits.clock_drift_max)
        arrays = _read_ticks(flight.ticks, clock)
    except TrackError as error:
        raise ValueError(f"{path}: {error}") from error
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        what = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: its content is not what recipes/hil.py writes ({what}).") from error
    return FlownFlight(path, flight.about, flight.whole, track, limits, out_of_order=clock.out_of_order, **arrays)


def latencies(flight: FlownFlight) -> dict[str, Any]:
    """Return p50, p99 and maximum of each stage in ms, over armed ticks, or over all ticks if none is armed."""
    armed = bool(flight.armed.any())
    ticks = flight.armed if armed else np.ones(len(flight.time), bool)
    took, blind = flight.took, (flight.about.get("contract") or {}).get("camera") is None
    stages = {
        "jitter": took["jitter"][ticks],  # from the scheduled start of the tick to its start
        "interval": np.diff(flight.time)[ticks[1:] & ticks[:-1]],  # from start to start
        "pose_age": flight.pose_age[ticks],  # from the timestamp of the newest pose to the start of the tick
        "render": np.empty(0) if blind else took["render"][ticks],
        "act": took["act"][ticks],  # of the flyer
        "sent": took["sent"][ticks],  # from the start of the tick until the command is sent
        "end_to_end": (flight.pose_age + took["sent"])[ticks],  # from the timestamp of the newest pose until then
    }
    table = {name: percentiles(values[np.isfinite(values)].tolist()) for name, values in stages.items()}
    return {
        "of": "armed ticks" if armed else "all ticks",
        "ticks": int(ticks.sum()),
        "stages": table,
        "missed_deadlines": int(flight.overrun.sum()),
    }


def gate_passes(flight: FlownFlight) -> list[GatePass]:
    """Return the gates passed while armed, computed from all measured poses."""
    progress = GateProgress(flight.track, flight.limits)
    newest = np.diff(flight.arrived, append=-1) != 0  # whether a pose is its tick's newest
    for pose, tick, judged in zip(flight.poses, flight.arrived, newest, strict=True):
        if flight.flown.start <= tick < flight.flown.stop:
            progress.update(pose, judged=bool(judged))
    return progress.passes


def lap_times(flight: FlownFlight, passes: list[GatePass]) -> dict[str, list[float]]:
    """Return lap times, s: ``flying`` from first gate to first gate; ``race``, as in evaluations, to the last gate.

    The first lap of a race begins at arming.
    """
    lasts = [passed.time for passed in passes if passed.gate == flight.track.num_gates - 1]
    began = [float(flight.time[flight.flown][0])] if lasts else []
    return {"flying": flying_laps(passes), "race": np.diff(began + lasts).tolist()}


def responses(flight: FlownFlight) -> dict[str, Response]:
    """Return the commands and measurements of each channel while armed.

    Thrust is estimated from the poses' velocities: acceleration minus gravity along body z, which includes drag.
    """
    armed = flight.armed
    if not armed.any():
        return {}
    asked_time = (flight.time + flight.took["sent"])[armed]
    asked = flight.command[armed]
    poses: list[Pose] = []
    for pose in flight.poses:
        if asked_time[0] <= pose.time <= asked_time[-1] and (not poses or pose.time > poses[-1].time):
            poses.append(pose)
    time = np.array([pose.time for pose in poses])
    rates = np.array([pose.body_rates for pose in poses]).reshape(-1, 3)
    thrust_time, thrust = _measured_thrust(time, poses)
    measured = [(thrust_time, thrust), *((time, rate) for rate in rates.T)]
    return {
        name: Response(asked_time, asked[:, index], *pair)
        for index, (name, pair) in enumerate(zip(CHANNELS, measured, strict=True))
    }


def tracking_error(response: Response) -> dict[str, float | None] | None:
    """Return the RMS tracking error of a channel at the lag that minimises it; None with too few measurements.

    ``lag_ms`` is the median of equally good lags, None if the command never changed; ``rms`` at this lag and
    ``rms_without_lag`` are in the channel's unit.
    """
    usable = response.time >= response.asked_time[0] + LAG_MAX
    time, measured = response.time[usable], response.measured[usable]
    if len(time) < FEWEST:
        return None
    without = _rms(measured - _commands_at(response, time))
    if np.ptp(_commands_at(response, time)) < 1e-9:
        return {"rms": without, "lag_ms": None, "rms_without_lag": without}
    lags = np.arange(round(LAG_MAX / LAG_STEP) + 1) * LAG_STEP
    rms = np.array([_rms(measured - _commands_at(response, time - lag)) for lag in lags])
    best = lags[np.isclose(rms, rms.min(), rtol=1e-9, atol=1e-12)]
    return {"rms": float(rms.min()), "lag_ms": 1e3 * float(best[len(best) // 2]), "rms_without_lag": without}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _commands_at(response: Response, time: np.ndarray) -> np.ndarray:
    """Return the commands in force at times (M,)."""
    return response.asked[np.searchsorted(response.asked_time, time + 1e-9, side="right") - 1]


def _measured_thrust(time: np.ndarray, poses: list[Pose]) -> tuple[np.ndarray, np.ndarray]:
    """Return times (M,) and the thrust minus drag divided by mass, (M,) m/s²."""
    half = 0.5 * ACCELERATION_WINDOW
    if not len(time) or time[-1] - time[0] <= ACCELERATION_WINDOW:
        return np.empty(0), np.empty(0)
    inner = (time >= time[0] + half) & (time <= time[-1] - half)
    velocity = np.array([pose.linear_velocity for pose in poses])  # (P, 3)
    later, earlier = (
        np.stack([np.interp(time[inner] + shift, time, axis) for axis in velocity.T], axis=1) for shift in (half, -half)
    )
    force = (later - earlier) / ACCELERATION_WINDOW + (0.0, 0.0, GRAVITY)  # (M, 3) m/s², world
    w, x, y, z = np.array([pose.attitude for pose in poses])[inner].T
    up = np.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), axis=1)  # (M, 3)
    return time[inner], (force * up).sum(axis=1)


def _read_ticks(ticks: list[dict[str, Any]], clock: PoseClock) -> dict[str, Any]:
    inputs, outputs = [read_inputs(tick["in"]) for tick in ticks], [tick["out"] for tick in ticks]
    commands = np.array([out["command"] for out in outputs], float).reshape(-1, 5)
    seen = [13 * [np.nan] if out["pose"] is None else out["pose"] for out in outputs]
    armed = commands[:, 0] > 0
    poses, arrived, pose_age = _stamp_poses(inputs, clock)
    time = np.array([each.time for each in inputs], float)
    took = {name: np.array([tick["took"][name] for tick in ticks], float) for name in STAGES}
    if not all(np.isfinite(values).all() for values in (time, *took.values())) or (np.diff(time) < 0.0).any():
        raise ValueError("times of ticks are not finite, or not in order")
    return {
        "time": time,
        "armed": armed,
        "command": commands[:, 1:],
        "seen": np.array(seen, float).reshape(-1, 13),
        "target_gate": np.array([out["target_gate"] for out in outputs], int),
        "passes": np.array([out["passes"] for out in outputs], int),
        "took": took,
        "overrun": np.array([each.overrun for each in inputs], int),
        "pose_age": pose_age,
        "poses": poses,
        "arrived": arrived,
        "ended": _ending(outputs, armed),
    }


def _stamp_poses(inputs: list[Inputs], clock: PoseClock) -> tuple[list[Pose], np.ndarray, np.ndarray]:
    """Return poses on the loop's clock, the tick that read each pose, and the newest pose's age at each tick, s."""
    poses: list[Pose] = []
    arrived, ages = [], []
    for tick, each in enumerate(inputs):
        for received in each.received:
            pose = clock.read(received)
            if pose is not None:
                poses.append(pose)
                arrived.append(tick)
        ages.append(each.time - poses[-1].time if poses else np.nan)
    return poses, np.array(arrived, int), np.array(ages)


def _ending(outputs: list[dict[str, Any]], armed: np.ndarray) -> str | None:
    """Return the safety state and reasons of the first tick after the armed ones; None if there is none."""
    after = (np.flatnonzero(armed)[-1] + 1) if armed.any() else len(outputs)
    if after >= len(outputs):
        return None
    reasons = outputs[after]["reasons"]
    return "finished" if "finished" in reasons else f"{outputs[after]['state']}: {', '.join(reasons)}".rstrip(": ")
