"""Recorded flights as CSV files, from which figures are drawn after the run.

Shapes: K control steps of an episode, A action.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path

import torch

from dreamer_racing.evaluation.evaluate import Trajectory

STATE = {
    "position": ("x", "y", "z"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "target_gate": ("target_gate",),
}
"""Columns of each field, in SI units, beside the time ``t`` and the action ``a0`` …"""
HEAD = ("track", "control_dt", "outcome")


def write_trajectory(path: str | Path, trajectory: Trajectory, track: str) -> None:
    """Write an episode as CSV: a row an observation, K + 1 of them, the action beside the one it was taken at.

    Images are left out; every other number is kept to the last bit. Lines with `#` say what there is besides rows.

    Args:
        path: the file; missing folders are made.
        trajectory: the episode.
        track: name or YAML file of its track.
    """
    fields = [getattr(trajectory, name).reshape(len(trajectory.position), -1).tolist() for name in STATE]
    actions = [*trajectory.action.tolist(), [""] * trajectory.action.shape[1]]  # none at the last observation
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    partial = Path(path).with_name(f".{Path(path).name}.partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        head = (track, repr(trajectory.control_dt), trajectory.outcome or "none")
        file.writelines(f"# {name}: {value}\n" for name, value in zip(HEAD, head, strict=True))
        writer = csv.writer(file, lineterminator="\n")
        columns = [column for names in STATE.values() for column in names]
        writer.writerow(["t", *columns, *(f"a{index}" for index in range(trajectory.action.shape[1]))])
        for index, row in enumerate(zip(*fields, actions, strict=True)):
            writer.writerow([f"{index * trajectory.control_dt:.6g}", *(_text(cell) for cells in row for cell in cells)])
    os.replace(partial, path)


def read_trajectory(path: str | Path) -> tuple[Trajectory, str]:
    """Read what `write_trajectory` wrote.

    Returns:
        The episode, without images, and its track.

    Raises:
        ValueError: this is no such file, or it was cut short.
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
        action = _columns(rows[:-1], list(range(len(expected), len(header))))
        control_dt = float(head["control_dt"])
    except ValueError as error:
        raise ValueError(f"{path} holds a cell that is no number: {error}.") from error
    gate = numbers.pop("target_gate").flatten().long()
    trajectory = Trajectory(
        **numbers,
        target_gate=gate,
        action=action,
        pixels=None,
        control_dt=control_dt,
        outcome=None if head["outcome"] == "none" else head["outcome"],
    )
    return trajectory, head["track"]


def _columns(rows: list[list[str]], columns: list[int]) -> torch.Tensor:
    """Parse columns of the rows as float32."""
    return torch.tensor([[float(row[column]) for column in columns] for row in rows], dtype=torch.float64).float()


def _text(cell: float | int | str) -> str:
    """Write a float32 so that it is read back exactly."""
    return f"{cell:.9g}" if isinstance(cell, float) else str(cell)
