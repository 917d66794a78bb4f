"""Planning of a fast periodic racing line through a track's gates, for the scripted pilot and start poses.

The line is a chain of polynomials of degree 7 through the gate openings. Its nodes and durations are optimised by
gradient descent on the lap time, with penalties for exceeding the drone's thrust or body rates. The results for
built-in tracks and presets are stored beside this module; `store_lines` makes that file.

Shapes: N queries, G race gates, M nodes of the line, S samples per segment, K samples of the finished line. SI units,
world z up. All numbers are this project's choice.
"""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, PRESETS, QuadrotorParameters
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Track, load_track

DEGREE = 7  # of a segment: position, velocity, acceleration and jerk are continuous
LINE_DT = 0.005  # s between samples of the finished line
SAMPLES = 12  # S, samples per segment at which the limits are checked
ADAM_STEPS, LBFGS_STEPS = 200, 800
STORED = Path(__file__).with_name("racing_lines.npz")


@dataclass(frozen=True)
class LineLimits:
    """Limits of the racing line."""

    speed: float = 0.9
    """Largest fraction of the maximum collective thrust that the line may use; sets the aggressiveness. 0.9 leaves a
    margin for corrections and for randomised drones with 14 % less thrust; above 0.95 the laps get no faster."""
    gate_offset: float = 0.25
    """Maximum distance from a gate's centre to the left and up, m; at most 40 % of the half opening."""
    body_rate_max: float = 6.0
    """Maximum roll and pitch rate, rad/s."""
    angular_acceleration_max: float = 40.0
    """Maximum roll and pitch acceleration, rad/s²."""
    thrust_min: float = 4.0
    """Minimum collective thrust, m/s²; near zero thrust the attitude is undefined."""
    gate_cosine: float = 0.75
    """Minimum cosine of the angle between the velocity and a gate's normal."""
    clearance: float = 0.5
    """Minimum distance from the bounding box, m."""
    height_min: float = 0.6
    """Minimum height, m."""


START_LINE = LineLimits(speed=0.7)
"""Limits of the line on which training episodes begin: slow enough to fly on from a noisy start."""


@dataclass(frozen=True)
class Reference:
    """State of the line at one time per drone; every tensor is (N, 3)."""

    position: Tensor  # m
    velocity: Tensor  # m/s
    acceleration: Tensor  # m/s²
    body_rate: Tensor  # rad/s, world frame, without the component about the thrust axis
    angular_acceleration: Tensor  # rad/s², world frame


class RacingLine:
    """A closed line around a track as a function of time.

    Args:
        samples: (K, 15) the columns of `Reference`, `LINE_DT`-spaced over one lap.
        gate_times: (G,) times at which the line passes each gate, s.
        lap_time: s.
        dynamics: dynamics of the drone for which it was planned.
    """

    def __init__(self, samples: Tensor, gate_times: Tensor, lap_time: float, dynamics: "Dynamics") -> None:
        self.samples, self.gate_times, self.lap_time, self.dynamics = samples, gate_times, lap_time, dynamics
        self.dt = lap_time / len(samples)  # s

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "RacingLine":
        """Return a copy of the line on a device, with a dtype."""
        samples, gate_times = (values.to(device, dtype) for values in (self.samples, self.gate_times))
        return RacingLine(samples, gate_times, self.lap_time, self.dynamics)

    def at(self, time: Tensor) -> Reference:
        """Interpolate the line at times (N,) in s; it repeats every lap."""
        place = time / self.dt
        index = place.floor()
        fraction = (place - index).unsqueeze(-1)
        index = index.long() % len(self.samples)
        rows = torch.lerp(self.samples[index], self.samples[(index + 1) % len(self.samples)], fraction)
        return Reference(*rows.split(3, dim=-1))


def _basis_rows(time: Tensor, order: int) -> Tensor:
    """Return the `order`-th derivatives of 1, t, …, t⁷ at times (S,), as (S, 8)."""
    powers = [
        math.perm(n, order) * time ** (n - order) if n >= order else torch.zeros_like(time) for n in range(DEGREE + 1)
    ]
    return torch.stack(powers, dim=-1)


def _hermite_basis(time: Tensor) -> Tensor:
    """Return the matrix (4, S, 8) from a polynomial's derivatives 0–3 at 0 and 1 to those at times (S,) in [0, 1]."""
    ends = torch.tensor([0.0, 1.0], dtype=time.dtype)
    conditions = torch.cat([_basis_rows(ends[i : i + 1], order) for i in range(2) for order in range(4)])
    inverse = torch.linalg.inv(conditions)
    return torch.stack([_basis_rows(time, order) @ inverse for order in range(4)])


