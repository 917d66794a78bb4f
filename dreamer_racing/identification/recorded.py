"""Recordings of a vehicle's commands and of its response, on a grid of 1 ms.

Shapes: T ms.
"""

from __future__ import annotations

import csv
import gzip
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters
from dreamer_racing.hil.attitude import rotation_between, rotation_matrix
from dreamer_racing.hil.configuration import thrust_map, without_body_rates
from dreamer_racing.hil.recording import Flight
from dreamer_racing.hil.sticks import ThrustMap

DT = 0.001  # s, step of the grid

AXES = ("roll", "pitch", "yaw", "thrust")
UNITS = ("rad/s", "rad/s", "rad/s", "m/s²")

FASTEST = 500.0
"""rad/s² beyond which rates have jumped by a reset of the body, not in flight [choice]: small racers reach 440."""

LONGEST_GAP = 0.05  # s without a measurement over which nothing is interpolated [choice]

MIN_EXCITATION = (0.4, 0.4, 0.3, 0.8)
"""Least standard deviation of each axis's commands within a window for it to count as moved, in `UNITS` [choice]:
below, noise and model errors are as large as the response."""
MIN_SECONDS = (2.0, 2.0, 3.0, 2.0)  # s for which each axis must be moved [choice]: yaw, which is slow, for longer
WINDOW = 1.0  # s over which variation is measured [choice]


@dataclass(frozen=True)
class Recorded:
    """A recording of T ms."""

    command: np.ndarray  # (T, 4) commanded collective thrust, m/s², and body rates, rad/s; held until the next command
    fresh: np.ndarray  # (T,) bool: where a command was sent
    rates: np.ndarray  # (T, 3) measured body rates, rad/s; NaN where nothing was measured
    force: np.ndarray  # (T,) measured specific force along body z, m/s²; NaN where nothing was measured
    thrust_map: ThrustMap | None = None  # by which the link set the throttle, if it did

    def drone(self, nominal: QuadrotorParameters) -> QuadrotorParameters:
        """Return a drone with the mass and the full thrust that the link assumed, if known."""
        if self.thrust_map is None:
            return nominal
        mass = self.thrust_map.mass
        return replace(nominal, mass=mass, rotor_thrust_max=mass * self.thrust_map.collective_thrust_max / 4)

    def excited_seconds(self) -> tuple[float, ...]:
        """Return for how long each axis was moved while it was measured, s: roll, pitch, yaw, thrust."""
        asked = np.column_stack((self.command[:, 1:], self.command[:, 0]))
        seen = np.isfinite(self.rates).all(1)
        size = round(WINDOW / DT)
        windows = [slice(begin, begin + size) for begin in range(0, len(asked) - size + 1, size)]
        deviation = np.array([asked[part].std(0) if seen[part].mean() > 0.9 else np.zeros(4) for part in windows])
        if not len(deviation):
            return 0.0, 0.0, 0.0, 0.0
        return tuple(float(WINDOW * count) for count in (deviation > MIN_EXCITATION).sum(0))

    def check(self, source: str | Path) -> None:
        """Refuse a recording that is too short or too quiet for a fit.

        Raises:
            ValueError: The message says which axis needs what.
        """
        asked, lacking = np.column_stack((self.command[:, 1:], self.command[:, 0])), []
        for index, (axis, seconds) in enumerate(zip(AXES, self.excited_seconds(), strict=True)):
            if seconds < MIN_SECONDS[index]:
                lacking.append(
                    f"{axis} was excited for {seconds:g} s, but needs {MIN_SECONDS[index]:g} s in which its commands' "
                    f"standard deviation is at least {MIN_EXCITATION[index]:g} {UNITS[index]} "
                    f"(of the whole recording: {asked[:, index].std():.2g})"
                )
        if lacking:
            raise ValueError(
                f"{source} is too short or too quiet: {'; '.join(lacking)}. actor=identify of recipes/hil.py flies a "
                "suitable flight."
            )


def read_recorded(path: str | Path) -> Recorded:
    """Read a flight of `recipes/hil.py`, or a table (``.csv``, ``.csv.gz``) as `read_table` does.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is neither, or was never armed.
    """
    path = Path(path)
    if path.name.endswith((".csv", ".csv.gz")):
        return read_table(path)
    return of_flight(Flight(path))


