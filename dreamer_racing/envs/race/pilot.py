"""A scripted, state-based pilot that flies N drones along a planned racing line.

`ScriptedPilot` projects a drone onto the line (`envs.race.racing_line`) and controls it with position and velocity
feedback, acceleration and rate feedforward, and a prediction over the command delay. It is the reference for lap times,
and a demonstrator: it can also fly from the start poses of training episodes.

Shapes: N drones, K samples of the line. SI units, world z up, attitude wxyz, body frame FLU. All numbers are this
project's choice.
"""

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters, load_preset, without_randomisation
from dreamer_racing.envs.drone.rotation import rotate, rotate_inverse, turn
from dreamer_racing.envs.race.racing_line import Dynamics, LineLimits, Reference, plan_racing_line
from dreamer_racing.envs.tracks import Track, load_track


class ScriptedPilot:
    """Controller that flies N drones along the racing line of a track from their states.

    It keeps each drone's last command and an estimate of its thrust scale. It detects a new episode by a jump of the
    drone's position; calling `reset` is optional.

    Args:
        track: name, path or `Track`.
        parameters: preset or parameters of the drone; the pilot uses only the nominal ones, without randomisation.
        limits: limits of the line; its `speed` sets the aggressiveness. None for the defaults.

    Example:
        >>> pilot = ScriptedPilot("circle")
        >>> level, still = torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.zeros(1, 3)
        >>> pilot.act(torch.tensor([[4.0, -2.5, 1.35]]), level, still, still, torch.tensor([0])).shape
        torch.Size([1, 4])
    """

    WINDOW = 0.25  # s: the line is searched from this long before the last gate to this long after the target gate
    SEARCH_DT = 0.02  # s between the points of the search
    RESET_JUMP = 0.3  # m of displacement beyond the drone's own motion that indicates a reset
    LOOK_AHEAD = 0.5  # s: the nose points to the line's position this much later
    POSITION_GAIN = 14.0  # acceleration per metre of lateral error, 1/s²
    VELOCITY_GAIN = 6.0  # acceleration per m/s of lateral velocity error, 1/s
    PROGRESS_GAIN = 3.0  # of the speed error along the line, 1/s
    CORRECTION_MAX = 10.0  # acceleration from lateral errors, m/s²
    PROGRESS_MAX = 8.0  # acceleration from speed errors along the line, m/s²
    ATTITUDE_GAIN = 120.0  # angular acceleration per radian of thrust axis error, 1/s²
    BODY_RATE_GAIN = 17.0  # angular acceleration per rad/s of rate error, 1/s
    YAW_GAIN = 5.0  # yaw rate per radian of heading error, 1/s
    ADAPTATION = 1.0  # rate at which the thrust scale estimate follows the measurement, 1/s

    def __init__(
        self,
        track: str | Track,
        parameters: str | QuadrotorParameters = "easy",
        limits: LineLimits | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.track, self.parameters = load_track(track), load_preset(parameters)
        self.limits = limits or LineLimits()
        self._device, self._dtype = torch.device(device), dtype
        nominal = without_randomisation(self.parameters)
        self.line = plan_racing_line(self.track, nominal, self.limits).to(device, dtype)
        self._dynamics = Dynamics(nominal)
        self._rate_max = torch.tensor(nominal.body_rate_max, device=device, dtype=dtype)
        self._latency = nominal.command_delay + nominal.control_dt / 2.0  # s, to the middle of the action's effect
        self._make_search()
        self._last_position: Tensor | None = None  # (N, 3)
        self._last_velocity: Tensor  # (N, 3)
        self._last_command: Tensor  # (N, 4) m/s² and rad/s
        self._last_thrust: Tensor  # (N, 1) m/s², commanded thrust after motor lag
        self._thrust_scale: Tensor  # (N, 1) real thrust over nominal

    def _make_search(self) -> None:
        """Tabulate the points of the line that are searched for each target gate: times and positions (G, W, ·)."""
        line = self.line
        end = line.gate_times + self.WINDOW
        start = line.gate_times.roll(1) - self.WINDOW
        start[0] -= line.lap_time
        count = math.ceil(float((end - start).max()) / self.SEARCH_DT)
        share = torch.linspace(0.0, 1.0, count, device=self._device, dtype=self._dtype)
        self._search_times = torch.lerp(start.unsqueeze(-1), end.unsqueeze(-1), share)  # (G, W)
        points = [line.at(times).position for times in self._search_times]
        self._search_positions = torch.stack(points)  # (G, W, 3)

    def reset(self) -> None:
        """Clear the memory of all drones."""
        self._last_position = None

    @torch.no_grad()
    def act(
        self, position: Tensor, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor, target_gate: Tensor
    ) -> Tensor:
        """Compute the actions of the next control step.

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
        self._update_estimates(*state)
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

    def _update_estimates(self, position: Tensor, attitude: Tensor, velocity: Tensor, body_rates: Tensor) -> None:
        """Reset the memory of drones that jumped, and update the thrust scale estimate of the others."""
        dt, dynamics = self.parameters.control_dt, self._dynamics
        if self._last_position is None or len(self._last_position) != len(position):
            self._last_position, self._last_velocity = torch.full_like(position, math.nan), velocity
            self._last_command = torch.zeros_like(attitude)
            self._last_thrust, self._thrust_scale = torch.zeros_like(position[:, :1]), torch.ones_like(position[:, :1])
        velocity_mean = (velocity + self._last_velocity) / 2.0
        displacement_error = (position - self._last_position - dt * velocity_mean).norm(dim=-1, keepdim=True)
        new = ~(displacement_error < self.RESET_JUMP)  # NaN is new too
        hover = torch.nn.functional.pad(torch.full_like(displacement_error, GRAVITY), (0, 3))
        self._last_command = torch.where(new, hover, self._last_command)
        lag = self.parameters.motor_time_constant + self.parameters.command_delay
        thrust = torch.lerp(self._last_thrust, self._last_command[:, :1], min(1.0, dt / lag))
        self._last_thrust = torch.where(new, GRAVITY, thrust)
        force = dynamics.force(velocity_mean, (velocity - self._last_velocity) / dt)
        measured = dynamics.collective_thrust(force, rotate(attitude, _unit_z(position)), velocity).unsqueeze(-1)
        surplus = (measured / self._last_thrust.clamp(min=5.0)).clamp(0.7, 1.3) - 1.0
        # near the limit the mixer may trade thrust for roll and pitch, which must not affect the estimate
        known = (self._last_thrust > 8.0) & (self._last_thrust < 0.85 * dynamics.thrust_max)
        scale = (self._thrust_scale * (1.0 + self.ADAPTATION * dt * known * surplus)).clamp(0.8, 1.2)
        self._thrust_scale = torch.where(new, 1.0, scale)
        self._last_position, self._last_velocity = position.clone(), velocity.clone()

    def _predict(
        self, position: Tensor, attitude: Tensor, velocity: Tensor, body_rates: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Predict the state at the time at which the next action takes effect, under the previous command."""
        lag = self._latency
        settled = 1.0 - math.exp(-lag * self.parameters.rate_gain)
        later = torch.lerp(body_rates, self._last_command[:, 1:], settled * 0.5)
        attitude = turn(attitude, (body_rates + later) * (lag / 2.0))
        axis = rotate(attitude, _unit_z(position))
        force = axis * self._last_thrust - self._dynamics.drag_sideways * velocity
        acceleration = force - GRAVITY * _unit_z(position)
        return position + lag * velocity, attitude, velocity + lag * acceleration, later

    def _find(self, position: Tensor, target_gate: Tensor) -> Tensor:
        """Return the time (N,) of the line's nearest point between the last gate and the target gate."""
        gap = self._search_positions[target_gate] - position.unsqueeze(1)  # (N, W, 3)
        nearest = gap.square().sum(-1).argmin(1, keepdim=True)
        time = self._search_times[target_gate].gather(1, nearest).squeeze(1)
        reference = self.line.at(time)
        along = ((position - reference.position) * reference.velocity).sum(-1)
        step = along / reference.velocity.square().sum(-1).clamp(min=0.1)
        return time + step.clamp(-self.SEARCH_DT, self.SEARCH_DT)

    def _desired_force(self, position: Tensor, velocity: Tensor, reference: Reference) -> tuple[Tensor, Tensor]:
        """Return the specific force (N, 3) in m/s², and the ratio of the speed along the line to the line's own (N, 1).

        At a fraction λ of the line's speed, the line needs λ² of its acceleration, so the drone can start from rest or
        fall behind without being pushed off the line.
        """
        speed = reference.velocity.norm(dim=-1, keepdim=True).clamp(min=0.5)
        tangent = reference.velocity / speed
        progress = (velocity * tangent).sum(-1, keepdim=True) / speed
        beside = reference.position - position
        wanted = (1.2 - 0.4 * beside.norm(dim=-1, keepdim=True)).clamp(0.3, 1.0)
        limit = self.PROGRESS_MAX / speed
        push = torch.minimum(torch.maximum(self.PROGRESS_GAIN * (wanted - progress), -limit), limit)
        progress = progress.clamp(0.0, 1.3)
        drift = velocity - (velocity * tangent).sum(-1, keepdim=True) * tangent
        correction = self.POSITION_GAIN * beside - self.VELOCITY_GAIN * drift
        size = correction.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        correction = correction * (self.CORRECTION_MAX / size).clamp(max=1.0)
        acceleration = progress.square() * reference.acceleration + push * reference.velocity + correction
        return self._dynamics.force(velocity, acceleration), progress

    def _thrust(self, force: Tensor, attitude: Tensor, velocity: Tensor, time: Tensor) -> Tensor:
        """Return the collective thrust (N, 1) in m/s²: the force along the axis, plus motor lag compensation."""
        axis = rotate(attitude, _unit_z(velocity))
        thrust = self._dynamics.collective_thrust(force, axis, velocity).unsqueeze(-1)
        now, soon = self.line.at(time), self.line.at(time + self.parameters.motor_time_constant)
        size_now = self._dynamics.force(now.velocity, now.acceleration).norm(dim=-1, keepdim=True)
        size_soon = self._dynamics.force(soon.velocity, soon.acceleration).norm(dim=-1, keepdim=True)
        return (thrust + size_soon - size_now).clamp(1.0, self._dynamics.thrust_max)

    def _roll_pitch_rates(
        self, force: Tensor, attitude: Tensor, body_rates: Tensor, reference: Reference, progress: Tensor
    ) -> Tensor:
        """Return roll and pitch rates (N, 2) in rad/s that align the thrust axis with the force."""
        loop = self.parameters.rate_gain
        wanted = torch.nn.functional.normalize(rotate_inverse(attitude, force), dim=-1)
        x, y, z = wanted.unbind(-1)
        sideways = torch.stack((-y, x, torch.zeros_like(x)), dim=-1)  # body z × wanted
        sine = sideways.norm(dim=-1, keepdim=True)
        error = sideways * (torch.atan2(sine, z.unsqueeze(-1)) / sine.clamp(min=1e-6))
        feedforward = rotate_inverse(attitude, progress * reference.body_rate)
        change = rotate_inverse(attitude, progress.square() * reference.angular_acceleration)
        damping = (self.BODY_RATE_GAIN / loop - 1.0) * (feedforward - body_rates)
        rates = feedforward + damping + (change + self.ATTITUDE_GAIN * error) / loop
        excess = (rates[:, :2].abs() / self._rate_max[:2]).amax(dim=-1, keepdim=True).clamp(min=1.0)
        return rates[:, :2] / excess

    def _yaw_rate(self, position: Tensor, attitude: Tensor, time: Tensor) -> Tensor:
        """Return the yaw rate (N, 1) in rad/s that points the nose ahead along the line."""
        view = self.line.at(time + self.LOOK_AHEAD).position - position
        x, y, _ = rotate_inverse(attitude, torch.nn.functional.normalize(view, dim=-1)).unbind(-1)
        level = (x.square() + y.square()).sqrt()  # near the yaw axis, the heading error is ill-conditioned
        rate = self.YAW_GAIN * level * torch.atan2(y, x)
        return rate.clamp(-self._rate_max[2], self._rate_max[2]).unsqueeze(-1)


def _unit_z(like: Tensor) -> Tensor:
    """Return the unit z axis for each row of a (N, 3) tensor."""
    return like.new_tensor((0.0, 0.0, 1.0)).expand_as(like)


class PilotPolicy(TensorDictModuleBase):
    """The pilot as a policy of `DroneRacingEnv`: reads `("privileged", ...)`, writes `action`.

    It needs no `is_init`: the pilot detects resets itself.

    Example:
        >>> from dreamer_racing.envs import DroneRacingEnv
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
        """Write the actions of the next control step."""
        position, attitude, velocity, rates, gate = (tensordict.get(key) for key in self.in_keys)
        action = self.pilot.act(position, attitude, velocity, rates, gate.squeeze(-1))
        return tensordict.set("action", action.to(position))


def _hover(track: Track, parameters: QuadrotorParameters) -> TensorDictModuleBase:
    """Make the pilot that stays at the start."""
    still = torch.tensor([parameters.hover_action, 0.0, 0.0, 0.0])
    return TensorDictModule(lambda position: still.repeat(len(position), 1), [("privileged", "position")], ["action"])


PILOTS: dict[str, Callable[[Track, QuadrotorParameters], TensorDictModuleBase]] = {
    "scripted": lambda track, parameters: PilotPolicy(ScriptedPilot(track, parameters)),
    "hover": _hover,
}
"""Factories of policies that fly by the true state, given the track and the drone's parameters."""
