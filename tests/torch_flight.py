"""The physics of `FusedFlight`, and Betaflight's rate loop, in torch: the reference that kernels are compared with.

Shapes: N drones. SI units, attitude wxyz, body frame FLU.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dreamer_racing.envs.drone import betaflight
from dreamer_racing.envs.drone.parameters import GRAVITY, ROTOR_SPINS, QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rate_loop import DroneParameter, RateLoop, Row, lowpass_gain
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
        target = p.rotor_thrust_max * motor_commands(quadrotor.rate_loop, p, setpoint, rates).square()
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


MIX = ((-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (1.0, -1.0, -1.0, 1.0))
"""Mixer coefficients of roll, pitch and yaw by rotor: Betaflight's QUADX, yaw in FLU."""


def _throttle(loop: RateLoop, thrust: Tensor) -> Tensor:
    """The firmware's throttle in [0, 1] for a thrust in N, sent over a channel in whole µs."""
    p = loop.parameters
    motor = (thrust / loop.thrust_max).clamp(0.0, 1.0).sqrt()
    share, way = (motor - p.motor_idle) / (1.0 - p.motor_idle), 2000.0 - p.min_check
    return ((share * way + 0.5).floor() / way).clamp(0.0, 1.0)


def _receive(loop: RateLoop, drone: QuadrotorParameters, setpoint: Tensor) -> None:
    """Update the channels of the drones for which a link frame is due."""
    p, state = loop.parameters, loop.state
    due = state[:, Row.THROTTLE, 2:] <= 0.0  # (N, 1)
    full_stick = state.new_tensor([betaflight.full_stick(rate) for rate in drone.body_rate_max])
    stick = (torch.rad2deg(setpoint[:, 1:]) / full_stick).clamp(-1.0, 1.0)
    wanted = (500.0 * stick + 0.5).floor() / 500.0 * full_stick  # whole µs
    speed, before = (wanted - state[:, Row.SETPOINT]) * p.link_rate, state[:, Row.SETPOINT_SPEED]
    smooth = torch.lerp(before, speed, 1.0 / (1.0 + p.link_rate * p.setpoint_smoothing))
    mean = 0.5 * (before + smooth)
    for row, value in ((Row.SETPOINT, wanted), (Row.SETPOINT_MEAN, mean), (Row.SETPOINT_SPEED, smooth)):
        state[:, row] = torch.where(due, value, state[:, row])
    throttle = _throttle(loop, setpoint[:, :1])
    state[:, Row.THROTTLE, :1] = torch.where(due, throttle, state[:, Row.THROTTLE, :1])
    state[:, Row.THROTTLE, 2:] = torch.where(due, float(loop.frame_steps), state[:, Row.THROTTLE, 2:]) - 1.0


