"""`RateLoop` as a warp function that the kernels of `fused_flight` call: one drone's firmware in one physics step.

`drone.rate_loop.RateLoop` is the torch reference against which this is tested.
"""

# warp evaluates annotations, which mypy does not accept as types: no `from __future__ import annotations` here
# mypy: disable-error-code="valid-type,index,no-untyped-def,operator"

from functools import cache
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone import betaflight
from dreamer_racing.envs.drone.rate_loop import DroneParameter, RateLoop, Row, lowpass_gain
from dreamer_racing.envs.simulator.warp_device import load_warp


def arrays(rate_loop: RateLoop | None, like: Tensor) -> list[Any]:
    """Return a rate loop's state and per-drone parameters as warp arrays; two dummy arrays if there is none."""
    warp = load_warp()
    none = like.new_zeros(1, 1, 3)
    tensors = (none, none) if rate_loop is None else (rate_loop.state, rate_loop.drone_parameters)
    row = warp.types.vector(3, warp.dtype_from_torch(like.dtype))
    return [warp.from_torch(tensor, dtype=row) for tensor in tensors]


def fill(rate_loop: RateLoop | None, struct: Any) -> Any:
    """Return the filled struct of constants; an empty one if there is no rate loop."""
    firmware = struct()
    if rate_loop is None:
        return firmware
    p, dt = rate_loop.parameters, rate_loop.dt
    interval, twice = 1.0 / p.link_rate, betaflight.PT2_CORRECTION
    firmware.dt, firmware.radian = dt, 2.0 * torch.pi * dt
    firmware.thrust_max, firmware.idle = rate_loop.thrust_max, p.motor_idle
    firmware.throttle_way = 2000.0 - p.min_check
    firmware.frame_steps, firmware.link_rate = float(rate_loop.frame_steps), p.link_rate
    firmware.setpoint_gain = interval / (interval + p.setpoint_smoothing)
    for name in ("p", "i", "d", "d_rise", "sum_limit", "p_gain", "level", "full_stick"):
        setattr(firmware, name, getattr(rate_loop, name).tolist())
    firmware.i_limit = (p.iterm_windup * rate_loop.sum_limit).tolist()
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


@cache
def make_kernels(dtype: torch.dtype) -> tuple[Any, Any]:
    """Make the struct of constants that all flight controllers share, and `motor_commands`, for a type of numbers."""
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
        d_rise: vec3
        sum_limit: vec3
        i_limit: vec3
        p_gain: vec3
        level: vec3
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
        held = memory[i, THROTTLE]
        if held[2] <= real(0.0):
            wanted = vec3()
            before = memory[i, SETPOINT_SPEED]
            for axis in range(3):
                stick = wp.clamp(rates[axis] * real(DEGREES) / f.full_stick[axis], real(-1.0), real(1.0))
                wanted[axis] = wp.floor(real(500.0) * stick + real(0.5)) / real(500.0) * f.full_stick[axis]
            smooth = before + f.setpoint_gain * (f.link_rate * (wanted - memory[i, SETPOINT]) - before)
            memory[i, SETPOINT] = wanted
            memory[i, SETPOINT_SPEED] = smooth
            memory[i, SETPOINT_MEAN] = real(0.5) * (before + smooth)
            held = vec3(throttle_of(f, thrust), held[1], f.frame_steps)
        memory[i, THROTTLE] = vec3(held[0], held[1], held[2] - real(1.0))

    @wp.func
    def feel_throttle(f: Firmware, i: int, memory: wp.array2d(dtype=vec3)):
        held = memory[i, THROTTLE]
        felt = memory[i, ANTI_GRAVITY]
        low = real(1.0) - held[0]
        change = held[0] - held[1]
        moved = wp.abs(change) / f.dt * low * low
        if change > real(0.0):
            moved = moved * real(0.5) * low
        first = felt[0] + f.lift_cutoff * (moved - felt[0])
        memory[i, ANTI_GRAVITY] = vec3(first, felt[1] + f.lift_cutoff * (first - felt[1]), real(0.0))
        memory[i, THROTTLE] = vec3(held[0], held[0], held[2])

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
        filters = own[i, OWN_FILTERS]
        first = memory[i, GYRO_LPF2]
        first = first + share(f, f.gyro_lpf2 * filters[0]) * (real(DEGREES) * rates - first)
        gyro = memory[i, GYRO_LPF1]
        gyro = gyro + share(f, cutoff_at(f, f.gyro_low, f.gyro_high, throttle) * filters[0]) * (first - gyro)
        slow = memory[i, DTERM_LPF1]
        slow = slow + share(f, cutoff_at(f, f.dterm_low, f.dterm_high, throttle) * filters[1]) * (gyro - slow)
        before = memory[i, DTERM_LPF2]
        slower = before + share(f, f.dterm_lpf2 * filters[1]) * (slow - before)
        memory[i, GYRO_LPF2] = first
        memory[i, GYRO_LPF1] = gyro
        memory[i, DTERM_LPF1] = slow
        memory[i, DTERM_LPF2] = slower
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
        throttle = memory[i, THROTTLE][0]
        setpoint = memory[i, SETPOINT]
        gyro, change = filter_gyro(f, i, rates, throttle, memory, own)
        relaxed = memory[i, RELAX]
        relaxed = relaxed + f.relax_gain * (setpoint - relaxed)
        proportional = memory[i, PROPORTIONAL]
        integral = memory[i, INTEGRAL]
        boost_1 = memory[i, BOOST_1]
        boost_2 = memory[i, BOOST_2]
        mean = memory[i, SETPOINT_MEAN]
        lift = f.lift_gain * memory[i, ANTI_GRAVITY][1]
        own_p, own_i, own_d = own[i, OWN_P], own[i, OWN_I], own[i, OWN_D]
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
        memory[i, RELAX] = relaxed
        memory[i, PROPORTIONAL] = proportional
        memory[i, INTEGRAL] = integral
        memory[i, BOOST_1] = boost_1
        memory[i, BOOST_2] = boost_2
        feel_throttle(f, i, memory)
        return mix(f, throttle, correction)

    return Firmware, motor_commands


DEGREES = 57.29577951308232  # per radian
# rows of `Row` and `DroneParameter` as plain integers, which warp's compiler needs
SETPOINT, SETPOINT_SPEED, SETPOINT_MEAN = int(Row.SETPOINT), int(Row.SETPOINT_SPEED), int(Row.SETPOINT_MEAN)
GYRO_LPF2, GYRO_LPF1 = int(Row.GYRO_LPF2), int(Row.GYRO_LPF1)
DTERM_LPF1, DTERM_LPF2 = int(Row.DTERM_LPF1), int(Row.DTERM_LPF2)
PROPORTIONAL, RELAX, INTEGRAL = int(Row.P), int(Row.RELAX), int(Row.I)
BOOST_1, BOOST_2 = int(Row.BOOST_1), int(Row.BOOST_2)
THROTTLE, ANTI_GRAVITY = int(Row.THROTTLE), int(Row.ANTI_GRAVITY)
OWN_P, OWN_I, OWN_D = int(DroneParameter.P), int(DroneParameter.I), int(DroneParameter.D)
OWN_FILTERS = int(DroneParameter.FILTERS)
