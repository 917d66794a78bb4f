"""The physics of `FusedFlight` in torch: the reference that its kernels are compared with.

Shapes: N drones. SI units, attitude wxyz, body frame FLU.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, ROTOR_SPINS
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rate_loop import DroneParameter
from dreamer_racing.envs.drone.rotation import rotate, rotate_inverse, turn


def like(quadrotor: Quadrotor, values: object) -> Tensor:
    """Numbers as a tensor beside the drone's own."""
    return quadrotor.rotor_speed.new_tensor(values)


def effectiveness(quadrotor: Quadrotor) -> Tensor:
    """Rotor thrusts (N, 4) @ this (4, 6) are the wrench fx fy fz tx ty tz."""
    p = quadrotor.parameters
    rows = zip(p.rotor_positions, ROTOR_SPINS, strict=True)
    return like(quadrotor, [[0, 0, 1, y, -x, spin * p.torque_constant] for (x, y), spin in rows])


def gyroscopic_torque(quadrotor: Quadrotor, rates: Tensor) -> Tensor:
    """ω × Jω of the nominal body (N, 3)."""
    return torch.linalg.cross(rates, like(quadrotor, quadrotor.parameters.inertia) * rates)


def half_a_step_later(quadrotor: Quadrotor, rates: Tensor, torque: Tensor) -> Tensor:
    """Body rates (N, 3) after half a physics step under a torque (N, 3)."""
    p = quadrotor.parameters
    return rates + 0.5 * p.physics_dt * (torque - gyroscopic_torque(quadrotor, rates)) / like(quadrotor, p.inertia)


def mix(quadrotor: Quadrotor, thrust: Tensor, torque: Tensor) -> Tensor:
    """Rotor thrusts (N, 4) for a total thrust (N, 1) and torque (N, 3): yaw yields first, roll and pitch last."""
    limit = quadrotor.parameters.rotor_thrust_max
    allocation = torch.linalg.inv(effectiveness(quadrotor)[:, 2:])[1:]  # (3, 4)
    roll_pitch = torque[:, :2] @ allocation[:2]
    low, high = roll_pitch.aminmax(dim=1, keepdim=True)
    scale = (limit / (high - low)).clamp(max=1.0)  # x / 0 = inf → 1
    each = torch.minimum(torch.maximum(0.25 * thrust, -scale * low), limit - scale * high)
    base, yaw = each + scale * roll_pitch, torque[:, 2:] * allocation[2:]
    room = torch.where(yaw > 0.0, limit - base, base).clamp(min=0.0)
    share = (room / yaw.abs().clamp(min=1e-12)).amin(dim=1, keepdim=True).clamp(max=1.0)
    return (base + share * yaw).clamp(0.0, limit)


def _delayed_setpoint(quadrotor: Quadrotor, physics_step: int) -> Tensor:
    steps = quadrotor.parameters.physics_steps
    late = quadrotor.drones["delay_steps"] - physics_step  # (N,) physics steps to wait for the newest command
    age = torch.div(late + steps - 1, steps, rounding_mode="floor").clamp(0, len(quadrotor.setpoints) - 1)
    return quadrotor.setpoints[age, torch.arange(len(age))]


def _turn_rotors(quadrotor: Quadrotor, target: Tensor) -> Tensor:
    """Advance rotors towards target thrusts (N, 4) by a physics step; return the mid-step thrusts."""
    p, loop = quadrotor.parameters, quadrotor.rate_loop
    decay, decay_half, sag = like(quadrotor, [quadrotor.motor_decay, math.sqrt(quadrotor.motor_decay), 0.0])
    if loop is not None:
        decay, decay_half, sag = loop.drone_parameters[:, DroneParameter.MOTORS].split(1, dim=1)
    if p.motor_lag_of == "thrust":
        lag = quadrotor.rotor_speed.square() - target
        thrusts, speed = target + decay_half * lag, (target + decay * lag).sqrt()
    else:
        lag = quadrotor.rotor_speed - target.sqrt()
        thrusts, speed = (target.sqrt() + decay_half * lag).square(), target.sqrt() + decay * lag
    quadrotor.rotor_speed.copy_(speed)
    return thrusts * (1.0 - sag * thrusts.mean(1, keepdim=True) / p.rotor_thrust_max)


def _note_effort(quadrotor: Quadrotor, physics_step: int, asked: Tensor, target: Tensor) -> None:
    p = quadrotor.parameters
    idle = 0.0 if p.betaflight is None else p.betaflight.motor_idle
    low, high = target.aminmax(dim=1, keepdim=True)
    at_limit = (low <= p.rotor_thrust_max * idle**2 + 1e-6) | (high >= p.rotor_thrust_max - 1e-6)
    missing = (asked - target.sum(1, keepdim=True)).clamp(min=0.0)
    new = torch.cat((at_limit.to(asked), asked, missing), dim=1) / p.physics_steps
    quadrotor.effort.copy_(new if physics_step == 0 else quadrotor.effort + new)