class LineNodes:
    """Optimisation variables of a line: nodes at and between the gates, and the durations of the segments.

    The search starts from a slow line of cubic arcs that leave and enter gates along their normals.
    """

    SPACING = 4.0  # m between nodes, approximately
    START_SPEED = 5.0  # m/s
    SCALES = (0.5, 2.0, 10.0, 100.0)  # of a node's position, velocity, acceleration and jerk in the search

    def __init__(self, track: Track, gate_offset: float) -> None:
        dtype = torch.float64
        self.gates, self.normals = track.gate_positions(dtype=dtype), track.gate_normals(dtype=dtype)
        self.left = torch.tensor([gate.left for gate in track.gates], dtype=dtype)
        self.gate_offset = min(gate_offset, 0.4 * track.shape.pass_half_width)
        gaps = self.gates.roll(-1, 0) - self.gates
        turns = 1.0 - (self.normals * self.normals.roll(-1, 0)).sum(-1)  # 0 for straight on, 2 for a reversal
        lengths = 1.1 * gaps.norm(dim=-1) + 0.5 + 2.0 * turns  # upper estimate of the arc length, m
        self._counts = (gaps.norm(dim=-1) / self.SPACING).round().long().clamp(min=2)  # (G,) nodes from gate to gate
        self.gate_nodes = self._counts.cumsum(0) - self._counts  # (G,)
        arcs = [self._arc(gate, float(lengths[gate]), int(self._counts[gate])) for gate in range(len(self.gates))]
        self._start = torch.nn.functional.pad(torch.cat(arcs), (0, 0, 0, 2))  # (M, 4, 3)
        self._start_duration = lengths / self.START_SPEED / self._counts  # (G,) s per segment
        self._scales = torch.tensor(self.SCALES, dtype=dtype).view(4, 1)
        self.offsets = torch.zeros_like(self._start, requires_grad=True)  # (M, 4, 3)
        self.log_duration = torch.zeros_like(self._start_duration, requires_grad=True)  # (G,)

    def _arc(self, gate: int, length: float, count: int) -> Tensor:
        """Return positions and velocities (count, 2, 3) on the cubic arc from a gate to the next."""
        here, there = gate, (gate + 1) % len(self.gates)
        gap, out, into = self.gates[there] - self.gates[here], length * self.normals[here], length * self.normals[there]
        t = (torch.arange(count, dtype=gap.dtype) / count).unsqueeze(-1)
        position = self.gates[here] + (3 * t**2 - 2 * t**3) * gap + (t**3 - 2 * t**2 + t) * out + (t**3 - t**2) * into
        slope = 6 * (t - t**2) * gap + (3 * t**2 - 4 * t + 1) * out + (3 * t**2 - 2 * t) * into
        return torch.stack((position, self.START_SPEED * torch.nn.functional.normalize(slope, dim=-1)), dim=1)

    def variables(self) -> np.ndarray:
        """Return the optimisation variables as one vector, for `restore`."""
        return torch.cat((self.offsets.flatten(), self.log_duration)).detach().numpy()

    def restore(self, numbers: Tensor) -> None:
        """Set the optimisation variables to a result of `variables`."""
        offsets, log_duration = numbers.tensor_split([self.offsets.numel()])
        with torch.no_grad():
            self.offsets.copy_(offsets.view_as(self.offsets))
            self.log_duration.copy_(log_duration)

    def durations(self) -> Tensor:
        """Return the times from each node to the next (M,), s; between two gates they are equal."""
        return (self._start_duration * self.log_duration.exp()).repeat_interleave(self._counts)

    def nodes(self) -> Tensor:
        """Return position, velocity, acceleration and jerk of each node (M, 4, 3)."""
        nodes = self._start + self._scales * self.offsets
        left, up = (self.gate_offset * self.offsets[self.gate_nodes, 0, :2].tanh()).unsqueeze(-1).unbind(1)
        at_gates = self.gates + left * self.left + torch.nn.functional.pad(up, (2, 0))
        rows = torch.cat((at_gates.unsqueeze(1), nodes[self.gate_nodes, 1:]), dim=1)
        return nodes.index_copy(0, self.gate_nodes, rows)

    def segments(self) -> tuple[Tensor, Tensor]:
        """Return durations (M,), s, and derivatives 0–3 at both ends (M, 8, 3), in units of the segment's duration."""
        durations, nodes = self.durations(), self.nodes()
        powers = (durations.unsqueeze(-1) ** torch.arange(4)).unsqueeze(-1)  # (M, 4, 1)
        return durations, torch.cat((powers * nodes, powers * nodes.roll(-1, 0)), dim=1)


