"""One recorded flight, and the recorder that makes it.

Shapes: N environments, M of them recorded, K steps of an episode, A action (4).
"""

from __future__ import annotations

import csv
import json
import os
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.tracks import Track, describe_track, load_track, read_track

FINISHED, TIMEOUT = "finished", "timeout"
CRASHES = tuple(cause.name.lower() for cause in CrashCause if cause is not CrashCause.NONE)
"""Names of the causes of a crash; an episode's outcome is one of these, ``finished`` or ``timeout``."""
STATE = {
    "position": ("x", "y", "z"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "target_gate": ("target_gate",),
}
"""Columns of each field, in SI units, beside the time ``t`` and the action ``a0`` …"""

HEAD = ("track", "control_dt", "outcome")
TILT = "camera_tilt"
"""Line above the columns, after those of `HEAD`; only in files of flights whose camera is known."""
VALUE = "value"
"""Column of what a critic expected, behind the action; only in files of flights that one judged."""
NUMBERS, IMAGES = "_trajectory.csv", "_onboard.npz"
"""Ends of the names of a stored flight's two files."""


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
    """(K, A): row k leads from k to k + 1."""
    pixels: Tensor | None
    """(K + 1, H, W, 3) uint8, or None if the environment has no images."""
    control_dt: float
    """Duration of a step, s."""
    outcome: str | None
    """How the episode ended; None if the recording was stopped before its end."""
    value: Tensor | None = None
    """(K,): the return that a critic expected from row k on, discounted as in training; None if none judged."""
    camera_tilt: float | None = None
    """Of the camera that it was flown by, upwards from the body's x axis, degrees; None without one, or unknown."""
    imu: Tensor | None = None
    """(K + 1, 6) what the drone's IMU told beside the images; None without one, and in files."""
    vector: Tensor | None = None
    """(K + 1, V) numbers that the agent saw, likewise."""

    @property
    def speed(self) -> Tensor:
        """(K + 1,) m/s."""
        return self.linear_velocity.norm(dim=-1)

    def part(self, first: int, last: int) -> Trajectory:
        """Return the stretch from row ``first`` to row ``last``, both included; its end is open if it is cut off."""
        rows = {name: getattr(self, name)[first : last + 1] for name in ("position", "attitude", "linear_velocity")}
        return Trajectory(
            **rows,
            target_gate=self.target_gate[first : last + 1],
            action=self.action[first:last],
            pixels=None if self.pixels is None else self.pixels[first : last + 1],
            control_dt=self.control_dt,
            outcome=self.outcome if last >= len(self.position) - 1 else None,
            value=None if self.value is None else self.value[first:last],
            camera_tilt=self.camera_tilt,
            imu=None if self.imu is None else self.imu[first : last + 1],
            vector=None if self.vector is None else self.vector[first : last + 1],
        )

    @property
    def crashed(self) -> bool:
        """Whether the last row is where the drone crashed."""
        return self.outcome in CRASHES


class TrajectoryRecorder:
    """Records the first episode of the first M environments, all of them with one copy per step and entry.

    Args:
        root: after the reset, batch size [N].
        count: M, at most N.
        max_steps: a recording stops here, K at most.
        pixels: whether to keep images too, where there are any.
    """

    def __init__(self, root: TensorDictBase, count: int, max_steps: float, pixels: bool = True) -> None:
        self._max_steps = max_steps
        self._pixels = pixels
        self._rows: dict[str, list[Tensor]] = defaultdict(list)  # each (M, ...)
        self._lengths = [0] * count
        self._outcomes: list[str | None] = [None] * count
        self._running = [True] * count
        if count:
            self._observe(root)

    @property
    def running(self) -> bool:
        """Whether there is an episode still to be recorded."""
        return any(self._running)

    def add(self, step: TensorDictBase, outcomes: Sequence[str | None], value: Tensor | None = None) -> None:
        """Record a step, its action at the root and its observation under ``next``.

        Args:
            step: batch size [N].
            outcomes: how the episode of each of the N environments ended in this step; None if it goes on.
            value: what a critic made of the root, (N, 1); given at every step or at none.
        """
        if not self.running:
            return
        self._rows["action"].append(self._copy(step["action"].float()))
        if value is not None:
            self._rows[VALUE].append(self._copy(value.float().squeeze(-1)))
        self._observe(step["next"])
        for index, outcome in enumerate(outcomes[: len(self._running)]):
            if self._running[index]:
                self._lengths[index] += 1
                self._outcomes[index] = outcome
                self._running[index] = outcome is None and self._lengths[index] < self._max_steps

    def trajectories(self, control_dt: float, camera_tilt: float | None = None) -> list[Trajectory]:
        """Return the M recordings.

        Args:
            control_dt: duration of a step, s.
            camera_tilt: as recordings have it.
        """
        rows = {name: torch.stack(values) for name, values in self._rows.items()}  # each (K [+ 1], M, ...)
        cut = []
        for index, (length, outcome) in enumerate(zip(self._lengths, self._outcomes, strict=True)):
            own: dict[str, Any] = {
                name: values[: length + (name not in ("action", VALUE)), index].clone() for name, values in rows.items()
            }  # clones, so that one recording does not keep all alive
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
        """(N, ...) → (M, ...) on the CPU, not changed by later steps."""
        return value[: len(self._running)].to("cpu", copy=True)


def write_trajectory(path: str | Path, trajectory: Trajectory, track: str | Path | Track) -> None:
    """Write an episode as CSV: a row an observation, K + 1 of them, the action beside the one it was taken at.

    So is the value, where a critic judged. Images are left out; every other number is kept to the last bit. Lines with
    `#` say what there is besides rows.

    Args:
        path: the file; missing folders are made.
        trajectory: the episode.
        track: what it was flown on, as `load_track` takes it; the file holds all of it.
    """
    fields = [getattr(trajectory, name).reshape(len(trajectory.position), -1).tolist() for name in STATE]
    steps, names = trajectory.action, [f"a{index}" for index in range(trajectory.action.shape[1])]
    if trajectory.value is not None:
        steps, names = torch.cat((steps, trajectory.value[:, None]), dim=1), [*names, VALUE]
    actions = [*steps.tolist(), [""] * len(names)]  # none at the last observation
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    partial = Path(path).with_name(f".{Path(path).name}.partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        course = json.dumps(describe_track(load_track(track)))
        head = (course, repr(trajectory.control_dt), trajectory.outcome or "none")
        file.writelines(f"# {name}: {value}\n" for name, value in zip(HEAD, head, strict=True))
        if trajectory.camera_tilt is not None:
            file.write(f"# {TILT}: {trajectory.camera_tilt!r}\n")
        writer = csv.writer(file, lineterminator="\n")
        columns = [column for names in STATE.values() for column in names]
        writer.writerow(["t", *columns, *names])
        for index, row in enumerate(zip(*fields, actions, strict=True)):
            writer.writerow([f"{index * trajectory.control_dt:.6g}", *(_text(cell) for cells in row for cell in cells)])
    os.replace(partial, path)


def read_trajectory(path: str | Path) -> tuple[Trajectory, Track]:
    """Read what `write_trajectory` wrote.

    Returns:
        The episode, without images, and its track.

    Raises:
        ValueError: this is no such file, or it was cut short.
        TrackError: its track cannot be flown.
        OSError: it cannot be read.
    """
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    head = dict(line[2:].partition(": ")[::2] for line in lines if line.startswith("# "))
    try:
        rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    except csv.Error as error:
        raise ValueError(f"{path} holds no trajectory: {error}.") from error
    expected = ["t", *(column for names in STATE.values() for column in names)]
    if not head.keys() >= set(HEAD) or not rows or rows[0][: len(expected)] != expected:
        raise ValueError(f"{path} holds no trajectory: its columns should be {', '.join(expected)}, a0 ...")
    header, *rows = rows
    actions = len(header) - len(expected)
    whole = all(len(row) == len(header) for row in rows) and text.endswith("\n")
    if not whole or len(rows) < 2 or any(rows[-1][-actions:]):
        raise ValueError(f"{path} was cut short: the last row, which has no action, is missing.")
    try:
        numbers = {name: _columns(rows, [header.index(column) for column in names]) for name, names in STATE.items()}
        steps = _columns(rows[:-1], list(range(len(expected), len(header))))
        control_dt, tilt = float(head["control_dt"]), float(head[TILT]) if TILT in head else None
    except ValueError as error:
        raise ValueError(f"{path} holds a cell that is no number: {error}.") from error
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
    return trajectory, _read_track(head["track"], path)


def _read_track(text: str, path: str | Path) -> Track:
    """Read the track that a file holds."""
    try:
        content = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path} holds no track: {error}.") from error
    return read_track(content, str(path))


def write_flight(stem: str | Path, trajectory: Trajectory, track: str | Path | Track) -> list[str]:
    """Write an episode with its images: `<stem>_trajectory.csv` and, of one that has some, `<stem>_onboard.npz`.

    Args:
        stem: folder and beginning of both files' names.
        trajectory: the episode.
        track: what it was flown on, as `load_track` takes it.

    Returns:
        The files' names.
    """
    numbers, images = _files(stem)
    images.unlink(missing_ok=True)  # of an earlier flight: it must not be taken for this one's
    write_trajectory(numbers, trajectory, track)
    if trajectory.pixels is None:
        return [numbers.name]
    partial = images.with_name(f".{images.name}.partial.npz")
    np.savez_compressed(partial, pixels=trajectory.pixels.numpy())
    os.replace(partial, images)
    return [numbers.name, images.name]


def read_flight(path: str | Path) -> tuple[Trajectory, Track]:
    """Read what `write_flight` or `write_trajectory` wrote.

    Args:
        path: of the numbers, `*_trajectory.csv`.

    Returns:
        The episode, with images if they lie beside it, and its track.

    Raises:
        ValueError: a file is none of these, was cut short, or the images are not those of the flight.
        OSError: it cannot be read.
    """
    trajectory, track = read_trajectory(path)
    _, images = _files(Path(path).with_name(Path(path).name.removesuffix(NUMBERS)))
    if not str(path).endswith(NUMBERS) or not images.is_file():
        return trajectory, track
    try:
        with np.load(images) as file:
            pixels = torch.from_numpy(file["pixels"])
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{images} holds no images of a flight, or half of them: {error}.") from error
    if pixels.ndim != 4 or len(pixels) != len(trajectory.position) or pixels.dtype != torch.uint8:
        raise ValueError(
            f"{images} holds {tuple(pixels.shape)} {pixels.dtype}, but {path} has {len(trajectory.position)} rows: "
            "these files are of two flights."
        )
    return replace(trajectory, pixels=pixels), track


def _files(stem: str | Path) -> tuple[Path, Path]:
    """Where the numbers and the images of a flight are kept."""
    return Path(f"{stem}{NUMBERS}"), Path(f"{stem}{IMAGES}")


def _columns(rows: list[list[str]], columns: list[int]) -> torch.Tensor:
    """Parse columns of the rows as float32."""
    return torch.tensor([[float(row[column]) for column in columns] for row in rows], dtype=torch.float64).float()


def _text(cell: float | int | str) -> str:
    """Write a float32 so that it is read back exactly."""
    return f"{cell:.9g}" if isinstance(cell, float) else str(cell)