def _correct(loop: RateLoop, gyro: Tensor, throttle: Tensor, dt: float) -> Tensor:
    """P + I + D (N, 3), in thousandths of the motors' range, from body rates in deg/s."""
    p, state, own, tensor = loop.parameters, loop.state, loop.drone_parameters, loop.state.new_tensor
    filters = own[:, DroneParameter.FILTERS]

    def lowpass(row: Row, value: Tensor, gain: Tensor | float) -> Tensor:
        state[:, row] += gain * (value - state[:, row])
        return state[:, row].clone()

    def cutoff(ends: tuple[float, float]) -> Tensor:
        return ends[0] + (ends[1] - ends[0]) * throttle * (1.0 + (1.0 - throttle) * p.lpf_expo)

    gyro = lowpass(Row.GYRO_LPF2, gyro, lowpass_gain(p.gyro_lpf2 * filters[:, :1], dt))
    gyro = lowpass(Row.GYRO_LPF1, gyro, lowpass_gain(cutoff(p.gyro_lpf1) * filters[:, :1], dt))
    before = state[:, Row.DTERM_LPF2].clone()
    slow = lowpass(Row.DTERM_LPF1, gyro, lowpass_gain(cutoff(p.dterm_lpf1) * filters[:, 1:2], dt))
    slow = lowpass(Row.DTERM_LPF2, slow, lowpass_gain(p.dterm_lpf2 * filters[:, 1:2], dt))

    level = tensor((1.0, 1.0, 0.0))  # axes with I-term relax and anti-gravity
    setpoint = state[:, Row.SETPOINT]
    error = setpoint - gyro
    moving = (setpoint - lowpass(Row.RELAX, setpoint, lowpass_gain(p.iterm_relax_cutoff, dt))).abs()
    relax = (1.0 - level * moving / p.iterm_relax_threshold).clamp(min=0.0)
    lift = p.anti_gravity_gain * state[:, Row.ANTI_GRAVITY, 1:2]  # (N, 1)
    gains = [tensor(gain) * own[:, row] for row, gain in enumerate((p.p, p.i, p.d))]  # rows of `DroneParameter`
    yaw_only = tensor((1.0, 1.0, lowpass_gain(p.yaw_lowpass, dt)))
    proportional = lowpass(Row.P, betaflight.P_SCALE * gains[0] * error, yaw_only)
    calm = (setpoint.abs() / 50.0).clamp(min=1.0)
    proportional = proportional * (1.0 + level * lift / calm * betaflight.ANTI_GRAVITY_P)
    gain = betaflight.I_SCALE * tensor((1.0, 1.0, betaflight.YAW_I_SCALE)) * gains[1]
    limit = tensor(p.sum_limit)
    integral = state[:, Row.I] + (gain + level * lift * betaflight.ANTI_GRAVITY_I) * dt * relax * error
    state[:, Row.I] = integral = integral.clamp(-p.iterm_windup * limit, p.iterm_windup * limit)

    rises = tensor([max(high / low - 1.0, 0.0) if low else 0.0 for low, high in zip(p.d, p.d_max, strict=True)])
    boost = rises * state[:, Row.SETPOINT_MEAN].abs() * (p.d_max_advance * betaflight.D_MAX_SCALE)
    slowly = lowpass_gain(betaflight.D_MAX_CUTOFF * betaflight.PT2_CORRECTION, dt)
    boost = lowpass(Row.BOOST_2, lowpass(Row.BOOST_1, boost, slowly), slowly)
    attenuation = 1.0 - p.tpa_rate / (1.0 - p.tpa_breakpoint) * (throttle - p.tpa_breakpoint).clamp(min=0.0)
    rise = (1.0 + torch.minimum(boost, rises)) * attenuation
    derivative = betaflight.D_SCALE * gains[2] * (before - slow) / dt * rise
    return (proportional + integral + derivative).clamp(-limit, limit)


def _feel_throttle(loop: RateLoop, throttle: Tensor, dt: float) -> None:
    """Low-pass the throttle's changes for anti-gravity, weighted more at low and at falling throttle (N, 1)."""
    state, low, change = loop.state, 1.0 - throttle, throttle - loop.state[:, Row.THROTTLE, 1:2]
    felt = change.abs() / dt * low * low * torch.where(change > 0.0, 0.5 * low, 1.0)
    for column in (0, 1):
        before = state[:, Row.ANTI_GRAVITY, column].unsqueeze(1)
        gain = lowpass_gain(loop.parameters.anti_gravity_cutoff * betaflight.PT2_CORRECTION, dt)
        felt = before + gain * (felt - before)
        state[:, Row.ANTI_GRAVITY, column] = felt[:, 0]
    state[:, Row.THROTTLE, 1:2] = throttle


def motor_commands(loop: RateLoop, drone: QuadrotorParameters, setpoint: Tensor, body_rates: Tensor) -> Tensor:
    """`RateLoop.motor_commands`: advance by a physics step; the motor commands (N, 4) in [idle, 1]."""
    _receive(loop, drone, setpoint)
    throttle, idle = loop.state[:, Row.THROTTLE, :1].clone(), loop.parameters.motor_idle
    correction = _correct(loop, torch.rad2deg(body_rates), throttle, drone.physics_dt) / 1000.0
    _feel_throttle(loop, throttle, drone.physics_dt)
    mixed = correction @ loop.state.new_tensor(MIX)  # (N, 4)
    low, high = mixed.amin(1, keepdim=True).clamp(max=0.0), mixed.amax(1, keepdim=True).clamp(min=0.0)
    scale = 1.0 / (high - low).clamp(min=1.0)
    throttle = torch.minimum(torch.maximum(throttle, -scale * low), 1.0 - scale * high)
    return idle + (1.0 - idle) * (scale * mixed + throttle).clamp(0.0, 1.0)


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
