"""What a recorded flight in the loop comes to in numbers: latencies, gates, and how the vehicle did as it was told.

Shapes: T ticks of the loop, P poses as they were measured, M of either.
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

LAG_MAX = 0.3
"""s, the largest lag from a command to the motion that it asks for that is tried [choice]."""

LAG_STEP = 0.001
"""s between the lags that are tried [choice]."""

FEWEST = 20
"""Measurements of which a lag may be said [choice]."""

ACCELERATION_WINDOW = 0.04
"""s over which velocities are differenced for the thrust [choice]: two control steps at 50 Hz."""

STAGES = ("jitter", "render", "act", "sent")
"""What a recording says of each tick: how late it began, and how long it took."""

CHANNELS = {"collective_thrust": "m/s²", "body_rate_x": "rad/s", "body_rate_y": "rad/s", "body_rate_z": "rad/s"}
"""Of a command, in its order, with their units."""


@dataclass(frozen=True)
class FlownFlight:
    """A recorded flight in arrays."""

    path: Path
    """Of the file, or of its folder."""
    about: dict[str, Any]
    """With what it was begun."""
    whole: bool
    """Whether its file was finished."""
    holds_track: bool
    """Whether its file holds the track; if not, `track` is that of its name as it is now."""
    track: Track
    limits: SafetyLimits
    """Of safety; only those by which poses may be apart are read."""
    time: np.ndarray
    """(T,) s, by the loop's clock, when each tick began."""
    armed: np.ndarray
    """(T,) bool."""
    command: np.ndarray
    """(T, 4) as sent: collective thrust in m/s² and body rates in rad/s."""
    seen: np.ndarray
    """(T, 13) pose that each tick chose by: position, attitude wxyz, velocity, body rates; not-a-number if none."""
    target_gate: np.ndarray
    """(T,) int."""
    passes: np.ndarray
    """(T,) int: gates passed, as the loop counted."""
    took: dict[str, np.ndarray]
    """(T,) s each: ``jitter``, ``render``, ``act``, ``sent``."""
    overrun: np.ndarray
    """(T,) int: deadlines that the tick before missed."""
    pose_age: np.ndarray
    """(T,) s from the newest pose's measurement to the tick; not-a-number without a pose."""
    poses: list[Pose]
    """(P,) on the loop's clock."""
    arrived: np.ndarray
    """(P,) int: the tick that took in each."""
    out_of_order: int
    """Poses that came too late to count."""
    ended: str | None
    """How it ended, by safety; None if it was armed to the last tick, or never."""

    @property
    def flown(self) -> slice:
        """Ticks from the first armed one to the one after the last, which saw it end; none if it never was."""
        armed = np.flatnonzero(self.armed)
        return slice(armed[0], armed[-1] + 2) if len(armed) else slice(0, 0)


class Response(NamedTuple):
    """What was asked for and what came of it.

    Args:
        asked_time: (T',) s, when each armed command was sent.
        asked: (T',) which holds until the next.
        time: (M,) s.
        measured: (M,)
    """

    asked_time: np.ndarray
    asked: np.ndarray
    time: np.ndarray
    measured: np.ndarray


def read_flown(path: Path) -> FlownFlight:
    """Read a flight.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged, empty, or of a track that there is not.
    """
    flight = Flight(path)
    if not flight.ticks:
        raise ValueError(f"{path}: the flight has no ticks: its loop ended before the first one.")
    try:
        config = flight.about.get("config") or {}
        track = flight.track()
        clock, limits = _clock_of(config), _limits_of(config, track)
        arrays = _read_ticks(flight.ticks, clock)
    except TrackError as error:
        raise ValueError(f"{path}: {error}") from error
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        what = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: its content is not what recipes/hil.py writes ({what}).") from error
    return FlownFlight(
        path, flight.about, flight.whole, flight.holds_track, track, limits, out_of_order=clock.out_of_order, **arrays
    )


def _clock_of(config: dict[str, Any]) -> PoseClock:
    """Return the clock that a flight's poses were stamped by."""
    drift = (config.get("limits") or {}).get("clock_drift_max")
    given = {} if drift is None else {"drift_max": float(drift)}
    return PoseClock(Stamping(config.get("stamping", "receive")), float(config.get("latency", 0.0)), **given)


def _limits_of(config: dict[str, Any], track: Track) -> SafetyLimits:
    """Return the limits of a flight by which two poses may be apart."""
    set_then = config.get("limits") or {}
    names = [name for name in ("speed_max", "jump_tolerance") if set_then.get(name) is not None]
    return SafetyLimits.of_track(track, **{name: float(set_then[name]) for name in names})


