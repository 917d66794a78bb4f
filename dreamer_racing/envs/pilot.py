"""A scripted, state-based pilot: it plans a fast periodic line through a track's gates and flies N drones along it.

The line (`plan_racing_line`) is a chain of polynomials of degree 7 through the gate openings. Its nodes and durations
are chosen by gradient descent on the lap time, with penalties where it would ask for more thrust or body rate than the
drone has. The controller (`ScriptedPilot`) finds where on the line a drone is, and steers it with position and velocity
feedback, acceleration and rate feedforward, and a prediction over the command delay. It is the reference for lap times,
and a demonstrator: it also flies from the poses in which training episodes start.

Shapes: N drones, G race gates, M nodes of the line, S samples per segment, K samples of the finished line. SI units,
world z up, attitude wxyz, body frame FLU. All numbers are this project's choice.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from dreamer_racing.envs.quadrotor import GRAVITY, QuadrotorParameters, load_preset, without_randomisation
from dreamer_racing.envs.race import RaceStep
from dreamer_racing.envs.rotation import rotate, rotate_inverse, turn
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.envs.worlds import RaceWorlds

DEGREE = 7  # of a segment: position, velocity, acceleration and jerk are continuous
LINE_DT = 0.005  # s between samples of the finished line
SAMPLES = 12  # S, at which a segment must keep the limits
ADAM_STEPS, LBFGS_STEPS = 200, 800


@dataclass(frozen=True)
class LineLimits:
    """What the line may ask for.

    Args:
        speed: the fraction of the greatest collective thrust that the line may use; the one knob of aggressiveness.
            0.9 leaves room for corrections and for a drone of the randomisation with 14 % less thrust; above 0.95 the
            laps get no faster.
        gate_offset: greatest distance from a gate's centre to the left and up, m; never above 40 % of the opening's.
        body_rate_max: greatest roll and pitch rate, rad/s.
        angular_acceleration_max: greatest roll and pitch acceleration, rad/s².
        thrust_min: least collective thrust, m/s²; below it the drone's attitude has no direction.
        gate_cosine: least cosine of the angle between the flight and a gate's normal.
        clearance: distance from the bounding box, m.
        height_min: least height, m.
    """

    speed: float = 0.9
    gate_offset: float = 0.25
    body_rate_max: float = 6.0
    angular_acceleration_max: float = 40.0
    thrust_min: float = 4.0
    gate_cosine: float = 0.75
    clearance: float = 0.5
    height_min: float = 0.6


@dataclass(frozen=True)
class Reference:
    """The line at one time per drone; every tensor is (N, 3)."""

    position: Tensor  # m
    velocity: Tensor  # m/s
    acceleration: Tensor  # m/s²
    thrust_rate: Tensor  # m/s³, rate of change of the specific thrust vector
    body_rate: Tensor  # rad/s, world frame, without the part about the thrust axis
    angular_acceleration: Tensor  # rad/s², world frame


class RacingLine:
    """A closed line around a track as a function of time.

    Args:
        samples: (K, 18) the columns of `Reference`, `LINE_DT`-spaced over one lap.
        gate_times: (G,) s, when the line passes each gate.
        lap_time: s.
    """

    def __init__(self, samples: Tensor, gate_times: Tensor, lap_time: float) -> None:
        self.samples, self.gate_times, self.lap_time = samples, gate_times, lap_time
        self.dt = lap_time / len(samples)  # s

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "RacingLine":
        """The same line elsewhere."""
        return RacingLine(self.samples.to(device, dtype), self.gate_times.to(device, dtype), self.lap_time)

    def at(self, time: Tensor) -> Reference:
        """Interpolate the line at times (N,) in s; it repeats every lap."""
        place = time / self.dt
        index = place.floor()
        fraction = (place - index).unsqueeze(-1)
        index = index.long() % len(self.samples)
        rows = torch.lerp(self.samples[index], self.samples[(index + 1) % len(self.samples)], fraction)
        return Reference(*rows.split(3, dim=-1))


def _basis_rows(time: Tensor, order: int) -> Tensor:
    """The `order`-th derivatives of 1, t, …, t⁷ at times (S,), as (S, 8)."""
    powers = [
        math.perm(n, order) * time ** (n - order) if n >= order else torch.zeros_like(time) for n in range(DEGREE + 1)
    ]
    return torch.stack(powers, dim=-1)


def _hermite_basis(time: Tensor) -> Tensor:
    """Derivatives 0–3 at times (S,) in [0, 1] of the polynomial with given derivatives 0–3 at 0 and 1: (4, S, 8)."""
    ends = torch.tensor([0.0, 1.0], dtype=time.dtype)
    conditions = torch.cat([_basis_rows(ends[i : i + 1], order) for i in range(2) for order in range(4)])
    inverse = torch.linalg.inv(conditions)
    return torch.stack([_basis_rows(time, order) @ inverse for order in range(4)])


class _LineNodes:
    """The free numbers of a line: nodes at the gates and between them, and the durations from each to the next.

    The search starts from a slow line of cubic arcs that leave and enter gates along their normals.
    """

    SPACING = 4.0  # m between nodes, about
    START_SPEED = 5.0  # m/s
    SCALES = (0.5, 2.0, 10.0, 100.0)  # of a node's position, velocity, acceleration and jerk in the search

    def __init__(self, track: Track, gate_offset: float) -> None:
        dtype = torch.float64
        self.gates, self.normals = track.gate_positions(dtype=dtype), track.gate_normals(dtype=dtype)
        self.left = track.gate_rotations(dtype=dtype)[:, :, 1]
        self.gate_offset = min(gate_offset, 0.4 * track.shape.pass_half_width)
        gaps = self.gates.roll(-1, 0) - self.gates
        turns = 1.0 - (self.normals * self.normals.roll(-1, 0)).sum(-1)  # 0 straight on, 2 for a reversal
        lengths = 1.1 * gaps.norm(dim=-1) + 0.5 + 2.0 * turns  # of a generous arc, m
        self._counts = (gaps.norm(dim=-1) / self.SPACING).round().long().clamp(min=2)  # (G,) nodes from gate to gate
        self.gate_nodes = self._counts.cumsum(0) - self._counts  # (G,)
        arcs = [self._arc(gate, float(lengths[gate]), int(self._counts[gate])) for gate in range(len(self.gates))]
        self._start = torch.nn.functional.pad(torch.cat(arcs), (0, 0, 0, 2))  # (M, 4, 3)
        self._start_duration = lengths / self.START_SPEED / self._counts  # (G,) of each of the equal segments
        self._scales = torch.tensor(self.SCALES, dtype=dtype).view(4, 1)
        self.change = torch.zeros_like(self._start, requires_grad=True)  # (M, 4, 3)
        self.log_duration = torch.zeros_like(self._start_duration, requires_grad=True)  # (G,)

    def _arc(self, gate: int, length: float, count: int) -> Tensor:
        """Positions and velocities (count, 2, 3) on the cubic arc from a gate to the next."""
        here, there = gate, (gate + 1) % len(self.gates)
        gap, out, into = self.gates[there] - self.gates[here], length * self.normals[here], length * self.normals[there]
        t = (torch.arange(count, dtype=gap.dtype) / count).unsqueeze(-1)
        position = self.gates[here] + (3 * t**2 - 2 * t**3) * gap + (t**3 - 2 * t**2 + t) * out + (t**3 - t**2) * into
        slope = 6 * (t - t**2) * gap + (3 * t**2 - 4 * t + 1) * out + (3 * t**2 - 2 * t) * into
        return torch.stack((position, self.START_SPEED * torch.nn.functional.normalize(slope, dim=-1)), dim=1)

    def durations(self) -> Tensor:
        """Seconds from each node to the next (M,); between two gates they are equal."""
        return (self._start_duration * self.log_duration.exp()).repeat_interleave(self._counts)

    def nodes(self) -> Tensor:
        """Position, velocity, acceleration and jerk of each node (M, 4, 3)."""
        nodes = self._start + self._scales * self.change
        left, up = (self.gate_offset * self.change[self.gate_nodes, 0, :2].tanh()).unsqueeze(-1).unbind(1)
        at_gates = self.gates + left * self.left + torch.nn.functional.pad(up, (2, 0))
        rows = torch.cat((at_gates.unsqueeze(1), nodes[self.gate_nodes, 1:]), dim=1)
        return nodes.index_copy(0, self.gate_nodes, rows)

    def segments(self) -> tuple[Tensor, Tensor]:
        """Durations of the segments (M,), and the nodes at both of their ends per segment time (M, 8, 3)."""
        durations, nodes = self.durations(), self.nodes()
        powers = (durations.unsqueeze(-1) ** torch.arange(4)).unsqueeze(-1)  # (M, 4, 1)
        return durations, torch.cat((powers * nodes, powers * nodes.roll(-1, 0)), dim=1)


class _Dynamics:
    """What a line asks of the drone."""

    def __init__(self, parameters: QuadrotorParameters) -> None:
        x, y, z = parameters.drag
        self.drag_sideways = (x + y) / 2 / parameters.mass  # 1/s
        self.drag_along = z / parameters.mass - self.drag_sideways  # 1/s, more along the thrust axis
        self.thrust_max = 2.0 * parameters.collective_thrust_scale  # m/s²

    def force(self, velocity: Tensor, acceleration: Tensor) -> Tensor:
        """Specific force (..., 3) in m/s² whose direction the thrust axis must have.

        Sideways drag is taken to be equal in x and y; the rest of the drag is along the thrust axis, and is made up by
        thrust alone. Reference: Faessler et al., Differential Flatness of Quadrotor Dynamics Subject to Rotor Drag.
        """
        force = acceleration + self.drag_sideways * velocity
        return force + force.new_tensor((0.0, 0.0, GRAVITY))

    def collective_thrust(self, force: Tensor, axis: Tensor, velocity: Tensor) -> Tensor:
        """Collective thrust (...) in m/s² that gives the force (..., 3) along the thrust axis (..., 3)."""
        return (axis * (force + self.drag_along * velocity)).sum(-1)


def _axis_rate(force: Tensor, force_rate: Tensor) -> tuple[Tensor, Tensor]:
    """The thrust axis of a force and its angular velocity (..., 3) in rad/s, without the part about the axis."""
    size = force.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    axis = force / size
    return axis, torch.linalg.cross(axis, force_rate) / size


def _excess(value: Tensor, limit: float) -> Tensor:
    """Relative excess of values over a limit: squared where it is small, linear where it is large."""
    excess = (value / limit - 1.0).clamp(min=0.0)
    return torch.nn.functional.huber_loss(excess, torch.zeros_like(excess), reduction="none", delta=0.5) * 2.0


def _steps(values: Tensor) -> Tensor:
    """Differences from each sample of a closed line (M, S, 3) to the next."""
    flat = values.flatten(0, 1)
    return (flat.roll(-1, 0) - flat).view_as(values)


def _lap_cost(
    nodes: _LineNodes, basis: Tensor, dynamics: _Dynamics, limits: LineLimits, low: Tensor, high: Tensor
) -> Tensor:
    """Lap time in s plus penalties where the line breaks the limits or leaves the box (low, high), both (3,)."""
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
    # between samples, so that the thrust axis cannot flip unseen where the force passes through zero
    per_second = basis.shape[1] / durations.unsqueeze(-1)
    axis_speed, rate_change = _steps(axis).norm(dim=-1) * per_second, _steps(body_rate).norm(dim=-1) * per_second
    penalty = penalty + 50.0 * _excess(axis_speed, limits.body_rate_max)
    penalty = penalty + 10.0 * _excess(rate_change, limits.angular_acceleration_max)
    at_gates = torch.nn.functional.normalize(velocity[nodes.gate_nodes, 0], dim=-1)
    slant = (limits.gate_cosine - (at_gates * nodes.normals).sum(-1)).clamp(min=0.0)
    return durations.sum() + (durations * penalty.mean(-1)).sum() + 10.0 * slant.square().sum()


@lru_cache(maxsize=32)
def plan_racing_line(track: Track, parameters: QuadrotorParameters, limits: LineLimits) -> RacingLine:
    """Plan a fast closed line through all gates of a track (a few seconds of CPU time, then cached).

    Args:
        track: the track.
        parameters: the drone; only its mass, thrust and drag matter.
        limits: what the line may ask for.

    Returns:
        The line, float64 on CPU.
    """
    with torch.inference_mode(False):
        dynamics, nodes = _Dynamics(parameters), _LineNodes(track, limits.gate_offset)
        basis = _hermite_basis(torch.arange(SAMPLES, dtype=torch.float64) / SAMPLES)
        low = torch.tensor(track.bounds_low, dtype=torch.float64) + limits.clearance
        high = torch.tensor(track.bounds_high, dtype=torch.float64) - limits.clearance
        low[2] = low[2].clamp(min=limits.height_min)
        _descend(nodes, lambda: _lap_cost(nodes, basis, dynamics, limits, low, high))
        with torch.no_grad():
            return _finish_line(nodes, dynamics)


def _descend(nodes: _LineNodes, cost: Callable[[], Tensor]) -> None:
    """Minimise the cost: Adam brings the line near the limits, L-BFGS makes it fast."""
    variables = [nodes.change, nodes.log_duration]

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


def _finish_line(nodes: _LineNodes, dynamics: _Dynamics) -> RacingLine:
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
    columns = (position, velocity, acceleration, force_rate, body_rate, angular_acceleration)
    return RacingLine(torch.cat(columns, dim=-1), start_times[nodes.gate_nodes], lap_time)


@dataclass(frozen=True)
class PilotGains:
    """How the pilot corrects errors.

    Args:
        position: 1/s², acceleration per metre beside the line.
        velocity: 1/s, acceleration per m/s across the line.
        progress: 1/s, how fast the speed along the line returns to the line's own.
        attitude: 1/s², angular acceleration per radian of thrust axis error.
        body_rate: 1/s, angular acceleration per rad/s.
        yaw: 1/s, yaw rate per radian.
        correction_max: m/s², greatest acceleration in answer to errors beside the line.
        progress_max: m/s², greatest acceleration in answer to errors of speed along the line.
        look_ahead: s, the nose points to where the line is this much later.
        adaptation: 1/s, how fast the estimate of the thrust's scale follows the measurement.
    """

    position: float = 14.0
    velocity: float = 6.0
    progress: float = 3.0
    attitude: float = 120.0
    body_rate: float = 17.0
    yaw: float = 5.0
    correction_max: float = 10.0
    progress_max: float = 8.0
    look_ahead: float = 0.5
    adaptation: float = 1.0


class ScriptedPilot:
    """Flies N drones around a track from their states.

    It keeps each drone's last command and an estimate of its thrust's scale. A drone that is suddenly somewhere else
    has started a new episode, so that nobody needs to tell; `reset` tells it anyway.

    Args:
        track: name, path or `Track`.
        parameters: preset or parameters of the drone; the pilot knows the nominal ones only.
        limits: what the line may ask for; its `speed` is the knob of aggressiveness. None for the defaults.
        gains: how errors are corrected.
        device: where the states will be.
        dtype: floating-point type of the states and actions.

    Example:
        >>> pilot = ScriptedPilot("circle")
        >>> level, still = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.zeros(1, 3)
        >>> pilot.act(torch.tensor([[4.0, -2.5, 1.35]]), level, still, still, torch.tensor([0])).shape
        torch.Size([1, 4])
    """

    WINDOW = 0.25  # s: the line is searched from this much before the last gate to this much after the target gate
    SEARCH_DT = 0.02  # s between the points of the search
    JUMP = 0.3  # m beyond its own motion: the drone has been put elsewhere

    def __init__(
        self,
        track: str | Track,
        parameters: str | QuadrotorParameters = "easy",
        limits: LineLimits | None = None,
        gains: PilotGains | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.track, self.parameters = load_track(track), load_preset(parameters)
        self.limits = limits or LineLimits()
        self.gains = gains or PilotGains()
        self._device, self._dtype = torch.device(device), dtype
        nominal = without_randomisation(self.parameters)
        self.line = plan_racing_line(self.track, nominal, self.limits).to(device, dtype)
        self._dynamics = _Dynamics(nominal)
        self._rate_max = torch.tensor(nominal.body_rate_max, device=device, dtype=dtype)
        self._latency = nominal.command_delay + nominal.control_dt / 2.0  # s, to the middle of the action's effect
        self._make_search()
        self._last_position: Tensor | None = None  # (N, 3)
        self._last_velocity: Tensor  # (N, 3)
        self._last_command: Tensor  # (N, 4) m/s² and rad/s
        self._last_thrust: Tensor  # (N, 1) m/s², what the motors were asked for, with their lag
        self._thrust_scale: Tensor  # (N, 1) real thrust over nominal

    def _make_search(self) -> None:
        """Tabulate where on the line the drones of each target gate may be: times and positions (G, W, ·)."""
        line = self.line
        end = line.gate_times + self.WINDOW
        start = line.gate_times.roll(1) - self.WINDOW
        start[0] -= line.lap_time
        count = math.ceil(float((end - start).max()) / self.SEARCH_DT)
        share = torch.linspace(0.0, 1.0, count, device=self._device, dtype=self._dtype)
        self._search_times = torch.lerp(start.unsqueeze(-1), end.unsqueeze(-1), share)  # (G, W)
        points = [line.at(times).position for times in self._search_times]
        self._search_positions = torch.stack(points)  # (G, W, 3)

    def reset(self, mask: Tensor | None = None) -> None:
        """Forget the masked drones (N,) bool; all if None."""
        if mask is None:
            self._last_position = None
        elif self._last_position is not None:
            self._last_position = torch.where(mask.unsqueeze(-1), math.nan, self._last_position)

    @torch.no_grad()
    def act(
        self, position: Tensor, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor, target_gate: Tensor
    ) -> Tensor:
        """Choose the actions of the coming control step.

        Args:
            position: (N, 3) m.
            attitude: (N, 4) wxyz.
            linear_velocity: (N, 3) m/s, world frame.
            body_rates: (N, 3) rad/s, body frame.
            target_gate: (N,) int64.

        Returns:
            (N, 4) in [-1, 1]: collective thrust, body rates x, y, z.
        """
        inputs = (position, attitude, linear_velocity, body_rates)
        state = [value.to(self._device, self._dtype) for value in inputs]
        self._remember(*state)
        position, attitude, velocity, body_rates = self._predict(*state)
        time = self._find(position, target_gate.to(self._device))
        reference = self.line.at(time)
        force, progress = self._desired_force(position, velocity, reference)
        thrust = self._thrust(force, attitude, velocity, time)
        roll_pitch = self._roll_pitch_rates(force, attitude, body_rates, reference, progress)
        rates = torch.cat((roll_pitch, self._yaw_rate(position, attitude, time)), dim=1)
        self._last_command = torch.cat((thrust, rates), dim=1)
        thrust = thrust / self._thrust_scale / self.parameters.collective_thrust_scale - 1.0
        return torch.cat((thrust, rates / self._rate_max), dim=1).clamp(-1.0, 1.0)

    def _remember(self, position: Tensor, attitude: Tensor, velocity: Tensor, body_rates: Tensor) -> None:
        """Forget the drones that are suddenly elsewhere; learn how strong the thrust of the others is."""
        dt, dynamics = self.parameters.control_dt, self._dynamics
        if self._last_position is None or len(self._last_position) != len(position):
            self._last_position, self._last_velocity = torch.full_like(position, math.nan), velocity
            self._last_command = torch.zeros_like(attitude)
            self._last_thrust, self._thrust_scale = torch.zeros_like(position[:, :1]), torch.ones_like(position[:, :1])
        velocity_mean = (velocity + self._last_velocity) / 2.0
        surprise = (position - self._last_position - dt * velocity_mean).norm(dim=-1, keepdim=True)
        new = ~(surprise < self.JUMP)  # NaN is new too
        hover = torch.nn.functional.pad(torch.full_like(surprise, GRAVITY), (0, 3))
        self._last_command = torch.where(new, hover, self._last_command)
        lag = self.parameters.motor_time_constant + self.parameters.command_delay
        thrust = torch.lerp(self._last_thrust, self._last_command[:, :1], min(1.0, dt / lag))
        self._last_thrust = torch.where(new, GRAVITY, thrust)
        force = dynamics.force(velocity_mean, (velocity - self._last_velocity) / dt)
        measured = dynamics.collective_thrust(force, rotate(attitude, _unit_z(position)), velocity).unsqueeze(-1)
        surplus = (measured / self._last_thrust.clamp(min=5.0)).clamp(0.7, 1.3) - 1.0
        # near the limit the mixer may give up thrust for roll and pitch, which is no property of the drone
        known = (self._last_thrust > 8.0) & (self._last_thrust < 0.85 * dynamics.thrust_max)
        scale = (self._thrust_scale * (1.0 + self.gains.adaptation * dt * known * surplus)).clamp(0.8, 1.2)
        self._thrust_scale = torch.where(new, 1.0, scale)
        self._last_position, self._last_velocity = position.clone(), velocity.clone()

    def _predict(
        self, position: Tensor, attitude: Tensor, velocity: Tensor, body_rates: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The state when the coming action takes effect, from the command before it."""
        lag = self._latency
        settled = 1.0 - math.exp(-lag * self.parameters.rate_gain)
        later = torch.lerp(body_rates, self._last_command[:, 1:], settled * 0.5)
        attitude = turn(attitude, (body_rates + later) * (lag / 2.0))
        axis = rotate(attitude, _unit_z(position))
        force = axis * self._last_thrust - self._dynamics.drag_sideways * velocity
        acceleration = force - GRAVITY * _unit_z(position)
        return position + lag * velocity, attitude, velocity + lag * acceleration, later

    def _find(self, position: Tensor, target_gate: Tensor) -> Tensor:
        """The time on the line (N,) of its nearest point between the last gate and the target gate."""
        gap = self._search_positions[target_gate] - position.unsqueeze(1)  # (N, W, 3)
        nearest = gap.square().sum(-1).argmin(1, keepdim=True)
        time = self._search_times[target_gate].gather(1, nearest).squeeze(1)
        reference = self.line.at(time)
        along = ((position - reference.position) * reference.velocity).sum(-1)
        step = along / reference.velocity.square().sum(-1).clamp(min=0.1)
        return time + step.clamp(-self.SEARCH_DT, self.SEARCH_DT)

    def _desired_force(self, position: Tensor, velocity: Tensor, reference: Reference) -> tuple[Tensor, Tensor]:
        """Specific force (N, 3) in m/s², and the speed along the line relative to the line's own (N, 1).

        At a fraction λ of the line's speed the line asks for λ² of its acceleration, so that the drone can start from
        rest and fall behind without being pushed off the line.
        """
        gains = self.gains
        speed = reference.velocity.norm(dim=-1, keepdim=True).clamp(min=0.5)
        tangent = reference.velocity / speed
        progress = (velocity * tangent).sum(-1, keepdim=True) / speed
        beside = reference.position - position
        wanted = (1.2 - 0.4 * beside.norm(dim=-1, keepdim=True)).clamp(0.3, 1.0)
        limit = gains.progress_max / speed
        push = torch.minimum(torch.maximum(gains.progress * (wanted - progress), -limit), limit)
        progress = progress.clamp(0.0, 1.3)
        drift = velocity - (velocity * tangent).sum(-1, keepdim=True) * tangent
        correction = gains.position * beside - gains.velocity * drift
        size = correction.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        correction = correction * (gains.correction_max / size).clamp(max=1.0)
        acceleration = progress.square() * reference.acceleration + push * reference.velocity + correction
        return self._dynamics.force(velocity, acceleration), progress

    def _thrust(self, force: Tensor, attitude: Tensor, velocity: Tensor, time: Tensor) -> Tensor:
        """Collective thrust (N, 1) in m/s²: the force along the present axis, and what the motors' lag would lose."""
        axis = rotate(attitude, _unit_z(velocity))
        thrust = self._dynamics.collective_thrust(force, axis, velocity).unsqueeze(-1)
        now, soon = self.line.at(time), self.line.at(time + self.parameters.motor_time_constant)
        size_now = self._dynamics.force(now.velocity, now.acceleration).norm(dim=-1, keepdim=True)
        size_soon = self._dynamics.force(soon.velocity, soon.acceleration).norm(dim=-1, keepdim=True)
        return (thrust + size_soon - size_now).clamp(1.0, self._dynamics.thrust_max)

    def _roll_pitch_rates(
        self, force: Tensor, attitude: Tensor, body_rates: Tensor, reference: Reference, progress: Tensor
    ) -> Tensor:
        """Roll and pitch rates (N, 2) in rad/s that turn the thrust axis to the force."""
        gains, loop = self.gains, self.parameters.rate_gain
        wanted = torch.nn.functional.normalize(rotate_inverse(attitude, force), dim=-1)
        x, y, z = wanted.unbind(-1)
        sideways = torch.stack((-y, x, torch.zeros_like(x)), dim=-1)  # body z × wanted
        sine = sideways.norm(dim=-1, keepdim=True)
        error = sideways * (torch.atan2(sine, z.unsqueeze(-1)) / sine.clamp(min=1e-6))
        feedforward = rotate_inverse(attitude, progress * reference.body_rate)
        change = rotate_inverse(attitude, progress.square() * reference.angular_acceleration)
        damping = (gains.body_rate / loop - 1.0) * (feedforward - body_rates)
        rates = feedforward + damping + (change + gains.attitude * error) / loop
        excess = (rates[:, :2].abs() / self._rate_max[:2]).amax(dim=-1, keepdim=True).clamp(min=1.0)
        return rates[:, :2] / excess

    def _yaw_rate(self, position: Tensor, attitude: Tensor, time: Tensor) -> Tensor:
        """Yaw rate (N, 1) in rad/s that points the nose to where the line goes."""
        view = self.line.at(time + self.gains.look_ahead).position - position
        x, y, _ = rotate_inverse(attitude, torch.nn.functional.normalize(view, dim=-1)).unbind(-1)
        level = (x.square() + y.square()).sqrt()  # the less the target is beside the yaw axis, the less it says
        rate = self.gains.yaw * level * torch.atan2(y, x)
        return rate.clamp(-self._rate_max[2], self._rate_max[2]).unsqueeze(-1)


