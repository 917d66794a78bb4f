"""Betaflight's rate loop, from setpoints to motor commands, for N drones at once.

Channels are held and quantised; P, I and D act on the filtered gyro; the mixer first scales the correction to the
motors' range and then moves the throttle so that it fits (air mode). This is the torch reference of the kernel
`simulator.fused_rate_loop`. The numbers and their sources: `drone.betaflight`.

Not modelled, because they are switched off or without effect in the recording: feedforward (off), RC smoothing (off),
dynamic notches and RPM filters (no noise to filter), thrust linearisation and throttle boost (off).

Shapes: N drones; three axes are roll, pitch and yaw, FLU: +x right, +y nose down, +z left. Computes in deg/s.
"""

import enum
import math

import torch
from torch import Tensor

from dreamer_racing.envs.drone import betaflight
from dreamer_racing.envs.drone.betaflight import BetaflightParameters, full_stick
from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters


class Row(enum.IntEnum):
    """Rows of the firmware's state, three numbers each, one per axis unless stated otherwise."""

    SETPOINT = 0  # deg/s, held
    SETPOINT_SPEED = 1  # deg/s², smoothed
    SETPOINT_MEAN = 2  # deg/s², mean of this and the last frame
    GYRO_LPF2 = 3  # deg/s
    GYRO_LPF1 = 4  # deg/s, input of P and I
    DTERM_LPF1 = 5
    DTERM_LPF2 = 6  # input of D
    P = 7  # low-passed for yaw
    RELAX = 8  # deg/s, low-passed setpoint
    I = 9  # noqa: E741 - the letter of PID
    BOOST_1 = 10  # relative increase of D, low-passed
    BOOST_2 = 11
    THROTTLE = 12  # held value, value in the previous step, steps until the next frame
    ANTI_GRAVITY = 13  # first low-pass, second low-pass, unused


class DroneParameter(enum.IntEnum):
    """Rows of the parameters that may differ between drones, three numbers each."""

    P = 0  # relative, by axis
    I = 1  # relative, by axis  # noqa: E741 - the letter of PID
    D = 2
    FILTERS = 3  # relative cut-offs of gyro and D filters, unused
    MOTORS = 4  # decay in a physics step, in half a step, share of thrust lost to battery sag at full load


