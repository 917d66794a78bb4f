"""Statistics of what the nose camera sees: angles between its axis and gates or decoys, and which of them are in view.

A gate or decoy is in view while its centre projects into the image. Occlusion (only another gate's frame can occlude)
is ignored, and so is the side from which a gate is seen, because both sides look the same.
Reference: paper, Fig. "Ablation study on the perception aware behaviour".

Shapes: K control steps of an episode, L points, M observations, G race gates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.simulator.rendering import is_in_view, points_in_camera
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Gate, Track
from dreamer_racing.evaluation.protocol import Result, as_markdown, report_heading, results_table
from dreamer_racing.evaluation.trajectory import Trajectory

NEXT_GATE, NEAREST_VISIBLE_GATE = "next gate", "nearest visible gate"
QUANTILES = (5, 25, 50, 75, 95)  # percent
BIN_DEGREES = 5
NO_NOISE, START_NOISE = 0.0, 1.0  # noise of starts, in units of training's; with it no two flights are the same
START_TEXT = {NO_NOISE: "From the start pose:\n", START_NOISE: "From starts with the noise of training:\n"}


@dataclass(frozen=True)
class Sight:
    """Angle and visibility of one gate or decoy in each of M observations."""

    angle: Tensor  # (M,) between the camera's axis and the direction to the object, degrees; NaN without an object
    in_view: Tensor  # (M,) bool: the object's centre was in the image
    flight: Tensor  # (M,) int64: index of the flight; observations of one flight are not independent samples

    @property
    def share_in_view(self) -> float:
        """Share of observations, and so of time, with the object in view."""
        return float(self.in_view.float().mean())

    @property
    def shares_by_flight(self) -> list[float]:
        """Share of each flight's observations with the object in view."""
        return [float(self.in_view[self.flight == index].float().mean()) for index in self.flight.unique()]

    def histogram(self) -> Tensor:
        """Return the share of angles in each bin of 5° from 0° to 180°, (36,)."""
        angles = self.angle[self.angle.isfinite()]
        bins = 180 // BIN_DEGREES
        counts = torch.bincount((angles / BIN_DEGREES).long().clamp(0, bins - 1), minlength=bins)
        return counts / max(1, len(angles))

    def to_dict(self) -> dict[str, Any]:
        """Return the share in view, and mean, quantiles and histogram of the angle, as JSON values."""
        angles = self.angle[self.angle.isfinite()].double()
        levels = torch.tensor(QUANTILES, dtype=torch.float64) / 100
        quantiles = angles.quantile(levels).tolist() if len(angles) else [None] * len(QUANTILES)
        return {
            "observations": len(self.angle),
            "share_in_view": self.share_in_view,
            "angle_mean_degrees": float(angles.mean()) if len(angles) else None,
            "angle_quantiles_degrees": {f"{level} %": value for level, value in zip(QUANTILES, quantiles, strict=True)},
            "angle_histogram": [round(share, 5) for share in self.histogram().tolist()],
        }


def measure_sight(
    trajectories: Sequence[Trajectory], track: Track, camera: Camera, decoys: Sequence[Gate] = ()
) -> dict[str, Sight]:
    """Measure which gates and decoys, or places of decoys, the camera was pointed at, over all observations of flights.

    Returns:
        One `Sight` per object: the ``next gate`` to pass; the ``nearest visible gate``, whose angle is NaN while none
        is in view; each race gate ``gate 1`` ... and each decoy ``decoy 1`` ...; ``any decoy``, which is in view if any
        is, at the smallest of their angles.
    """
    position = torch.cat([trajectory.position for trajectory in trajectories])
    attitude = torch.cat([trajectory.attitude for trajectory in trajectories])
    target_gate = torch.cat([trajectory.target_gate for trajectory in trajectories])
    flight = torch.cat([torch.full_like(one.target_gate, index) for index, one in enumerate(trajectories)])
    known = position.isfinite().all(-1) & attitude.isfinite().all(-1)
    position, attitude = position[known].double(), attitude[known].double()
    target_gate, flight = target_gate[known], flight[known]
    gates = points_in_camera(position, attitude, track.gate_positions(dtype=torch.float64), camera)  # (M, G, 3)
    row = torch.arange(len(gates))
    angle, in_view = angles(gates), is_in_view(gates, camera)  # (M, G)
    distance = gates.norm(dim=-1).masked_fill(~in_view, math.inf)
    nearest = distance.argmin(-1)
    any_gate = in_view.any(-1)
    sights = {
        NEXT_GATE: Sight(angle[row, target_gate], in_view[row, target_gate], flight),
        NEAREST_VISIBLE_GATE: Sight(angle[row, nearest].masked_fill(~any_gate, math.nan), any_gate, flight),
        **_one_by_one("gate", angle, in_view, flight),
    }
    if decoys:
        places = torch.tensor([gate.position for gate in decoys], dtype=torch.float64)
        points = points_in_camera(position, attitude, places, camera)  # (M, L, 3)
        angle, in_view = angles(points), is_in_view(points, camera)
        sights |= _one_by_one("decoy", angle, in_view, flight)
        sights["any decoy"] = Sight(angle.amin(-1), in_view.any(-1), flight)
    return sights