def wrench(quadrotor: Quadrotor, physics_step: int, attitude: Tensor, velocity: Tensor, rates: Tensor) -> Tensor:
    """Advance controller and motors by a physics step; return the mid-step wrench on the nominal body (N, 6)."""
    p = quadrotor.parameters
    setpoint = _delayed_setpoint(quadrotor, physics_step)
    if quadrotor.rate_loop is None:
        torque = quadrotor.rotor_speed.square() @ effectiveness(quadrotor)[:, 3:]
        later = half_a_step_later(quadrotor, rates, torque)
        push = p.rate_gain * like(quadrotor, p.inertia) * (setpoint[:, 1:] - later)
        target = mix(quadrotor, setpoint[:, :1], gyroscopic_torque(quadrotor, later) + push)
    else:
        target = p.rotor_thrust_max * quadrotor.rate_loop.motor_commands(setpoint, rates).square()
    _note_effort(quadrotor, physics_step, setpoint[:, :1], target)
    result = _turn_rotors(quadrotor, target) @ effectiveness(quadrotor)
    if any(p.drag) or p.randomisation is not None:
        return _perturb(quadrotor, result, attitude, velocity, rates)
    return result


def _perturb(quadrotor: Quadrotor, nominal: Tensor, attitude: Tensor, velocity: Tensor, rates: Tensor) -> Tensor:
    """Add the mid-step drag, and convert the wrench of randomised drones to that of the nominal body."""
    p, own = quadrotor.parameters, quadrotor.drones
    velocity, inertia = rotate_inverse(attitude, velocity), like(quadrotor, p.inertia)  # body frame
    gravity = rotate_inverse(attitude, like(quadrotor, (0.0, 0.0, -GRAVITY)).expand_as(velocity))

    def force(velocity: Tensor) -> Tensor:
        return (own["thrust"] * nominal[:, :3] - own["drag"] * like(quadrotor, p.drag) * velocity) / own["mass"]

    acceleration = force(velocity) / p.mass + gravity - torch.linalg.cross(rates, velocity)
    torque = own["thrust"] * nominal[:, 3:]
    torque = torch.cat((torque[:, :2], own["torque"] * torque[:, 2:]), dim=1)
    if p.randomisation is not None:
        # J₀ J⁻¹ (τ − ω × Jω) + ω × J₀ω: Euler's equation of the randomised body, written for the nominal one
        own_gyroscopic = torch.linalg.cross(rates, own["inertia"] * inertia * rates)
        torque = (torque - own_gyroscopic) / own["inertia"] + gyroscopic_torque(quadrotor, rates)
    return torch.cat((force(velocity + 0.5 * p.physics_dt * acceleration), torque), dim=1)


class TorchFlight:
    """Quadrotors on MuJoCo's rigid bodies, with the arguments of `FusedFlight`."""

    def __init__(
        self, quadrotor: Quadrotor, qpos: Tensor, qvel: Tensor, qfrc_applied: Tensor, integrate: Callable[[], None]
    ) -> None:
        self.quadrotor, self.qpos, self.qvel = quadrotor, qpos, qvel
        self._force, self._integrate = qfrc_applied, integrate

    def step(self, physics_step: int) -> None:
        """Simulate one physics step, given its index in the control step."""
        attitude, velocity, rates = self.qpos[:, 3:], self.qvel[:, :3], self.qvel[:, 3:]
        self.apply(wrench(self.quadrotor, physics_step, attitude, velocity, rates))

    def apply(self, wrench: Tensor) -> None:
        """Move the bodies by one physics step under a wrench (N, 6), body frame."""
        quadrotor, attitude, rates = self.quadrotor, self.qpos[:, 3:], self.qvel[:, 3:]
        force, torque = wrench[:, :3], wrench[:, 3:]
        half_step = 0.5 * quadrotor.parameters.physics_dt
        corrected = quadrotor.parameters.integrator != "RK4"
        middle = half_a_step_later(quadrotor, rates, torque)
        force = force + half_step * torch.linalg.cross(middle, force)  # in its mid-step direction
        if corrected:
            torque = torque + gyroscopic_torque(quadrotor, rates) - gyroscopic_torque(quadrotor, middle)
        self._force.copy_(torch.cat((rotate(attitude, force), torque), dim=1))
        before = self.qvel.clone()
        self._integrate()
        if corrected:
            overshoot = half_step * (before - self.qvel)  # (N, 6), m and rad, negative
            self.qpos[:, :3] += overshoot[:, :3]
            self.qpos[:, 3:] = turn(self.qpos[:, 3:], overshoot[:, 3:])