def _unit_z(like: Tensor) -> Tensor:
    """World or body z for each row of a (N, 3) tensor."""
    return like.new_tensor((0.0, 0.0, 1.0)).expand_as(like)


class PilotPolicy(TensorDictModuleBase):
    """The pilot as a policy of `DroneRacingEnv`: reads `("privileged", ...)`, writes `action`.

    It needs no `is_init`: the pilot notices by itself that a drone has been put elsewhere.

    Args:
        pilot: who flies.

    Example:
        >>> env = DroneRacingEnv("circle", num_envs=2, from_pixels=False)
        >>> env.rollout(100, PilotPolicy(ScriptedPilot(env.track)))["next", "race", "gates_passed"].max() > 0
        tensor(True)
    """

    def __init__(self, pilot: ScriptedPilot) -> None:
        super().__init__()
        names = ("position", "attitude", "linear_velocity", "body_rates", "target_gate")
        self.in_keys = [("privileged", name) for name in names]
        self.out_keys = ["action"]
        self.pilot = pilot

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the actions of the coming control step."""
        position, attitude, velocity, rates, gate = (tensordict.get(key) for key in self.in_keys)
        action = self.pilot.act(position, attitude, velocity, rates, gate.squeeze(-1))
        return tensordict.set("action", action.to(position))


@dataclass(frozen=True)
class FlownLaps:
    """What N episodes came to."""

    gates: Tensor  # (N,) int64, passed
    finished: Tensor  # (N,) bool: all laps, no crash
    crash: Tensor  # (N,) int64 `CrashCause`
    lap_times: Tensor  # (N, L) s; NaN where not flown; the first lap begins at rest
    speed_mean: Tensor  # (N,) m/s
    speed_max: Tensor  # (N,) m/s
    gate_offset_max: Tensor  # (N,) m
    gate_in_view: Tensor  # (N,) fraction of the time in which the nose camera sees the target gate's centre


def fly_laps(
    track: str | Track,
    preset: str | QuadrotorParameters = "easy",
    num_envs: int = 1,
    *,
    laps: int = 3,
    pilot: ScriptedPilot | None = None,
    randomise: bool = True,
    random_starts: bool = False,
    seed: int = 0,
    episode_steps: int = 1500,
) -> FlownLaps:
    """Fly N episodes to their ends.

    Args:
        track: name, path or `Track`.
        preset: physics preset or parameters.
        num_envs: N.
        laps: L.
        pilot: who flies; a `ScriptedPilot` with default limits if None.
        randomise: whether a preset's randomisation is on.
        random_starts: start as training does, instead of at the start pose.
        seed: of randomisation and starts.
        episode_steps: control steps until an episode is given up; 1500 are 30 s.
    """
    parameters = load_preset(preset)
    worlds = RaceWorlds(
        track,
        num_envs,
        parameters if randomise else without_randomisation(parameters),
        evaluation=not random_starts,
        from_pixels=False,
        episode_steps=episode_steps,
        seed=seed,
    )
    worlds.race.laps = laps
    pilot = pilot or ScriptedPilot(worlds.track, parameters, dtype=worlds.dtype)
    steps = _fly(worlds, pilot)
    worlds.close()
    return _summarise(steps, worlds.track.num_gates, laps)


@dataclass(frozen=True)
class _Step:
    """One control step of a flight; tensors (N,)."""

    outcome: RaceStep
    speed: Tensor  # m/s
    seen: Tensor  # bool: the target gate
    flew: Tensor  # bool: the episode was not over


def _fly(worlds: RaceWorlds, pilot: ScriptedPilot) -> list[_Step]:
    """Fly one episode in every world to its end."""
    pilot.reset()
    worlds.reset()
    flying = torch.ones(worlds.num_envs, dtype=torch.bool, device=worlds.device)
    steps = []
    while flying.any():
        state, gate = worlds.simulator.state, worlds.race.target_gate
        seen = _in_view(worlds, state.position, state.attitude)
        outcome = worlds.step(pilot.act(state.position, state.attitude, state.linear_velocity, state.body_rates, gate))
        steps.append(_Step(outcome, worlds.simulator.state.linear_velocity.norm(dim=-1), seen, flying))
        flying = flying & ~(outcome.terminated | outcome.truncated)
    return steps


def _in_view(worlds: RaceWorlds, position: Tensor, attitude: Tensor) -> Tensor:
    """Whether the centre of the target gate (N,) is inside the nose camera's image; gates in front are not minded."""
    camera = worlds.camera
    gates = worlds.track.gate_positions(position.device, position.dtype)
    view = rotate_inverse(attitude, gates[worlds.race.target_gate] - position) - position.new_tensor(camera.position)
    tilt = math.radians(camera.tilt)
    depth = view[:, 0] * math.cos(tilt) + view[:, 2] * math.sin(tilt)
    up = view[:, 2] * math.cos(tilt) - view[:, 0] * math.sin(tilt)
    reach = depth * math.tan(math.radians(camera.field_of_view) / 2.0)
    return (up.abs() < reach) & (view[:, 1].abs() < reach * camera.width / camera.height)


def _summarise(steps: list[_Step], num_gates: int, laps: int) -> FlownLaps:
    """Add up the control steps of a flight."""
    flew = torch.stack([step.flew for step in steps])  # (T, N)
    time = flew.sum(0)

    def outcomes(name: str) -> Tensor:
        return torch.stack([getattr(step.outcome, name) for step in steps]) * flew

    speed = torch.stack([step.speed for step in steps]) * flew
    gates, lap_time = outcomes("gates_passed"), outcomes("lap_time")
    at_lap = (gates // num_gates).unsqueeze(-1)  # (T, N, 1)
    lap_times = (lap_time.unsqueeze(-1) * (at_lap == torch.arange(1, laps + 1, device=speed.device))).amax(0)  # (N, L)
    return FlownLaps(
        gates=gates.amax(0),
        finished=outcomes("finished").any(0),
        crash=outcomes("crash").amax(0),
        lap_times=torch.where(lap_times > 0.0, lap_times, math.nan),
        speed_mean=speed.sum(0) / time,
        speed_max=speed.amax(0),
        gate_offset_max=outcomes("gate_offset").amax(0),
        gate_in_view=(torch.stack([step.seen for step in steps]) & flew).sum(0) / time,
    )