MIX = ((-1.0, -1.0, 1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (1.0, -1.0, -1.0, 1.0))
"""Mixer coefficients of roll, pitch and yaw by rotor: Betaflight's QUADX, yaw in FLU."""


def lowpass_gain(cutoff: Tensor | float, dt: float) -> Tensor | float:
    """Return the gain of a first-order low-pass in a step of ``dt``, as in Betaflight's PT1."""
    omega = 2.0 * math.pi * dt * cutoff
    return omega / (omega + 1.0)


def dynamic_cutoff(ends: tuple[float, float], expo: float, throttle: Tensor) -> Tensor:
    """Return the cut-off in Hz at a throttle in [0, 1]."""
    return ends[0] + (ends[1] - ends[0]) * throttle * (1.0 + (1.0 - throttle) * expo)


class RateLoop:
    """Rate loops of N Betaflight flight controllers.

    Args:
        parameters: the drone, whose `betaflight` is set.

    Attributes:
        state: (N, rows of `Row`, 3) their state, updated in place.
        drone_parameters: (N, rows of `DroneParameter`, 3) their individual parameters, updated in place.
    """

    def __init__(
        self,
        parameters: QuadrotorParameters,
        num_drones: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        assert parameters.betaflight is not None
        self.parameters: BetaflightParameters = parameters.betaflight
        self.dt = parameters.physics_dt
        self.frame_steps = max(1, round(1.0 / (self.parameters.link_rate * self.dt)))

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        p = self.parameters
        self.thrust_max = 4.0 * parameters.rotor_thrust_max  # N, at full command
        self.full_stick = tensor([full_stick(rate) for rate in parameters.body_rate_max])  # (3,) deg/s
        self.p = tensor(p.p) * betaflight.P_SCALE
        self.i = tensor(p.i) * betaflight.I_SCALE * tensor((1.0, 1.0, betaflight.YAW_I_SCALE))
        self.d = tensor(p.d) * betaflight.D_SCALE
        pairs = zip(p.d, p.d_max, strict=True)
        self.d_rise = tensor([max(high / low - 1.0, 0.0) if low else 0.0 for low, high in pairs])  # (3,) at most
        self.sum_limit = tensor(p.sum_limit)
        self.p_gain = tensor((1.0, 1.0, lowpass_gain(p.yaw_lowpass, self.dt)))  # of P's low-pass: yaw only
        self.level = tensor((1.0, 1.0, 0.0))  # axes with I-term relax and anti-gravity
        self.mix = tensor(MIX)  # (3, 4)
        self.state = torch.zeros(num_drones, len(Row), 3, device=device, dtype=dtype)
        self.drone_parameters = torch.ones(num_drones, len(DroneParameter), 3, device=device, dtype=dtype)
        self.hover_throttle = self._throttle(tensor([parameters.mass * GRAVITY])).item()
        self.reset(torch.ones(num_drones, 1, dtype=torch.bool, device=device))

    def reset(self, rows: Tensor, phase: Tensor | float = 0.0) -> None:
        """Reset the state of the masked drones to that in hover.

        Args:
            rows: mask of the drones, (N, 1) bool.
            phase: (N,) physics steps until the link's next frame.
        """
        fresh = torch.zeros_like(self.state)
        fresh[:, Row.THROTTLE, :2] = self.hover_throttle
        fresh[:, Row.THROTTLE, 2] = phase
        self.state.copy_(torch.where(rows.unsqueeze(-1), fresh, self.state))

    def _throttle(self, thrust: Tensor) -> Tensor:
        """Return the firmware's throttle in [0, 1] for a thrust in N, sent over a channel in whole µs."""
        p = self.parameters
        motor = (thrust / self.thrust_max).clamp(0.0, 1.0).sqrt()
        share = (motor - p.motor_idle) / (1.0 - p.motor_idle)
        way = 2000.0 - p.min_check
        return ((share * way + 0.5).floor() / way).clamp(0.0, 1.0)

    def receive(self, setpoint: Tensor) -> None:
        """Update the channels of the drones for which a link frame is due.

        Args:
            setpoint: (N, 4) collective thrust in N, body rates in rad/s.
        """
        p, state = self.parameters, self.state
        due = state[:, Row.THROTTLE, 2:] <= 0.0  # (N, 1)
        stick = (torch.rad2deg(setpoint[:, 1:]) / self.full_stick).clamp(-1.0, 1.0)
        wanted = (500.0 * stick + 0.5).floor() / 500.0 * self.full_stick  # whole µs
        speed = (wanted - state[:, Row.SETPOINT]) * p.link_rate
        interval = 1.0 / p.link_rate
        before = state[:, Row.SETPOINT_SPEED]
        smooth = torch.lerp(before, speed, interval / (interval + p.setpoint_smoothing))
        new = {
            Row.SETPOINT: wanted,
            Row.SETPOINT_MEAN: 0.5 * (before + smooth),
            Row.SETPOINT_SPEED: smooth,
        }
        for row, value in new.items():
            state[:, row] = torch.where(due, value, state[:, row])
        throttle = self._throttle(setpoint[:, :1])
        state[:, Row.THROTTLE, :1] = torch.where(due, throttle, state[:, Row.THROTTLE, :1])
        left = torch.where(due, float(self.frame_steps), state[:, Row.THROTTLE, 2:])
        state[:, Row.THROTTLE, 2:] = left - 1.0

    def motor_commands(self, setpoint: Tensor, body_rates: Tensor) -> Tensor:
        """Advance by one physics step; return the motor commands (N, 4) in [idle, 1].

        Args:
            setpoint: (N, 4) collective thrust in N and body rates in rad/s at the link's receiver.
            body_rates: (N, 3) rad/s, the gyro measurement.
        """
        self.receive(setpoint.to(self.state))
        throttle = self.state[:, Row.THROTTLE, :1]
        correction = self._correct(torch.rad2deg(body_rates.to(self.state)), throttle)
        self._update_anti_gravity(throttle)
        return self._mix(correction / 1000.0, throttle)

    def _lowpass(self, row: Row, value: Tensor, gain: Tensor | float) -> Tensor:
        """Low-pass a value (N, 3) into a row of the state; return the filtered value."""
        moved = self.state[:, row] + gain * (value - self.state[:, row])
        self.state[:, row] = moved
        return moved

    def _correct(self, gyro: Tensor, throttle: Tensor) -> Tensor:
        """Return P + I + D (N, 3), in thousandths of the motors' range."""
        p, own, dt = self.parameters, self.drone_parameters, self.dt
        filters = own[:, DroneParameter.FILTERS]
        gyro = self._lowpass(Row.GYRO_LPF2, gyro, lowpass_gain(p.gyro_lpf2 * filters[:, :1], dt))
        cutoff = dynamic_cutoff(p.gyro_lpf1, p.lpf_expo, throttle) * filters[:, :1]
        gyro = self._lowpass(Row.GYRO_LPF1, gyro, lowpass_gain(cutoff, dt))
        before = self.state[:, Row.DTERM_LPF2].clone()
        cutoff = dynamic_cutoff(p.dterm_lpf1, p.lpf_expo, throttle) * filters[:, 1:2]
        slow = self._lowpass(Row.DTERM_LPF1, gyro, lowpass_gain(cutoff, dt))
        slow = self._lowpass(Row.DTERM_LPF2, slow, lowpass_gain(p.dterm_lpf2 * filters[:, 1:2], dt))

        setpoint = self.state[:, Row.SETPOINT]
        error = setpoint - gyro
        moving = (setpoint - self._lowpass(Row.RELAX, setpoint, lowpass_gain(p.iterm_relax_cutoff, dt))).abs()
        relax = (1.0 - self.level * moving / p.iterm_relax_threshold).clamp(min=0.0)
        lift = p.anti_gravity_gain * self.state[:, Row.ANTI_GRAVITY, 1:2]  # (N, 1)
        proportional = self._lowpass(Row.P, self.p * own[:, DroneParameter.P] * error, self.p_gain)
        calm = (setpoint.abs() / 50.0).clamp(min=1.0)
        proportional = proportional * (1.0 + self.level * lift / calm * betaflight.ANTI_GRAVITY_P)
        gain = self.i * own[:, DroneParameter.I] + self.level * lift * betaflight.ANTI_GRAVITY_I
        integral = self.state[:, Row.I] + gain * dt * relax * error
        limit = p.iterm_windup * self.sum_limit
        self.state[:, Row.I] = integral = torch.minimum(torch.maximum(integral, -limit), limit)

        boost = self.d_rise * self.state[:, Row.SETPOINT_MEAN].abs() * (p.d_max_advance * betaflight.D_MAX_SCALE)
        gain_of_boost = lowpass_gain(betaflight.D_MAX_CUTOFF * betaflight.PT2_CORRECTION, dt)
        boost = self._lowpass(Row.BOOST_2, self._lowpass(Row.BOOST_1, boost, gain_of_boost), gain_of_boost)
        rise = 1.0 + torch.minimum(boost, self.d_rise)
        excess = (throttle - p.tpa_breakpoint).clamp(min=0.0)
        attenuation = 1.0 - p.tpa_rate / (1.0 - p.tpa_breakpoint) * excess
        derivative = self.d * own[:, DroneParameter.D] * (before - slow) / dt * rise * attenuation
        total = proportional + integral + derivative
        return torch.minimum(torch.maximum(total, -self.sum_limit), self.sum_limit)

    def _update_anti_gravity(self, throttle: Tensor) -> None:
        """Low-pass the throttle's changes for anti-gravity, weighted more at low and at falling throttle (N, 1)."""
        p, state = self.parameters, self.state
        low = 1.0 - throttle
        change = throttle - state[:, Row.THROTTLE, 1:2]
        weighted_change = change.abs() / self.dt * low * low * torch.where(change > 0.0, 0.5 * low, 1.0)
        gain = lowpass_gain(p.anti_gravity_cutoff * betaflight.PT2_CORRECTION, self.dt)
        first = state[:, Row.ANTI_GRAVITY, :1] + gain * (weighted_change - state[:, Row.ANTI_GRAVITY, :1])
        second = state[:, Row.ANTI_GRAVITY, 1:2] + gain * (first - state[:, Row.ANTI_GRAVITY, 1:2])
        state[:, Row.ANTI_GRAVITY, :1], state[:, Row.ANTI_GRAVITY, 1:2] = first, second
        state[:, Row.THROTTLE, 1:2] = throttle.clone()

    def _mix(self, correction: Tensor, throttle: Tensor) -> Tensor:
        """Mix a correction (N, 3), as a share of the motors' range, and the throttle into motor commands (N, 4)."""
        idle = self.parameters.motor_idle
        mix = (correction.unsqueeze(-1) * self.mix).sum(1)  # (N, 4)
        low, high = mix.amin(1, keepdim=True).clamp(max=0.0), mix.amax(1, keepdim=True).clamp(min=0.0)
        scale = 1.0 / (high - low).clamp(min=1.0)
        throttle = torch.minimum(torch.maximum(throttle, -scale * low), 1.0 - scale * high)
        return idle + (1.0 - idle) * (scale * mix + throttle).clamp(0.0, 1.0)