def _one_by_one(kind: str, angle: Tensor, in_view: Tensor, flight: Tensor) -> dict[str, Sight]:
    """Return one `Sight` per column of (M, L), named by kind and number."""
    columns = enumerate(zip(angle.unbind(-1), in_view.unbind(-1), strict=True), start=1)
    return {f"{kind} {number}": Sight(*column, flight) for number, column in columns}


def is_race_gate(thing: str) -> bool:
    """Return whether a name in the result of `measure_sight` is that of a numbered race gate."""
    return thing.startswith("gate ")


def angles(points: Tensor) -> Tensor:
    """Return the angles between the camera's axis and points (..., 3) in the camera's frame, (...), degrees."""
    return torch.rad2deg(torch.atan2(points[..., 1:].norm(dim=-1), points[..., 0]))


def sight_table(flights: Mapping[str, Mapping[str, Sight]]) -> str:
    """Return a Markdown table of results of `measure_sight` by kind of flight, without the numbered race gates."""
    head = ("flights", "object", "in view", "angle: mean", *(f"{level} %" for level in QUANTILES))
    rows = []
    for flight, sights in flights.items():
        for name, sight in sights.items():
            if is_race_gate(name):
                continue
            numbers = sight.to_dict()
            values = [numbers["angle_mean_degrees"], *numbers["angle_quantiles_degrees"].values()]
            cells = ("–" if value is None else f"{value:.0f}°" for value in values)
            rows.append((flight, name, f"{sight.share_in_view:.0%}", *cells))
    return as_markdown(head, rows)


def gate_table(flights: Mapping[str, Mapping[str, Sight]]) -> str:
    """Return a Markdown table of the share of time that each race gate was in view, on tracks with the same gates."""
    gates = dict.fromkeys(name for sights in flights.values() for name in sights if is_race_gate(name))
    rows = [(gate, *(f"{sights[gate].share_in_view:.0%}" for sights in flights.values())) for gate in gates]
    return as_markdown(("in view", *flights), rows)


@dataclass
class SightResults:
    """Results of the flights without or with decoys, and what the camera was pointed at."""

    track: Track
    gates_per_episode: float
    success_rate: float
    trajectory: Trajectory  # the first of them
    sights: dict[str, Sight]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        return {
            "gates_per_episode": self.gates_per_episode,
            "success_rate": self.success_rate,
            "sights": {thing: sight.to_dict() for thing, sight in self.sights.items()},
        }


def sight_report(
    title: str, looked: dict[str, SightResults], corrupted: dict[float, list[Result]], provenance: dict[str, Any]
) -> str:
    """Return the tables as a Markdown page; flights with corrupted images are given by the noise of their starts."""
    sights = {name: kind.sights for name, kind in looked.items()}
    parts = [report_heading(title, provenance), "## What the camera points at\n", START_TEXT[START_NOISE]]
    parts += [sight_table(sights), "Share of time in view, gate by gate:\n", gate_table(sights)]
    parts += ["![perception](perception.png)\n", "## Corrupted images\n"]
    for noise, results in corrupted.items():
        parts += [START_TEXT[noise], results_table(results, "images")]
    return "\n".join(parts)