def latencies(flight: FlownFlight) -> dict[str, Any]:
    """Return p50, p99 and maximum of each stage in ms, of armed ticks, or of all if there are none.

    | stage | from | to |
    |---|---|---|
    | ``jitter`` | when the tick was due | its beginning |
    | ``interval`` | a tick's beginning | the next one's |
    | ``pose_age`` | the newest pose's measurement, as stamped | the tick's beginning |
    | ``render``, ``act`` | | durations of drawing the image and of the flyer |
    | ``sent`` | the tick's beginning | the command is sent |
    | ``end_to_end`` | the newest pose's measurement | the command is sent |
    """
    armed = bool(flight.armed.any())
    ticks = flight.armed if armed else np.ones(len(flight.time), bool)
    took, blind = flight.took, (flight.about.get("contract") or {}).get("camera") is None
    stages = {
        "jitter": took["jitter"][ticks],
        "interval": np.diff(flight.time)[ticks[1:] & ticks[:-1]],
        "pose_age": flight.pose_age[ticks],
        "render": np.empty(0) if blind else took["render"][ticks],
        "act": took["act"][ticks],
        "sent": took["sent"][ticks],
        "end_to_end": (flight.pose_age + took["sent"])[ticks],
    }
    table = {name: percentiles(values[np.isfinite(values)].tolist()) for name, values in stages.items()}
    missed = int(flight.overrun.sum())
    of = "armed ticks" if armed else "all ticks"
    return {"of": of, "ticks": int(ticks.sum()), "stages": table, "missed_deadlines": missed}


def gate_passes(flight: FlownFlight) -> list[GatePass]:
    """Return the gates passed since it was armed, by the poses as measured."""
    progress = GateProgress(flight.track, flight.limits)
    newest = np.diff(flight.arrived, append=-1) != 0  # of their ticks
    for pose, tick, judged in zip(flight.poses, flight.arrived, newest, strict=True):
        if flight.flown.start <= tick < flight.flown.stop:
            progress.update(pose, judged=bool(judged))
    return progress.passes


def lap_times(flight: FlownFlight, passes: list[GatePass]) -> dict[str, list[float]]:
    """Return the times of laps, s, counted in two ways.

    ``flying``: from the first gate to the first gate. ``race``: from the last gate to the last gate, the first one from
    arming; evaluations count so.
    """
    lasts = [passed.time for passed in passes if passed.gate == flight.track.num_gates - 1]
    began = [float(flight.time[flight.flown][0])] if lasts else []
    return {"flying": flying_laps(passes), "race": np.diff(began + lasts).tolist()}


def responses(flight: FlownFlight) -> dict[str, Response]:
    """Return for each channel what was asked for while it was armed, and what was measured then.

    Thrust is not measured by poses; it is taken from their velocities: acceleration less gravity, along body z. Drag
    along this axis is in it.
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
    """Return by how much the vehicle missed what it was told, at the lag at which it missed it least.

    Returns:
        ``lag_ms``, in the middle where several are as good, None if the command never changed; ``rms`` at this lag and
        ``rms_without_lag``, in the channel's unit. None if too little was measured.
    """
    usable = response.time >= response.asked_time[0] + LAG_MAX
    time, measured = response.time[usable], response.measured[usable]
    if len(time) < FEWEST:
        return None
    without = _rms(measured - _held(response, time))
    if np.ptp(_held(response, time)) < 1e-9:
        return {"rms": without, "lag_ms": None, "rms_without_lag": without}
    lags = np.arange(round(LAG_MAX / LAG_STEP) + 1) * LAG_STEP
    rms = np.array([_rms(measured - _held(response, time - lag)) for lag in lags])
    best = lags[np.isclose(rms, rms.min(), rtol=1e-9, atol=1e-12)]
    return {"rms": float(rms.min()), "lag_ms": 1e3 * float(best[len(best) // 2]), "rms_without_lag": without}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _held(response: Response, time: np.ndarray) -> np.ndarray:
    """Return the command that held at some times, (M,)."""
    return response.asked[np.searchsorted(response.asked_time, time + 1e-9, side="right") - 1]


def _measured_thrust(time: np.ndarray, poses: list[Pose]) -> tuple[np.ndarray, np.ndarray]:
    """Return times (M,) and thrust divided by mass, less drag, (M,) m/s²."""
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
    """Return the fields of `FlownFlight` that are of ticks and poses."""
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
    """Return poses on the loop's clock, the tick that took in each, and the newest one's age at each tick, s."""
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
    """Return state and reasons of the first tick after the armed ones, in the words of safety."""
    after = (np.flatnonzero(armed)[-1] + 1) if armed.any() else len(outputs)
    if after >= len(outputs):
        return None
    reasons = outputs[after]["reasons"]
    return "finished" if "finished" in reasons else f"{outputs[after]['state']}: {', '.join(reasons)}".rstrip(": ")
