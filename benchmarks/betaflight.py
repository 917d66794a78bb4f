"""Comparison of the simulated Betaflight rate loop with a recording of the unmodified firmware.

    python benchmarks/betaflight.py --recording tests/envs/drone/betaflight_firmware.csv.gz
    python benchmarks/betaflight.py --recording steps_seed0.csv.gz --json results/betaflight.json

A recording has a row per ms: `phase`; `t` s; channels `A E T R` in µs, AETR; body rates `wx wy wz` in rad/s, FLU;
motor commands `M1..M4` in [0, 1]; commanded rates `wx_cmd wy_cmd wz_cmd` in rad/s. Phases `random_<Hz>hz_<scale>` are
compared, each from the preceding reset of the body: the model gets the recording's channels and flies the recording's
drone (rigid, motor time constant 30 ms on thrust, explicit Euler at 1 kHz) open loop; its rates and motor commands are
compared with the recorded ones.

The operating system paused the recorded firmware's process at times, for 4 to 500 ms: all four motor commands stay
exactly constant while rates change. Rows `with pauses` pause the model's firmware then, too, and count everything after
it. Rows `between pauses` restart from the recorded rates after each pause, and leave out 50 ms after it.
Columns: `x`, `y`, `z` are the RMS errors of body rates relative to the RMS of the commanded ones, in %; `motors` is the
RMS error of motor commands; `thrust` the error of mean thrust in %.
"""

import csv
import gzip
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from measuring import make_parser, report
from torch import Tensor

from dreamer_racing.envs.drone.betaflight import P_SCALE, full_stick
from dreamer_racing.envs.drone.parameters import PRESETS, ROTOR_SPINS, QuadrotorParameters
from dreamer_racing.envs.drone.rate_loop import RateLoop, Row

DT = 0.001  # s, time step of the recording
DELAY = 0.011  # s, from a row's channels to the firmware's resulting motor commands
KINDS = ("between pauses", "with pauses")
AFTER = 0.05  # s after a pause that are left out
SETTLED = 30  # steps after a reset until the motor commands show the (slowly changing) yaw integral
COLUMNS = ("scale", "rows", "seconds", "x", "y", "z", "motors", "thrust")
DRONE = replace(PRESETS["betaflight"], randomisation=None)


class Recording(NamedTuple):
    """A recording of K rows.

    Args:
        phase: (K,) names of phases.
        time: (K,) s.
        channels: (K, 4) µs, AETR.
        rates: (K, 3) rad/s.
        motors: (K, 4) in [0, 1].
        commanded: (K, 3) rad/s.
    """

    phase: np.ndarray
    time: np.ndarray
    channels: np.ndarray
    rates: np.ndarray
    motors: np.ndarray
    commanded: np.ndarray


class Flights(NamedTuple):
    """Batch of N phases of T steps on a grid of 1 ms; a missing row repeats the last recorded one.

    Args:
        scale: (N,) scales of the commands.
        channels: (T, N, 4) µs.
        rates: (T, N, 3) rad/s.
        motors: (T, N, 4).
        commanded: (T, N, 3) rad/s.
        counted: (T, N) bool: recorded, and in the phase itself, not before it.
        paused: (T, N) bool: the firmware was paused.
    """

    scale: list[str]
    channels: Tensor
    rates: Tensor
    motors: Tensor
    commanded: Tensor
    counted: Tensor
    paused: Tensor


def read_recording(path: str | Path) -> Recording:
    """Read a recording, compressed or not."""
    data = Path(path).read_bytes()
    text = (gzip.decompress(data) if str(path).endswith(".gz") else data).decode()
    rows = list(csv.DictReader(text.splitlines()))
    columns = ("t",), ("A", "E", "T", "R"), ("wx", "wy", "wz"), ("M1", "M2", "M3", "M4"), ("wx_cmd", "wy_cmd", "wz_cmd")
    time, *rest = (np.array([[float(row[name]) for name in names] for row in rows]) for names in columns)
    return Recording(np.array([row["phase"] for row in rows]), time[:, 0], *rest)