class Dynamics:
    """Inverse dynamics of the drone: the thrust and thrust axis that a motion needs."""

    def __init__(self, parameters: QuadrotorParameters) -> None:
        x, y, z = parameters.drag
        self.drag_sideways = (x + y) / 2 / parameters.mass  # 1/s
        self.drag_along = z / parameters.mass - self.drag_sideways  # 1/s, additional drag along the thrust axis
        self.thrust_max = 2.0 * parameters.collective_thrust_scale  # m/s²

    def force(self, velocity: Tensor, acceleration: Tensor) -> Tensor:
        """Return the specific force (..., 3) in m/s² with which the thrust axis must be aligned.

        Sideways drag is assumed equal in x and y; the remaining drag acts along the thrust axis and is compensated by
        thrust alone. Reference: Faessler et al., Differential Flatness of Quadrotor Dynamics Subject to Rotor Drag.
        """
        force = acceleration + self.drag_sideways * velocity
        return torch.cat((force[..., :2], force[..., 2:] + GRAVITY), dim=-1)

    def collective_thrust(self, force: Tensor, axis: Tensor, velocity: Tensor) -> Tensor:
        """Return the collective thrust (...) in m/s² that gives the force (..., 3) along the thrust axis (..., 3)."""
        return (axis * (force + self.drag_along * velocity)).sum(-1)


def _axis_rate(force: Tensor, force_rate: Tensor) -> tuple[Tensor, Tensor]:
    """Return a force's direction and its angular velocity, (..., 3), rad/s, without the component about the axis."""
    size = force.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    axis = force / size
    return axis, torch.linalg.cross(axis, force_rate) / size


def _excess(value: Tensor, limit: float) -> Tensor:
    """Return the Huber loss of the relative excess of values over a limit: quadratic if small, linear if large."""
    excess = (value / limit - 1.0).clamp(min=0.0)
    return torch.nn.functional.huber_loss(excess, torch.zeros_like(excess), reduction="none", delta=0.5) * 2.0


def _steps(values: Tensor) -> Tensor:
    """Return the differences from each sample of a closed line (M, S, 3) to the next."""
    flat = values.flatten(0, 1)
    return (flat.roll(-1, 0) - flat).view_as(values)


def _lap_cost(
    nodes: LineNodes, basis: Tensor, dynamics: Dynamics, limits: LineLimits, low: Tensor, high: Tensor
) -> Tensor:
    """Return the lap time in s plus penalties for exceeding the limits or leaving the box (low, high), both (3,)."""
    durations, ends = nodes.segments()
    per_second = 1.0 / durations.view(-1, 1, 1)
    derivatives = torch.einsum("ksc,mcd->kmsd", basis, ends)  # (4, M, S, 3)
    position, velocity, acceleration, jerk = (values * per_second**order for order, values in enumerate(derivatives))
    force = dynamics.force(velocity, acceleration)
    axis, body_rate = _axis_rate(force, jerk + dynamics.drag_sideways * acceleration)
    thrust = dynamics.collective_thrust(force, axis, velocity)  # (M, S)
    outside = (low - position).clamp(min=0.0).square() + (position - high).clamp(min=0.0).square()
    penalty = 300.0 * (_excess(thrust, limits.speed * dynamics.thrust_max) + outside.sum(-1))
    penalty = penalty + 300.0 * _excess(2.0 * limits.thrust_min - thrust, limits.thrust_min)
    # differences between samples, to detect flips of the thrust axis where the force passes through zero
    per_second = basis.shape[1] / durations.unsqueeze(-1)
    axis_speed, rate_change = _steps(axis).norm(dim=-1) * per_second, _steps(body_rate).norm(dim=-1) * per_second
    penalty = penalty + 50.0 * _excess(axis_speed, limits.body_rate_max)
    penalty = penalty + 10.0 * _excess(rate_change, limits.angular_acceleration_max)
    at_gates = torch.nn.functional.normalize(velocity[nodes.gate_nodes, 0], dim=-1)
    slant = (limits.gate_cosine - (at_gates * nodes.normals).sum(-1)).clamp(min=0.0)
    return durations.sum() + (durations * penalty.mean(-1)).sum() + 10.0 * slant.square().sum()


