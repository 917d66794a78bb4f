"""Betaflight's rate loop, from setpoints to motor commands, for N drones at once, as a warp function.

Channels are held and quantised; P, I and D act on the filtered gyro; the mixer first scales the correction to the
motors' range and then moves the throttle so that it fits (air mode). `simulator.fused_flight` calls it in every physics
step; `tests/torch_flight.py` states the same in torch. The numbers and their sources: `drone.betaflight`.

Not modelled, because they are switched off or without effect in the recording: feedforward (off), RC smoothing (off),
dynamic notches and RPM filters (no noise to filter), thrust linearisation and throttle boost (off).

Shapes: N drones; three axes are roll, pitch and yaw, FLU: +x right, +y nose down, +z left. Computes in deg/s.
"""

# warp evaluates annotations, which mypy does not accept as types: no `from __future__ import annotations` here
# mypy: disable-error-code="valid-type,index,no-untyped-def,operator"

import enum
import math
from functools import cache, cached_property
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone import betaflight
from dreamer_racing.envs.drone.betaflight import full_stick
from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters
from dreamer_racing.envs.simulator.warp_device import load_warp, scope

DEGREES = 57.29577951308232  # per radian


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


class RateLoop:
    """Rate loops of N Betaflight flight controllers.

    Args:
        drone: the drone, whose `betaflight` is set.

    Attributes:
        state: (N, rows of `Row`, 3) their state, updated in place.
        drone_parameters: (N, rows of `DroneParameter`, 3) their individual parameters, updated in place.
        frame_steps: physics steps from one frame of the link to the next.
        thrust_max: thrust at full command, N.
    """

    def __init__(
        self,
        drone: QuadrotorParameters,
        num_drones: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        assert drone.betaflight is not None
        self._drone, self.parameters = drone, drone.betaflight
        self.frame_steps = max(1, round(1.0 / (self.parameters.link_rate * drone.physics_dt)))
        self.thrust_max = 4.0 * drone.rotor_thrust_max
        self.state = torch.zeros(num_drones, len(Row), 3, device=device, dtype=dtype)
        self.drone_parameters = torch.ones(num_drones, len(DroneParameter), 3, device=device, dtype=dtype)
        p, way = self.parameters, 2000.0 - self.parameters.min_check
        motor = (self.state.new_tensor(drone.mass * GRAVITY) / self.thrust_max).clamp(0.0, 1.0).sqrt()
        share = (motor - p.motor_idle) / (1.0 - p.motor_idle)
        self._hover_throttle = ((share * way + 0.5).floor() / way).clamp(0.0, 1.0).item()  # sent in whole µs
        self.reset(torch.ones(num_drones, 1, dtype=torch.bool, device=device))

    def reset(self, rows: Tensor, phase: Tensor | float = 0.0) -> None:
        """Reset the state of the masked drones (N, 1) bool to that in hover, `phase` (N,) steps before a frame."""
        fresh = torch.zeros_like(self.state)
        fresh[:, Row.THROTTLE, :2] = self._hover_throttle
        fresh[:, Row.THROTTLE, 2] = phase
        self.state.copy_(torch.where(rows.unsqueeze(-1), fresh, self.state))

    def motor_commands(self, setpoint: Tensor, body_rates: Tensor) -> Tensor:
        """Advance by one physics step; return the motor commands (N, 4) in [idle, 1].

        Args:
            setpoint: (N, 4) collective thrust in N and body rates in rad/s at the link's receiver.
            body_rates: (N, 3) rad/s, the gyro measurement.
        """
        (given_setpoint, given_rates, commands), launch = self._advance
        given_setpoint.copy_(setpoint)
        given_rates.copy_(body_rates)
        with scope(self.state.device):
            launch.launch()
        return commands.clone()

    @cached_property
    def _advance(self) -> tuple[list[Tensor], Any]:
        """The kernel's setpoints (N, 4), body rates (N, 3) and motor commands (N, 4), and its recorded launch."""
        warp, like = load_warp(), self.state
        buffers = [like.new_empty(len(like), size) for size in (4, 3, 4)]
        inputs = [self.constants, *map(warp.from_torch, buffers), *arrays(self, like)]
        with scope(like.device):
            return buffers, warp.launch(make_kernels(like.dtype)[2], len(like), inputs=inputs, record_cmd=True)

    @cached_property
    def constants(self) -> Any:
        """The kernels' struct of what all flight controllers share."""
        drone, p, dt = self._drone, self.parameters, self._drone.physics_dt
        firmware = make_kernels(self.state.dtype)[0]()

        def tensor(*values: float) -> Tensor:
            return torch.tensor(values, dtype=self.state.dtype)

        rises = [max(high / low - 1.0, 0.0) if low else 0.0 for low, high in zip(p.d, p.d_max, strict=True)]
        vectors = {
            "full_stick": tensor(*map(full_stick, drone.body_rate_max)),
            "p": tensor(*p.p) * betaflight.P_SCALE,
            "i": tensor(*p.i) * betaflight.I_SCALE * tensor(1.0, 1.0, betaflight.YAW_I_SCALE),
            "d": tensor(*p.d) * betaflight.D_SCALE,
            "d_rise": tensor(*rises),
            "sum_limit": tensor(*p.sum_limit),
            "i_limit": p.iterm_windup * tensor(*p.sum_limit),
            "p_gain": tensor(1.0, 1.0, lowpass_gain(p.yaw_lowpass, dt)),
            "level": tensor(1.0, 1.0, 0.0),
        }
        for name, values in vectors.items():
            setattr(firmware, name, values.tolist())
        interval, twice = 1.0 / p.link_rate, betaflight.PT2_CORRECTION
        firmware.dt, firmware.radian = dt, 2.0 * torch.pi * dt
        firmware.thrust_max, firmware.idle = self.thrust_max, p.motor_idle
        firmware.throttle_way = 2000.0 - p.min_check
        firmware.frame_steps, firmware.link_rate = float(self.frame_steps), p.link_rate
        firmware.setpoint_gain = interval / (interval + p.setpoint_smoothing)
        firmware.gyro_low, firmware.gyro_high = p.gyro_lpf1
        firmware.dterm_low, firmware.dterm_high = p.dterm_lpf1
        firmware.gyro_lpf2, firmware.dterm_lpf2, firmware.expo = p.gyro_lpf2, p.dterm_lpf2, p.lpf_expo
        firmware.relax_gain, firmware.relax_threshold = lowpass_gain(p.iterm_relax_cutoff, dt), p.iterm_relax_threshold
        firmware.boost = p.d_max_advance * betaflight.D_MAX_SCALE
        firmware.boost_gain = lowpass_gain(betaflight.D_MAX_CUTOFF * twice, dt)
        firmware.lift_gain, firmware.lift_cutoff = p.anti_gravity_gain, lowpass_gain(p.anti_gravity_cutoff * twice, dt)
        firmware.lift_p, firmware.lift_i = betaflight.ANTI_GRAVITY_P, betaflight.ANTI_GRAVITY_I
        firmware.tpa, firmware.tpa_breakpoint = p.tpa_rate / (1.0 - p.tpa_breakpoint), p.tpa_breakpoint
        return firmware


def arrays(rate_loop: RateLoop | None, like: Tensor) -> list[Any]:
    """Return a rate loop's state and per-drone parameters as warp arrays; two dummy arrays if there is none."""
    warp = load_warp()
    none = like.new_zeros(1, 1, 3)
    tensors = (none, none) if rate_loop is None else (rate_loop.state, rate_loop.drone_parameters)
    row = warp.types.vector(3, warp.dtype_from_torch(like.dtype))
    return [warp.from_torch(tensor, dtype=row) for tensor in tensors]


def lowpass_gain(cutoff: Any, dt: float) -> Any:
    """Return the gain of a first-order low-pass in a step of ``dt``, as in Betaflight's PT1."""
    omega = 2.0 * math.pi * dt * cutoff
    return omega / (omega + 1.0)


@cache
def make_kernels(dtype: torch.dtype) -> tuple[Any, Any, Any]:
    """Make the struct of constants, `motor_commands`, and a kernel that only calls it, for a type of numbers."""
    wp = load_warp()
    real = wp.dtype_from_torch(dtype)
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)

    @wp.struct
    class Firmware:
        dt: real  # s
        radian: real  # s, 2π times the step
        thrust_max: real  # N
        idle: real
        throttle_way: real  # µs
        frame_steps: real
        link_rate: real  # Hz
        full_stick: vec3  # deg/s
        setpoint_gain: real
        p: vec3
        i: vec3
        d: vec3
        d_rise: vec3  # at most
        sum_limit: vec3
        i_limit: vec3
        p_gain: vec3  # of P's low-pass: yaw only
        level: vec3  # axes with I-term relax and anti-gravity
        gyro_low: real  # Hz
        gyro_high: real
        gyro_lpf2: real
        dterm_low: real
        dterm_high: real
        dterm_lpf2: real
        expo: real
        relax_gain: real
        relax_threshold: real  # deg/s
        boost: real
        boost_gain: real
        lift_gain: real
        lift_cutoff: real
        lift_p: real
        lift_i: real
        tpa: real
        tpa_breakpoint: real

    @wp.func
    def share(f: Firmware, cutoff: real):  # gain of a low-pass in a step
        omega = f.radian * cutoff
        return omega / (omega + real(1.0))

    @wp.func
    def cutoff_at(f: Firmware, low: real, high: real, throttle: real):
        return low + (high - low) * throttle * (real(1.0) + (real(1.0) - throttle) * f.expo)

    @wp.func
    def throttle_of(f: Firmware, thrust: real):
        motor = wp.sqrt(wp.clamp(thrust / f.thrust_max, real(0.0), real(1.0)))
        way = (motor - f.idle) / (real(1.0) - f.idle)
        return wp.clamp(wp.floor(way * f.throttle_way + real(0.5)) / f.throttle_way, real(0.0), real(1.0))

    @wp.func
    def receive(f: Firmware, i: int, thrust: real, rates: vec3, memory: wp.array2d(dtype=vec3)):
        held = memory[i, Row.THROTTLE]
        if held[2] <= real(0.0):
            wanted = vec3()
            before = memory[i, Row.SETPOINT_SPEED]
            for axis in range(3):
                stick = wp.clamp(rates[axis] * real(DEGREES) / f.full_stick[axis], real(-1.0), real(1.0))
                wanted[axis] = wp.floor(real(500.0) * stick + real(0.5)) / real(500.0) * f.full_stick[axis]
            smooth = before + f.setpoint_gain * (f.link_rate * (wanted - memory[i, Row.SETPOINT]) - before)
            memory[i, Row.SETPOINT] = wanted
            memory[i, Row.SETPOINT_SPEED] = smooth
            memory[i, Row.SETPOINT_MEAN] = real(0.5) * (before + smooth)
            held = vec3(throttle_of(f, thrust), held[1], f.frame_steps)
        memory[i, Row.THROTTLE] = vec3(held[0], held[1], held[2] - real(1.0))

    @wp.func
    def feel_throttle(f: Firmware, i: int, memory: wp.array2d(dtype=vec3)):
        held = memory[i, Row.THROTTLE]
        felt = memory[i, Row.ANTI_GRAVITY]
        low = real(1.0) - held[0]
        change = held[0] - held[1]
        moved = wp.abs(change) / f.dt * low * low
        if change > real(0.0):
            moved = moved * real(0.5) * low
        first = felt[0] + f.lift_cutoff * (moved - felt[0])
        memory[i, Row.ANTI_GRAVITY] = vec3(first, felt[1] + f.lift_cutoff * (first - felt[1]), real(0.0))
        memory[i, Row.THROTTLE] = vec3(held[0], held[0], held[2])

    @wp.func
    def mix(f: Firmware, throttle: real, c: vec3):
        shares = vec4(-c[0] + c[1] + c[2], -c[0] - c[1] - c[2], c[0] + c[1] - c[2], c[0] - c[1] + c[2])
        low, high = wp.min(wp.min(shares), real(0.0)), wp.max(wp.max(shares), real(0.0))
        scale = real(1.0) / wp.max(high - low, real(1.0))
        moved = wp.min(wp.max(throttle, -scale * low), real(1.0) - scale * high)
        for rotor in range(4):
            turned = wp.clamp(scale * shares[rotor] + moved, real(0.0), real(1.0))
            shares[rotor] = f.idle + (real(1.0) - f.idle) * turned
        return shares

    @wp.func
    def filter_gyro(
        f: Firmware, i: int, rates: vec3, throttle: real, memory: wp.array2d(dtype=vec3), own: wp.array2d(dtype=vec3)
    ):  # returns the filtered rates for P and I, and the decrease of those for D
        filters = own[i, DroneParameter.FILTERS]
        first = memory[i, Row.GYRO_LPF2]
        first = first + share(f, f.gyro_lpf2 * filters[0]) * (real(DEGREES) * rates - first)
        gyro = memory[i, Row.GYRO_LPF1]
        gyro = gyro + share(f, cutoff_at(f, f.gyro_low, f.gyro_high, throttle) * filters[0]) * (first - gyro)
        slow = memory[i, Row.DTERM_LPF1]
        slow = slow + share(f, cutoff_at(f, f.dterm_low, f.dterm_high, throttle) * filters[1]) * (gyro - slow)
        before = memory[i, Row.DTERM_LPF2]
        slower = before + share(f, f.dterm_lpf2 * filters[1]) * (slow - before)
        memory[i, Row.GYRO_LPF2] = first
        memory[i, Row.GYRO_LPF1] = gyro
        memory[i, Row.DTERM_LPF1] = slow
        memory[i, Row.DTERM_LPF2] = slower
        return gyro, before - slower

    @wp.func
    def motor_commands(
        f: Firmware,
        i: int,
        thrust: real,
        wanted: vec3,
        rates: vec3,
        memory: wp.array2d(dtype=vec3),
        own: wp.array2d(dtype=vec3),
    ):  # advances flight controller i by a physics step; returns its motor commands
        receive(f, i, thrust, wanted, memory)
        throttle = memory[i, Row.THROTTLE][0]
        setpoint = memory[i, Row.SETPOINT]
        gyro, change = filter_gyro(f, i, rates, throttle, memory, own)
        relaxed = memory[i, Row.RELAX]
        relaxed = relaxed + f.relax_gain * (setpoint - relaxed)
        proportional = memory[i, Row.P]
        integral = memory[i, Row.I]
        boost_1 = memory[i, Row.BOOST_1]
        boost_2 = memory[i, Row.BOOST_2]
        mean = memory[i, Row.SETPOINT_MEAN]
        lift = f.lift_gain * memory[i, Row.ANTI_GRAVITY][1]
        own_p, own_i, own_d = own[i, DroneParameter.P], own[i, DroneParameter.I], own[i, DroneParameter.D]
        attenuation = real(1.0) - f.tpa * wp.max(throttle - f.tpa_breakpoint, real(0.0))
        correction = vec3()
        for axis in range(3):
            error = setpoint[axis] - gyro[axis]
            moving = wp.abs(setpoint[axis] - relaxed[axis])
            relax = wp.max(real(1.0) - f.level[axis] * moving / f.relax_threshold, real(0.0))
            now = f.p[axis] * own_p[axis] * error
            proportional[axis] = proportional[axis] + f.p_gain[axis] * (now - proportional[axis])
            calm = wp.max(wp.abs(setpoint[axis]) / real(50.0), real(1.0))
            lifted = proportional[axis] * (real(1.0) + f.level[axis] * lift / calm * f.lift_p)
            gain = f.i[axis] * own_i[axis] + f.level[axis] * lift * f.lift_i
            now = integral[axis] + gain * f.dt * relax * error
            integral[axis] = wp.clamp(now, -f.i_limit[axis], f.i_limit[axis])
            raised = f.d_rise[axis] * wp.abs(mean[axis]) * f.boost
            boost_1[axis] = boost_1[axis] + f.boost_gain * (raised - boost_1[axis])
            boost_2[axis] = boost_2[axis] + f.boost_gain * (boost_1[axis] - boost_2[axis])
            rise = real(1.0) + wp.min(boost_2[axis], f.d_rise[axis])
            derivative = f.d[axis] * own_d[axis] * change[axis] / f.dt * rise * attenuation
            total = lifted + integral[axis] + derivative
            correction[axis] = wp.clamp(total, -f.sum_limit[axis], f.sum_limit[axis]) / real(1000.0)
        memory[i, Row.RELAX] = relaxed
        memory[i, Row.P] = proportional
        memory[i, Row.I] = integral
        memory[i, Row.BOOST_1] = boost_1
        memory[i, Row.BOOST_2] = boost_2
        feel_throttle(f, i, memory)
        return mix(f, throttle, correction)

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        f: Firmware,
        setpoint: wp.array2d(dtype=real),
        rates: wp.array2d(dtype=real),
        commands: wp.array2d(dtype=real),
        memory: wp.array2d(dtype=vec3),
        own: wp.array2d(dtype=vec3),
    ):
        i = wp.tid()
        wanted = vec3(setpoint[i, 1], setpoint[i, 2], setpoint[i, 3])
        gyro = vec3(rates[i, 0], rates[i, 1], rates[i, 2])
        motors = motor_commands(f, i, setpoint[i, 0], wanted, gyro, memory, own)
        for rotor in range(4):
            commands[i, rotor] = motors[rotor]

    return Firmware, motor_commands, advance