def find_pauses(recording: Recording, shortest: int = 4) -> np.ndarray:
    """Return the rows in which the firmware was paused, (K,) bool.

    In a pause, the motor commands are constant for several ms, not all at their limits, while a rate changes by more
    than 7.5 rad/s², which would change a motor command by more than a digit.
    """
    motors, rates = recording.motors, recording.rates
    same = np.concatenate([[False], (np.diff(motors, axis=0) == 0).all(1)])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    paused = np.zeros(len(same), dtype=bool)
    for first, end in edges.reshape(-1, 2):
        at_limits = ((motors[first] > 0.99) | (motors[first] < 0.06)).all()
        changed = np.abs(rates[end - 1] - rates[first - 1]).max()
        paused[first:end] = end - first >= shortest and not at_limits and changed > 0.0075 * (end - first)
    return paused


def cut(recording: Recording) -> Flights:
    """Return the random phases as a batch, each with the preceding phase prepended."""
    begins = np.flatnonzero(np.concatenate([[True], recording.phase[1:] != recording.phase[:-1]]))
    ends = np.append(begins[1:], len(recording.phase))
    paused = find_pauses(recording)
    parts, scales = [], []
    for index, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        name = recording.phase[begin]
        if not name.startswith("random_"):
            continue
        first = begins[index - 1] if index and not recording.phase[begins[index - 1]].startswith("random_") else begin
        place = np.round((recording.time[first:end] - recording.time[first]) / DT).astype(int)  # grid index of each row
        grid = np.searchsorted(place, np.arange(place[-1] + 1), side="right") - 1  # last recorded row
        recorded = place[grid] == np.arange(len(grid))
        counted = recorded & (grid >= begin - first)
        fields = (recording.channels, recording.rates, recording.motors, recording.commanded, paused)
        parts.append([*(values[first:end][grid] for values in fields), counted])
        scales.append(name.rsplit("_", 1)[1])
    longest = max(len(part[0]) for part in parts)

    def together(field: int) -> Tensor:
        """Stack a field of all parts, (T, N, ·), padding shorter ones with their last row."""
        columns = [part[field] for part in parts]
        filled = [np.concatenate([rows, np.repeat(rows[-1:], longest - len(rows), axis=0)]) for rows in columns]
        return torch.from_numpy(np.stack(filled, axis=1))

    channels, rates, motors, commanded, still, counted = map(together, range(6))
    for index, part in enumerate(parts):
        counted[len(part[0]) :, index] = False
    return Flights(scales, channels, rates, motors, commanded, counted, still)


def setpoints(channels: Tensor, drone: QuadrotorParameters, loop: RateLoop) -> Tensor:
    """Convert channels (T, N, 4) in µs to setpoints (T, N, 4) in N and rad/s."""
    p = loop.parameters
    share = ((channels[..., 2:3] - p.min_check) / (2000.0 - p.min_check)).clamp(0.0, 1.0)
    thrust = 4.0 * drone.rotor_thrust_max * (p.motor_idle + (1.0 - p.motor_idle) * share).square()
    sticks = (channels[..., [0, 1, 3]] - 1500.0) / 500.0 * torch.tensor([1.0, 1.0, -1.0])
    full_sticks = torch.tensor([full_stick(rate) for rate in drone.body_rate_max])  # (3,) deg/s
    return torch.cat((thrust, torch.deg2rad(sticks * full_sticks)), dim=-1)