@lru_cache(maxsize=32)
def plan_racing_line(track: Track, parameters: QuadrotorParameters, limits: LineLimits) -> RacingLine:
    """Plan a fast closed line, float64 on CPU, through all gates; takes some seconds unless it is stored or cached.

    Of the drone's parameters only mass, thrust and drag matter.
    """
    with torch.inference_mode(False):
        dynamics, nodes = Dynamics(parameters), LineNodes(track, limits.gate_offset)
        found = stored_lines().get(line_key(track, parameters, limits))
        if found is None:
            search_line(nodes, track, dynamics, limits)
        else:
            nodes.restore(found)
        with torch.no_grad():
            return _finish_line(nodes, dynamics)


def search_line(nodes: LineNodes, track: Track, dynamics: Dynamics, limits: LineLimits) -> None:
    """Optimise the variables of a line for lap time within its limits."""
    basis = _hermite_basis(torch.arange(SAMPLES, dtype=torch.float64) / SAMPLES)
    low = torch.tensor(track.bounds_low, dtype=torch.float64) + limits.clearance
    high = torch.tensor(track.bounds_high, dtype=torch.float64) - limits.clearance
    low[2] = low[2].clamp(min=limits.height_min)
    _descend(nodes, lambda: _lap_cost(nodes, basis, dynamics, limits, low, high))


def line_key(track: Track, parameters: QuadrotorParameters, limits: LineLimits) -> str:
    """Return the key of a stored line: a hash of all inputs of the search."""
    gates = [(gate.position, gate.yaw_degrees) for gate in track.gates]
    numbers = (gates, track.shape.pass_half_width, track.bounds_low, track.bounds_high, vars(Dynamics(parameters)))
    return hashlib.sha256(repr((numbers, limits)).encode()).hexdigest()[:16]


@cache
def stored_lines() -> dict[str, Tensor]:
    """Return the optimisation variables of the stored lines, by key."""
    with np.load(STORED, allow_pickle=False) as lines:
        return {key: torch.from_numpy(lines[key]) for key in lines.files}


def store_lines() -> None:
    """Recompute and store the lines of all built-in tracks and presets, for the pilot and for start poses."""
    lines: dict[str, Any] = {}
    for track in map(load_track, BUILTIN_TRACKS):
        for drone in PRESETS.values():
            for limits in (LineLimits(), START_LINE):
                if (key := line_key(track, drone, limits)) not in lines:
                    nodes = LineNodes(track, limits.gate_offset)
                    search_line(nodes, track, Dynamics(drone), limits)
                    lines[key] = nodes.variables()
    np.savez_compressed(STORED, **lines)


def _descend(nodes: LineNodes, cost: Callable[[], Tensor]) -> None:
    """Minimise the cost: Adam first brings the line near the limits, then L-BFGS makes it fast."""
    variables = [nodes.offsets, nodes.log_duration]

    def evaluate() -> Tensor:
        with torch.enable_grad():
            value = cost()
            for variable, gradient in zip(variables, torch.autograd.grad(value, variables), strict=True):
                variable.grad = gradient
        return value

    adam = torch.optim.Adam(variables, lr=0.06)
    for _ in range(ADAM_STEPS):
        evaluate()
        adam.step()
    torch.optim.LBFGS(
        variables,
        max_iter=LBFGS_STEPS,
        history_size=60,
        tolerance_grad=1e-9,
        tolerance_change=1e-7,
        line_search_fn="strong_wolfe",
    ).step(evaluate)


def _finish_line(nodes: LineNodes, dynamics: Dynamics) -> RacingLine:
    """Sample the line evenly in time."""
    durations, ends = nodes.segments()
    end_times = durations.cumsum(0)
    start_times = end_times - durations
    lap_time = float(end_times[-1])
    count = round(lap_time / LINE_DT)
    time = torch.arange(count, dtype=durations.dtype) * (lap_time / count)
    segment = torch.searchsorted(end_times, time, right=True).clamp(max=len(durations) - 1)
    basis = _hermite_basis((time - start_times[segment]) / durations[segment])  # (4, K, 8)
    derivatives = torch.einsum("okc,kcd->okd", basis, ends[segment])
    per_second = 1.0 / durations[segment].unsqueeze(-1)
    position, velocity, acceleration, jerk = (values * per_second**order for order, values in enumerate(derivatives))
    force_rate = jerk + dynamics.drag_sideways * acceleration
    _, body_rate = _axis_rate(dynamics.force(velocity, acceleration), force_rate)
    angular_acceleration = (body_rate.roll(-1, 0) - body_rate.roll(1, 0)) / (2 * lap_time / count)
    columns = (position, velocity, acceleration, body_rate, angular_acceleration)
    return RacingLine(torch.cat(columns, dim=-1), start_times[nodes.gate_nodes], lap_time, dynamics)
