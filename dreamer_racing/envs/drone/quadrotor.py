"""The quadrotor: from collective thrust and body rates (CTBR) to the wrench on the body, for N drones at once.

A `Quadrotor` holds the state of the flight controller and the motors (rotor speeds, delayed commands) and each drone's
randomised parameters, in tensors that are updated in place, so that a CUDA graph can advance them. The rigid body
itself is integrated by MuJoCo: once per physics step the simulator calls `Quadrotor.wrench` for the body-frame force
and torque and applies it.

Shapes: N drones. SI units, body frame FLU. Its numbers and their sources: `envs.drone.parameters`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, ROTOR_SPINS, QuadrotorParameters, Randomisation
from dreamer_racing.envs.drone.rate_loop import DroneParameter, RateLoop
from dreamer_racing.envs.drone.rotation import rotate_inverse

RELATIVE = ("mass", "inertia", "drag", "thrust", "torque")  # parameters that are randomised by a factor


@dataclass
class _Drones:
    """Per-drone parameters relative to nominal (N, ·); only kept if they are randomised or commands are delayed."""

    mass: Tensor  # (N, 1)
    inertia: Tensor  # (N, 3)
    drag: Tensor  # (N, 1)
    thrust: Tensor  # (N, 1)
    torque: Tensor  # (N, 1)
    delay_steps: Tensor  # (N,) int64, physics steps


class Quadrotor:
    """Flight controllers and motors of N drones.

    Args:
        parameters: the drone.
        num_drones: N.
        device: device of the tensors.
        dtype: floating-point type; MuJoCo's own (float64) on CPU.
        generator: source of the per-episode randomisation, on `device`; needed only if parameters are randomised.

    Attributes:
        effort: (N, 3) of the control step so far: share of its physics steps with a rotor target at a limit, mean
            commanded collective thrust in N, and mean shortfall in N of the rotor targets, which the mixer reduces in
            favour of body rates or at the rotors' limits.

    Example:
        >>> quadrotor = Quadrotor(QuadrotorParameters(), num_drones=2)
        >>> quadrotor.command(torch.zeros(2, 4))
        >>> attitude = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
        >>> still = torch.zeros(2, 3, dtype=torch.float64)
        >>> quadrotor.wrench(0, attitude, still, still).shape
        torch.Size([2, 6])
    """

    def __init__(
        self,
        parameters: QuadrotorParameters,
        num_drones: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
        generator: torch.Generator | None = None,
    ) -> None:
        self.parameters = p = parameters
        self.num_drones = num_drones
        self._generator = generator
        self._device, self._dtype = torch.device(device), dtype

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        self._inertia = tensor(p.inertia)  # (3,)
        self._rate_gain = self._inertia * p.rate_gain  # (3,)
        self._drag = tensor(p.drag)  # (3,)
        self._gravity = tensor((0.0, 0.0, -GRAVITY)).expand(num_drones, 3)  # m/s², world frame
        self._has_drag = any(p.drag)
        # affine map from actions in [-1, 1] to total thrust, N, and body rates, rad/s
        thrust_scale = p.collective_thrust_scale * p.mass
        self._setpoint_scale = tensor((thrust_scale, *p.body_rate_max))  # (4,)
        self._setpoint_offset = tensor((thrust_scale, 0.0, 0.0, 0.0))  # (4,)
        # rotor thrusts (N, 4) @ effectiveness (4, 6) = wrench (fx fy fz tx ty tz)
        rows = zip(p.rotor_positions, ROTOR_SPINS, strict=True)
        self._effectiveness = tensor([[0, 0, 1, y, -x, s * p.torque_constant] for (x, y), s in rows])  # (4, 6)
        # (thrust tx ty tz) (N, 4) @ (4, 4) = rotor thrusts; the first row is a quarter each
        self.allocation = torch.linalg.inv(self._effectiveness[:, 2:])[1:]  # (3, 4): rotor thrusts per torque x, y, z
        self._roll_pitch_to_rotors, self._yaw_to_rotors = self.allocation[:2], self.allocation[2:]
        self._torque_effectiveness = self._effectiveness[:, 3:].contiguous()  # (4, 3)
        self.motor_decay = math.exp(-p.physics_dt / p.motor_time_constant)
        self._motor_decay_half = math.sqrt(self.motor_decay)
        self._half_step_per_inertia = 0.5 * p.physics_dt / self._inertia  # (3,)

        hover_speed = math.sqrt(p.mass * GRAVITY / 4.0)
        self._hover_speed = hover_speed
        self.rotor_speed = torch.full((num_drones, 4), hover_speed, device=device, dtype=dtype)  # √N: thrust = speed²
        delay_max = p.randomisation.delay_max if p.randomisation else p.command_delay
        self._nominal_delay_steps = round(p.command_delay / p.physics_dt)
        history = math.ceil(round(delay_max / p.physics_dt) / p.physics_steps)
        self._hover_setpoint = tensor((p.mass * GRAVITY, 0.0, 0.0, 0.0))
        self.setpoints = self._hover_setpoint.repeat(history + 1, num_drones, 1)  # newest first (history + 1, N, 4)
        self._drones = self._nominal_drones() if p.randomisation or history else None
        idle = 0.0 if p.betaflight is None else p.betaflight.motor_idle
        self.thrust_min = p.rotor_thrust_max * idle**2  # N, of a rotor
        self.effort = torch.zeros(num_drones, 3, device=device, dtype=dtype)
        self.rate_loop = None if p.betaflight is None else RateLoop(p, num_drones, device, dtype)
        self._lag_of_thrust = p.motor_lag_of == "thrust"
        if self.rate_loop is not None:
            self._set_motors(torch.ones(num_drones, 1, dtype=torch.bool, device=device), 1.0, 0.0)
        self._everyone = torch.arange(num_drones, device=device)

    def _nominal_drones(self) -> _Drones:
        one = torch.ones(self.num_drones, 1, device=self._device, dtype=self._dtype)
        delay = torch.full((self.num_drones,), self._nominal_delay_steps, device=self._device)
        return _Drones(one, one.repeat(1, 3), one.clone(), one.clone(), one.clone(), delay)

    def own_parameters(self) -> tuple[Tensor, ...]:
        """Return each drone's parameters, in tensors that are updated in place.

        Returns:
            Mass (N, 1), inertia (N, 3), drag, thrust and torque (N, 1) relative to nominal, and the command delay (N,),
            int64 physics steps.
        """
        drones = self._drones or self._nominal_drones()
        return tuple(getattr(drones, field.name) for field in fields(_Drones))

    def reset(self, mask: Tensor) -> None:
        """Reset the masked drones (N,) bool: rotors at hover, no pending commands, newly drawn parameters."""
        rows = mask.unsqueeze(-1)  # (N, 1)
        self.rotor_speed.masked_fill_(rows, self._hover_speed)
        self.setpoints.copy_(torch.where(rows, self._hover_setpoint, self.setpoints))
        widths = self.parameters.randomisation
        if widths is not None:
            self._randomise(rows, widths)
        if self.rate_loop is not None:
            frame = 0.0 if widths is None else (self._uniform(self.num_drones) * self.rate_loop.frame_steps).floor()
            self.rate_loop.reset(rows, frame)

    def _randomise(self, rows: Tensor, widths: Randomisation) -> None:
        drones = self._drones
        assert drones is not None
        for name in RELATIVE:
            current = getattr(drones, name)
            noise = 2.0 * self._uniform(*current.shape) - 1.0
            current.copy_(torch.where(rows, 1.0 + getattr(widths, name) * noise, current))
        delay = widths.delay_min + (widths.delay_max - widths.delay_min) * self._uniform(self.num_drones)
        delay = (delay / self.parameters.physics_dt).round().long()
        drones.delay_steps.copy_(torch.where(rows[:, 0], delay, drones.delay_steps))
        if self.rate_loop is not None:
            own = self.rate_loop.drone_parameters
            noise = 2.0 * self._uniform(self.num_drones, 4, 3) - 1.0
            relative = torch.cat((1.0 + widths.gains * noise[:, :3], 1.0 + widths.filters * noise[:, 3:]), dim=1)
            own[:, : DroneParameter.MOTORS] = torch.where(rows.unsqueeze(-1), relative, own[:, : DroneParameter.MOTORS])
            lag = 1.0 + widths.motor_lag * (2.0 * self._uniform(self.num_drones, 1) - 1.0)
            self._set_motors(rows, lag, widths.sag_max * self._uniform(self.num_drones, 1))

    def _set_motors(self, rows: Tensor, lag: Tensor | float, sag: Tensor | float) -> None:
        """Set the relative motor lag and the battery sag at full load of the masked drones (N, 1) bool."""
        assert self.rate_loop is not None
        motors = self.rate_loop.drone_parameters[:, DroneParameter.MOTORS]
        decay = math.log(self.motor_decay) / (torch.ones_like(motors[:, :1]) * lag)
        values = torch.cat((decay.exp(), (0.5 * decay).exp(), torch.zeros_like(decay) + sag), dim=1)
        motors.copy_(torch.where(rows, values, motors))

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self._generator, device=self._device, dtype=self._dtype)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of controllers and motors, and each drone's parameters."""
        drones = (
            None
            if self._drones is None
            else {field.name: getattr(self._drones, field.name).clone() for field in fields(_Drones)}
        )
        state = {"rotor_speed": self.rotor_speed.clone(), "setpoints": self.setpoints.clone(), "drones": drones}
        if self.rate_loop is not None:
            state |= {
                "rate_loop": self.rate_loop.state.clone(),
                "rate_loop_own": self.rate_loop.drone_parameters.clone(),
            }
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.rotor_speed.copy_(state_dict["rotor_speed"])
        self.setpoints.copy_(state_dict["setpoints"])
        if self._drones is not None:
            for name, value in state_dict["drones"].items():
                getattr(self._drones, name).copy_(value)
        if self.rate_loop is not None:
            self.rate_loop.state.copy_(state_dict["rate_loop"])
            self.rate_loop.drone_parameters.copy_(state_dict["rate_loop_own"])

    def command(self, action: Tensor) -> None:
        """Set the actions (N, 4) in [-1, 1] of the next control step: collective thrust and body rates x, y, z."""
        action = action.to(self._device, self._dtype).clamp(-1.0, 1.0)
        setpoint = torch.addcmul(self._setpoint_offset, action, self._setpoint_scale)
        self.setpoints.copy_(torch.cat((setpoint.unsqueeze(0), self.setpoints[:-1])))

    def _setpoint(self, physics_step: int) -> Tensor:
        """Return the delayed setpoint (N, 4) at this physics step of the control step."""
        if self._drones is None:
            return self.setpoints[0]
        late = self._drones.delay_steps - physics_step  # (N,) physics steps still to wait for the newest command
        age = torch.div(late + self.parameters.physics_steps - 1, self.parameters.physics_steps, rounding_mode="floor")
        return self.setpoints[age.clamp(0, len(self.setpoints) - 1), self._everyone]

    def wrench(self, physics_step: int, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor) -> Tensor:
        """Advance controller and motors by one physics step and return the mid-step wrench on the body.

        The proportional controller acts on the body rates half a step ahead, and the rotor speeds are those at
        mid-step, so that the discretisation error is of second order.

        Args:
            physics_step: index within the control step, 0 … physics_steps − 1.
            attitude: (N, 4) wxyz.
            linear_velocity: (N, 3) m/s, world frame.
            body_rates: (N, 3) rad/s, body frame.

        Returns:
            (N, 6) force in N and torque in N m, body frame, that give a body of *nominal* mass and inertia the
            acceleration of the randomised drone, so that all worlds can share one MuJoCo model.
        """
        setpoint = self._setpoint(physics_step)
        gyroscopic = self.gyroscopic_torque(body_rates)
        if self.rate_loop is None:
            present_torque = _product(self.rotor_speed.square(), self._torque_effectiveness)
            rates = self.rates_half_a_step_later(body_rates, present_torque, gyroscopic)
            torque = torch.addcmul(self.gyroscopic_torque(rates), self._rate_gain, setpoint[:, 1:] - rates)
            target = self.mix(setpoint[:, :1], torque).sqrt()
        else:
            commands = self.rate_loop.motor_commands(setpoint, body_rates)
            target = commands * math.sqrt(self.parameters.rotor_thrust_max)
        self._accumulate_effort(physics_step, setpoint[:, :1], target.square())
        thrusts = self._turn_rotors(target)
        wrench = _product(thrusts, self._effectiveness)
        if self._has_drag or self._drones is not None:
            wrench = self._perturb(wrench, attitude, linear_velocity, body_rates, gyroscopic)
        return wrench

    def _accumulate_effort(self, physics_step: int, asked: Tensor, targets: Tensor) -> None:
        """Add a physics step with commanded collective thrust (N, 1) and rotor thrust targets (N, 4) to `effort`."""
        low, high = targets.aminmax(dim=1, keepdim=True)
        at_limit = (low <= self.thrust_min + 1e-6) | (high >= self.parameters.rotor_thrust_max - 1e-6)
        missing = (asked - targets.sum(1, keepdim=True)).clamp(min=0.0)
        new = torch.cat((at_limit.to(asked), asked, missing), dim=1) / self.parameters.physics_steps
        self.effort.copy_(new if physics_step == 0 else self.effort + new)

    def _turn_rotors(self, target: Tensor) -> Tensor:
        """Advance rotors towards target speeds (N, 4) in √N by a physics step; return the mid-step thrusts, N."""
        decay: Tensor | float = self.motor_decay
        decay_half: Tensor | float = self._motor_decay_half
        if self.rate_loop is not None:
            decay, decay_half, sag = self.rate_loop.drone_parameters[:, DroneParameter.MOTORS].split(1, dim=1)
        speed = self.rotor_speed
        if self._lag_of_thrust:
            target, speed = target.square(), speed.square()
            thrusts = target + decay_half * (speed - target)
            self.rotor_speed.copy_((target + decay * (speed - target)).sqrt())
        else:
            thrusts = (target + decay_half * (speed - target)).square()
            self.rotor_speed.copy_(target + decay * (speed - target))
        if self.rate_loop is not None:
            load = thrusts.mean(1, keepdim=True) / self.parameters.rotor_thrust_max
            thrusts = thrusts * (1.0 - sag * load)
        return thrusts

    def gyroscopic_torque(self, body_rates: Tensor) -> Tensor:
        """Return ω × Jω of the nominal body (N, 3), N m, at body rates (N, 3), rad/s."""
        return torch.linalg.cross(body_rates, self._inertia * body_rates)

    def rates_half_a_step_later(self, body_rates: Tensor, torque: Tensor, gyroscopic: Tensor) -> Tensor:
        """Return body rates (N, 3), rad/s, after half a physics step under a torque (N, 3), given ω × Jω, N m."""
        return torch.addcmul(body_rates, torque - gyroscopic, self._half_step_per_inertia)

    def mix(self, thrust: Tensor, torque: Tensor) -> Tensor:
        """Distribute total thrust (N, 1) in N and torque (N, 3) in N m to rotor thrusts (N, 4) within their limits.

        If the limits cannot be met, yaw torque is reduced first, then total thrust, and roll and pitch last (together,
        keeping their direction) [choice].
        """
        limit = self.parameters.rotor_thrust_max
        roll_pitch = _product(torque[:, :2], self._roll_pitch_to_rotors)  # (N, 4), zero mean
        low, high = roll_pitch.aminmax(dim=1, keepdim=True)
        scale = (limit / (high - low)).clamp(max=1.0)  # x / 0 = inf → 1
        each = torch.minimum(torch.maximum(0.25 * thrust, -scale * low), limit - scale * high)
        base = torch.addcmul(each, scale, roll_pitch)
        yaw = torque[:, 2:] * self._yaw_to_rotors
        room = torch.where(yaw > 0.0, limit - base, base).clamp(min=0.0)
        share = (room / yaw.abs().clamp(min=1e-12)).amin(dim=1, keepdim=True).clamp(max=1.0)
        return torch.addcmul(base, share, yaw).clamp(0.0, limit)

    def _perturb(
        self, wrench: Tensor, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor, gyroscopic: Tensor
    ) -> Tensor:
        """Add the mid-step drag, and convert the wrench of randomised drones to that of the nominal body."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        drones = self._drones if self.parameters.randomisation is not None else None
        velocity = rotate_inverse(attitude, linear_velocity)  # body frame

        def with_drag(velocity: Tensor) -> Tensor:
            if drones is None:
                return force - self._drag * velocity
            return (drones.thrust * force - drones.drag * self._drag * velocity) / drones.mass

        acceleration = with_drag(velocity) / self.parameters.mass + rotate_inverse(attitude, self._gravity)
        change = acceleration - torch.linalg.cross(body_rates, velocity)  # in the rotating body frame, m/s²
        force = with_drag(torch.add(velocity, change, alpha=0.5 * self.parameters.physics_dt))
        if drones is None:
            return torch.cat((force, torque), dim=1)
        torque = drones.thrust * torque
        torque = torch.cat((torque[:, :2], drones.torque * torque[:, 2:]), dim=1)
        own_gyroscopic = torch.linalg.cross(body_rates, drones.inertia * self._inertia * body_rates)
        # J₀ J⁻¹ (τ − ω × Jω) + ω × J₀ω: Euler's equation of the randomised body, written for the nominal one
        torque = (torque - own_gyroscopic) / drones.inertia + gyroscopic
        return torch.cat((force, torque), dim=1)


def wrong_action_type(dtype: object) -> TypeError:
    """Return the error for actions that are not floating-point numbers."""
    return TypeError(f"Action of {dtype}: thrust and body rates are floating-point numbers in [-1, 1].")


def _product(values: Tensor, matrix: Tensor) -> Tensor:
    """Multiply (N, K) by (K, M) in full precision, which a matrix product on CUDA may lack (TF32)."""
    return (values.unsqueeze(-1) * matrix).sum(1) if values.is_cuda else values @ matrix