def fly(flights: Flights, drone: QuadrotorParameters = DRONE, led: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Simulate flights with the recording's channels.

    Args:
        flights: the recorded phases.
        drone: parameters of the drone.
        led: (T, N) bool: where to replace the body's rates by the recorded ones.

    Returns:
        Body rates (T, N, 3) in rad/s and motor commands (T, N, 4).
    """
    steps, number = flights.paused.shape
    loop = RateLoop(drone, number)
    late = round(DELAY / DT)
    asked = setpoints(flights.channels, drone, loop)
    asked = torch.cat((asked[:1].expand(late, -1, -1), asked[:-late]))
    moved = torch.cat((torch.zeros(1, number, dtype=torch.bool), (asked[1:] != asked[:-1]).any(-1)))
    x, y = torch.tensor(drone.rotor_positions, dtype=torch.float64).unbind(1)
    spins = torch.tensor(ROTOR_SPINS, dtype=torch.float64) * drone.torque_constant
    effect, inertia = torch.stack((y, -x, spins), 1), torch.tensor(drone.inertia, dtype=torch.float64)
    rates, commands = flights.rates[0].clone(), flights.motors[0].clone()
    thrusts = drone.rotor_thrust_max * commands.square()
    path = []
    for step in range(steps):
        loop.state[:, Row.THROTTLE, 2].masked_fill_(moved[step], 0.0)  # a frame has arrived, even if the clocks drifted
        if step == SETTLED:
            loop.state[:, Row.I, 2] = _yaw_integral(flights.motors[step], flights.rates[step], loop)
        still, before = flights.paused[step].unsqueeze(1), loop.state.clone()
        new = loop.motor_commands(asked[step], rates)
        loop.state.copy_(torch.where(still.unsqueeze(2), before, loop.state))
        commands = torch.where(still, flights.motors[step], new)
        thrusts = thrusts + DT / drone.motor_time_constant * (drone.rotor_thrust_max * commands.square() - thrusts)
        torque = thrusts @ effect - torch.linalg.cross(rates, inertia * rates)
        rates = rates + DT * torque / inertia
        if led is not None:
            rates = torch.where(led[step].unsqueeze(1), flights.rates[step], rates)
        path.append((rates, commands))
    return torch.stack([rates for rates, _ in path]), torch.stack([motors for _, motors in path])


def _yaw_integral(motors: Tensor, rates: Tensor, loop: RateLoop) -> Tensor:
    """Return the yaw integral (N,): the yaw correction in the motor commands minus its P term."""
    total = 250.0 / (1.0 - loop.parameters.motor_idle) * (motors @ torch.tensor(ROTOR_SPINS, dtype=torch.float64))
    return total - P_SCALE * loop.parameters.p[2] * (loop.state[:, Row.SETPOINT, 2] - torch.rad2deg(rates[:, 2]))


def compare(flights: Flights, drone: QuadrotorParameters = DRONE, kinds: Sequence[str] = KINDS) -> list[dict[str, Any]]:
    """Return a record of errors for each scale and kind of rows."""
    reach = round(AFTER / DT)
    pauses = flights.paused.cumsum(0)
    since = pauses > torch.cat((torch.zeros_like(pauses[:reach]), pauses[:-reach]))  # (T, N): in a pause or after it
    records = []
    for kind in kinds:
        led = since if kind == KINDS[0] else None
        rates, motors = fly(flights, drone, led)
        for scale in sorted(set(flights.scale)):
            chosen = torch.tensor([name == scale for name in flights.scale]) & flights.counted
            chosen = chosen if led is None else chosen & ~led
            error, commanded = rates[chosen] - flights.rates[chosen], flights.commanded[chosen]
            axes = 100.0 * (error.square().mean(0) / commanded.square().mean(0)).sqrt()
            thrust, flown = motors[chosen].square().mean(), flights.motors[chosen].square().mean()
            records.append({
                "scale": scale,
                "rows": kind,
                "seconds": float(chosen.sum() * DT),
                **dict(zip("xyz", axes.tolist(), strict=True)),
                "motors": float((motors[chosen] - flights.motors[chosen]).square().mean().sqrt()),
                "thrust": float(100.0 * (thrust / flown - 1.0)),
            })  # fmt: skip
    return records


def main() -> None:
    """Compare the model with the recording and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--recording", required=True, help="CSV, may be compressed")
    arguments = parser.parse_args()
    report(compare(cut(read_recording(arguments.recording))), COLUMNS, arguments.json)


if __name__ == "__main__":
    main()
