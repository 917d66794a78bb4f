"""Recorded flights: the trajectory, its recorder, and its files.

Shapes: N environments, M of them recorded, K steps of an episode, A action (4).
"""

from __future__ import annotations

import csv
import json
import os
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.tracks import Track, describe_track, load_track, read_track
from dreamer_racing.settings import POSITIVE

FINISHED, TIMEOUT = "finished", "timeout"
CRASHES = tuple(cause.name.lower() for cause in CrashCause if cause is not CrashCause.NONE)
"""Names of the crash causes; an episode's outcome is one of these, ``finished`` or ``timeout``."""
STATE = {
    "position": ("x", "y", "z"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "target_gate": ("target_gate",),
}
"""CSV columns of each field, in SI units."""
COLUMNS = ["t", *(column for names in STATE.values() for column in names)]
"""First CSV columns, with the time; those of the action, ``a0`` …, follow."""

HEAD = ("track", "control_dt", "outcome")
TILT = "camera_tilt"
"""Name of an optional header line after those of `HEAD`: the camera's tilt, if known."""
VALUE = "value"
"""Name of an optional column after the action: the critic's value, if the flight has one."""
OF_STEPS = ("action", VALUE)
"""Fields with a row per step; others have one per observation."""
NUMBERS, IMAGES = "_trajectory.csv", "_onboard.npz"
"""File name suffixes of the numbers and images of a flight."""
BROKEN_NPZ = (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading an `.npz` file raises if it is of another kind or incomplete."""


@dataclass(frozen=True)
class Trajectory:
    """One recorded episode of K control steps, all tensors on the CPU; row 0 is before the first step."""

    position: Tensor
    """(K + 1, 3) m."""
    attitude: Tensor
    """(K + 1, 4) unit quaternion wxyz, body → world."""
    linear_velocity: Tensor
    """(K + 1, 3) in the world, m/s."""
    target_gate: Tensor
    """(K + 1,) int64: the gate to pass next."""
    action: Tensor
    """(K, A): row k is the action from observation k to k + 1."""
    pixels: Tensor | None
    """(K + 1, H, W, 3) uint8, or None if the environment has no images."""
    control_dt: float
    """Duration of a control step, s."""
    outcome: str | None
    """How the episode ended; None if the recording stopped before its end."""
    value: Tensor | None = None
    """(K,): the critic's discounted return from row k on; None without a critic."""
    camera_tilt: float | None = None
    """Tilt of the camera upwards from the body's x axis, degrees; None without a camera, or if unknown."""
    imu: Tensor | None = None
    """(K + 1, 6) IMU measurements; None without an IMU, or if read from a file."""
    vector: Tensor | None = None
    """(K + 1, V) the observation ``vector``; None without one, or if read from a file."""

    @property
    def speed(self) -> Tensor:
        """(K + 1,) speed, m/s."""
        return self.linear_velocity.norm(dim=-1)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, s."""
        return (len(self.position) - 1) * self.control_dt

    @property
    def gates_passed(self) -> int:
        """Number of steps that changed the gate to pass next."""
        return int((self.target_gate.diff() != 0).sum())

    @property
    def crashed(self) -> bool:
        """Whether the episode ended in a crash."""
        return self.outcome in CRASHES

    @property
    def ending(self) -> str:
        """The outcome in words."""
        return (self.outcome or "recording stopped").replace("_", " ")

    def part(self, first: int, last: int) -> Trajectory:
        """Return rows ``first`` to ``last``, inclusive; the outcome is None if the last row is left out."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        rows: dict[str, Any] = {name: value[first : last + (name not in OF_STEPS)] for name, value in tensors.items()}
        return replace(self, **rows, outcome=self.outcome if last >= len(self.position) - 1 else None)


class TrajectoryRecorder:
    """Records the first episode of the first M environments, with one copy per step and entry for all of them.

    Args:
        root: the tensordict after the reset, batch size [N].
        count: M, at most N.
        pixels: whether to record ``pixels``, ``imu`` and ``vector``, if present.
    """

    def __init__(self, root: TensorDictBase, count: int, pixels: bool = True) -> None:
        self._pixels = pixels
        self._rows: dict[str, list[Tensor]] = defaultdict(list)  # each (M, ...)
        self._lengths = [0] * count
        self._outcomes: list[str | None] = [None] * count
        if count:
            self._observe(root)

    @property
    def running(self) -> bool:
        """Whether an episode is still being recorded."""
        return None in self._outcomes

    def add(self, step: TensorDictBase, outcomes: Sequence[str | None], value: Tensor | None = None) -> None:
        """Record a step: the action at the root and the observation under ``next``.

        Args:
            step: the tensordict of the step, batch size [N].
            outcomes: the outcome of each environment's episode, if it ended in this step; else None.
            value: critic's value of the root, (N, 1); pass it at every step or at none.
        """
        if not self.running:
            return
        self._rows["action"].append(self._copy(step["action"].float()))
        if value is not None:
            self._rows[VALUE].append(self._copy(value.float().squeeze(-1)))
        self._observe(step["next"])
        for index, outcome in enumerate(outcomes[: len(self._outcomes)]):
            if self._outcomes[index] is None:
                self._lengths[index] += 1
                self._outcomes[index] = outcome

    def trajectories(self, control_dt: float, camera_tilt: float | None = None) -> list[Trajectory]:
        """Return the M recordings; arguments as in `Trajectory`."""
        rows = {name: torch.stack(values) for name, values in self._rows.items()}  # each (K [+ 1], M, ...)
        cut = []
        for index, (length, outcome) in enumerate(zip(self._lengths, self._outcomes, strict=True)):
            own: dict[str, Any] = {
                name: values[: length + (name not in OF_STEPS), index].clone() for name, values in rows.items()
            }  # cloned, so that one recording does not keep the memory of all alive
            own = {"pixels": None, **own, "outcome": outcome}
            cut.append(Trajectory(**own, control_dt=control_dt, camera_tilt=camera_tilt))
        return cut

    def _observe(self, tensordict: TensorDictBase) -> None:
        for name in ("position", "attitude", "linear_velocity"):
            self._rows[name].append(self._copy(tensordict["privileged", name]))
        self._rows["target_gate"].append(self._copy(tensordict["privileged", "target_gate"].squeeze(-1)))
        for name in ("pixels", "imu", "vector") if self._pixels else ():
            if (seen := tensordict.get(name, None)) is not None:
                self._rows[name].append(self._copy(seen))

    def _copy(self, value: Tensor) -> Tensor:
        """Copy (N, ...) → (M, ...) to the CPU."""
        return value[: len(self._outcomes)].to("cpu", copy=True)


def write_trajectory(path: str | Path, trajectory: Trajectory, track: str | Path | Track) -> None:
    """Write an episode as CSV, atomically, with one row per observation, K + 1 in all.

    A row holds the observation, and the action and any critic's value at it. Numbers are exact to the last bit; images,
    ``imu`` and ``vector`` are left out. Header lines begin with `#`; one holds the track's full description.
    """
    fields = [getattr(trajectory, name).reshape(len(trajectory.position), -1).tolist() for name in STATE]
    steps, names = trajectory.action, [f"a{index}" for index in range(trajectory.action.shape[1])]
    if trajectory.value is not None:
        steps, names = torch.cat((steps, trajectory.value[:, None]), dim=1), [*names, VALUE]
    actions = [*steps.tolist(), [""] * len(names)]  # the last observation has no action
    with swapped_in(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        course = json.dumps(describe_track(load_track(track)))
        head = (course, repr(trajectory.control_dt), trajectory.outcome or "none")
        file.writelines(f"# {name}: {value}\n" for name, value in zip(HEAD, head, strict=True))
        if trajectory.camera_tilt is not None:
            file.write(f"# {TILT}: {trajectory.camera_tilt!r}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *names])
        for index, row in enumerate(zip(*fields, actions, strict=True)):
            # 9 digits are read back as the same float32.
            cells = [f"{cell:.9g}" if isinstance(cell, float) else cell for part in row for cell in part]
            writer.writerow([f"{index * trajectory.control_dt:.6g}", *cells])


@contextmanager
def swapped_in(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path with the suffix of a file, and replace the file by it when the block succeeds.

    Missing folders are created. The file is unchanged if the block fails.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_trajectory(path: str | Path) -> tuple[Trajectory, Track]:
    """Read an episode, without images, and its track from a file written by `write_trajectory`.

    Raises:
        ValueError: the file is of another kind or truncated.
        TrackError: its track is invalid.
        OSError: it cannot be read.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    head = dict(line[2:].partition(": ")[::2] for line in lines if line.startswith("# "))
    try:
        rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    except csv.Error as error:
        raise ValueError(f"{path} holds no trajectory: {error}.") from error
    if not head.keys() >= set(HEAD) or not rows or rows[0][: len(COLUMNS)] != COLUMNS:
        raise ValueError(f"{path} holds no trajectory: its columns should be {', '.join(COLUMNS)}, a0 ...")
    header, *rows = rows
    actions = len(header) - len(COLUMNS)
    whole = all(len(row) == len(header) for row in rows) and text.endswith("\n")
    if not whole or len(rows) < 2 or any(rows[-1][-actions:]):
        raise ValueError(f"{path} was cut short: the last row, which has no action, is missing.")
    try:
        numbers = {name: _columns(rows, [header.index(column) for column in names]) for name, names in STATE.items()}
        steps = _columns(rows[:-1], list(range(len(COLUMNS), len(header))))
        control_dt, tilt = float(head["control_dt"]), float(head[TILT]) if TILT in head else None
    except ValueError as error:
        raise ValueError(f"{path} has a cell that is not a number: {error}.") from error
    if control_dt not in POSITIVE:
        raise ValueError(f"{path}: control_dt is {control_dt:g}, not a number above 0.")
    gate = numbers.pop("target_gate").flatten().long()
    judged = header[-1] == VALUE
    trajectory = Trajectory(
        **numbers,
        target_gate=gate,
        action=steps[:, :-1] if judged else steps,
        pixels=None,
        control_dt=control_dt,
        outcome=None if head["outcome"] == "none" else head["outcome"],
        value=steps[:, -1] if judged else None,
        camera_tilt=tilt,
    )
    try:
        course = json.loads(head["track"])
    except ValueError as error:
        raise ValueError(f"{path} holds no track: {error}.") from error
    return trajectory, read_track(course, str(path))


def write_flight(stem: str | Path, trajectory: Trajectory, track: str | Path | Track) -> list[str]:
    """Write an episode as `<stem>_trajectory.csv` and its images, if any, as `<stem>_onboard.npz`; return the names."""
    numbers, images = _files(stem)
    images.unlink(missing_ok=True)  # of an earlier flight with the same name
    write_trajectory(numbers, trajectory, track)
    if trajectory.pixels is None:
        return [numbers.name]
    with swapped_in(images) as partial:
        np.savez_compressed(partial, pixels=trajectory.pixels.numpy())
    return [numbers.name, images.name]


def read_flight(path: str | Path) -> tuple[Trajectory, Track]:
    """Read an episode and its track from `*_trajectory.csv`, with the images if their file is in the same folder.

    Raises:
        ValueError: a file is of another kind or truncated, or the images belong to another flight.
        OSError: a file cannot be read.
    """
    trajectory, track = read_trajectory(path)
    _, images = _files(Path(path).with_name(Path(path).name.removesuffix(NUMBERS)))
    if not str(path).endswith(NUMBERS) or not images.is_file():
        return trajectory, track
    try:
        with np.load(images) as file:
            pixels = torch.from_numpy(file["pixels"])
    except BROKEN_NPZ as error:
        raise ValueError(f"{images} holds no images of a flight, or only some of them: {error}.") from error
    if pixels.ndim != 4 or len(pixels) != len(trajectory.position) or pixels.dtype != torch.uint8:
        raise ValueError(
            f"{images} holds {tuple(pixels.shape)} {pixels.dtype}, but {path} has {len(trajectory.position)} rows: "
            "these files are from different flights."
        )
    return replace(trajectory, pixels=pixels), track


def _files(stem: str | Path) -> tuple[Path, Path]:
    return Path(f"{stem}{NUMBERS}"), Path(f"{stem}{IMAGES}")


def _columns(rows: list[list[str]], columns: list[int]) -> torch.Tensor:
    return torch.tensor([[float(row[column]) for column in columns] for row in rows], dtype=torch.float64).float()