def read_table(path: Path) -> Recorded:
    """Read a table, a row per ms: ``t`` s, ``thrust_cmd`` m/s², ``wx_cmd wy_cmd wz_cmd`` and ``wx wy wz`` rad/s, FLU.

    The force is column ``az`` (specific force along body z, m/s²), if there is one.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no recording {path}.")
    try:
        with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
            rows = list(csv.DictReader(file))
    except EOFError as error:
        raise ValueError(f"{path} is cut off: {error}.") from error
    names = ("t", "thrust_cmd", "wx_cmd", "wy_cmd", "wz_cmd", "wx", "wy", "wz")
    if not rows or (lacking := [name for name in names if name not in rows[0]]):
        raise ValueError(
            f"{path} lacks {', '.join(lacking if rows else names)}: see `read_table` for the required columns."
        )
    time, *columns = (_column(path, rows, name, name in names[:5]) for name in names)
    force = _column(path, rows, "az", False) if "az" in rows[0] else np.full(len(rows), np.nan)
    command = np.column_stack(columns[:4])
    changes = np.flatnonzero(np.concatenate(([True], (np.diff(command, axis=0) != 0).any(1))))
    return _on_grid(time[changes], command[changes], time, np.column_stack(columns[4:]), time, force)


def _column(path: Path, rows: Sequence[Mapping[str, str | None]], name: str, complete: bool) -> np.ndarray:
    """Return a column of numbers; only ``complete`` ones may not be NaN, as where nothing was measured."""
    numbers = np.full(len(rows), np.inf)
    for index, row in enumerate(rows):
        with suppress(TypeError, ValueError):
            numbers[index] = float(row[name] or "")
        if np.isinf(numbers[index]) or (complete and np.isnan(numbers[index])):
            raise ValueError(f"{path}, line {index + 2}: {name} is {row[name]!r}, not a finite number.")
    return numbers


def of_flight(flight: Flight) -> Recorded:
    """Put the armed part of a flight of `recipes/hil.py` on the grid.

    Raises:
        ValueError: It was never armed.
    """
    sent = [(tick["in"]["time"] + tick["took"]["sent"], tick["out"]["command"]) for tick in flight.ticks]
    armed = [(time, command[1:]) for time, command in sent if command[0]]
    if not armed:
        raise ValueError("This flight was never armed: there is nothing to fit.")
    poses = np.array([packet for tick in flight.ticks for packet in tick["in"]["received"]], float)
    poses = poses[np.unique(poses[:, 2], return_index=True)[1]]  # sorted by timestamp, without duplicates
    config = flight.about.get("config") or {}
    latency = float(config.get("latency") or 0.0)
    time = poses[:, 2] + (poses[:, 0] - poses[:, 2]).min() - latency  # s, by the loop's clock
    within = (time >= armed[0][0]) & (time <= armed[-1][0])
    time, poses = time[within], poses[within]
    force_time, force = _specific_force(time, poses)
    command_time, command = (np.array(column) for column in zip(*armed, strict=True))
    rate_time, rates = time, poses[:, 13:16]
    if without_body_rates(config):
        rate_time, rates = rates_between(time, poses[:, 6:10])
    recorded = _on_grid(command_time, command, rate_time, rates, force_time, force)
    return replace(recorded, thrust_map=thrust_map(config))


def rates_between(time: np.ndarray, attitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times (M,), s, and body rates then (M, 3), rad/s, each from two attitudes with one pose between them.

    Times (N,) are those of the attitudes (N, 4), wxyz; M is at most N − 2.

    They do not lag, unlike those that the flight used, which are filtered (`smoothing=`). None spans a gap.
    """
    turned = np.array([rotation_between(*pair) for pair in zip(attitude[:-2], attitude[2:], strict=True)])
    apart = time[2:] - time[:-2]
    kept = apart <= LONGEST_GAP
    return (0.5 * (time[2:] + time[:-2]))[kept], (turned / np.maximum(apart, 1e-6)[:, None])[kept]


def _specific_force(time: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times between poses, s, and specific forces along body z then, m/s²."""
    velocity, attitude = poses[:, 10:13], poses[:, 6:10]
    step = np.diff(time)
    acceleration = np.diff(velocity, axis=0) / np.maximum(step, 1e-6)[:, None] + (0.0, 0.0, GRAVITY)
    up = np.array([rotation_matrix(each)[:, 2] for each in attitude])
    middle = up[1:] + up[:-1]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return time[:-1] + 0.5 * step, (acceleration * middle).sum(1)


def _on_grid(
    command_time: np.ndarray,
    command: np.ndarray,
    time: np.ndarray,
    rates: np.ndarray,
    force_time: np.ndarray,
    force: Any,
) -> Recorded:
    """Hold commands, and interpolate measurements, on a grid of `DT` from the first command to the last measurement."""
    begin = command_time[0]
    grid = begin + DT * np.arange(max(int((time[-1] - begin) / DT), 1) if len(time) else 1)
    newest = np.searchsorted(command_time, grid + 1e-9, side="right") - 1
    fresh = np.zeros(len(grid), bool)
    fresh[np.flatnonzero(np.diff(newest, prepend=-1))] = True
    measured = _interpolate(grid, time, rates)
    jumps = np.abs(np.diff(measured, axis=0, prepend=measured[:1])) > FASTEST * DT
    measured[jumps.any(1)] = np.nan
    return Recorded(command[newest], fresh, measured, _interpolate(grid, force_time, force[:, None])[:, 0])


def _interpolate(grid: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values (T, K) to the grid; NaN in gaps."""
    if len(time) < 2:
        return np.full((len(grid), values.shape[1]), np.nan)
    columns = np.column_stack([np.interp(grid, time, column) for column in values.T])
    after = np.searchsorted(time, grid).clip(1, len(time) - 1)
    gap = (time[after] - time[after - 1] > LONGEST_GAP) | (grid < time[0]) | (grid > time[-1])
    columns[gap] = np.nan
    return columns


def stretches(recorded: Recorded, seconds: float, overlap: float) -> Sequence[slice]:
    """Return windows of ``seconds`` s that overlap by ``overlap`` s, in which all rates were measured throughout."""
    size, step = round(seconds / DT), round((seconds - overlap) / DT)
    seen = np.isfinite(recorded.rates).all(1)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], seen, [False]))))
    return [
        slice(begin, begin + size)
        for first, end in edges.reshape(-1, 2)
        for begin in range(first, end - size + 1, step)
    ]
