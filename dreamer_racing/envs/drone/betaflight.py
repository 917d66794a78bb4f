"""What a Betaflight flight controller is set to, as plain numbers: no torch in here.

Gains are in the units of the firmware's CLI, so that a ``diff all`` of a drone can be copied. Sources of numbers:
[doc] Betaflight's documentation and the defaults of 4.5 to 2026.6; [set] what `hil.betaflight` sets a flight controller
to; [rec] what a recording of an unmodified firmware shows (`benchmarks/betaflight.py`); [choice] this project's.

Reference: https://betaflight.com/docs/wiki/guides/current/PID-Tuning-Guide, …/Freestyle-Tuning-Principles (filters,
TPA, D-max, anti-gravity, I-term relax), …/Betaflight-2025.12-CLI-commands (defaults); the firmware's
src/main/flight/pid.c, pid.h, pid_init.c, mixer.c, src/main/fc/rc.c and src/main/common/filter.c, for what its
documentation leaves open.
"""

import math
from dataclasses import dataclass, fields

from dreamer_racing.settings import (
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Range,
    check_numbers,
    check_settings,
    check_three,
    setting,
)

P_SCALE, I_SCALE, D_SCALE = 0.032029, 0.244381, 0.000529
"""Of a gain's unit: of 1000 of motor range per deg/s, deg and deg/s² [doc]."""

YAW_I_SCALE = 2.5
"""Of yaw's I besides, which the firmware multiplies so [doc]."""

ANTI_GRAVITY_I, ANTI_GRAVITY_P = 0.34, 0.0034
"""Of the anti-gravity gain, per unit of smoothed throttle change per second: added to I, and to P as a factor [doc]."""

D_MAX_SCALE = 0.00008 / 35.0
"""Of d_max_advance: share of the way from D to D-max per deg/s² of setpoint [doc]."""

D_MAX_CUTOFF = 35.0
"""Hz, second order, of the way from D to D-max [doc]."""

PT2_CORRECTION = 1.0 / math.sqrt(math.sqrt(2.0) - 1.0)
"""By which each of two equal first-order filters is faster than both together [doc]."""


@dataclass(frozen=True)
class BetaflightParameters:
    """The rate loop of a Betaflight: roll, pitch and yaw where there are three numbers.

    Raises:
        ValueError: the message gives the number, and what is allowed.

    Example:
        >>> BetaflightParameters(p=(50, 52, 30)).p
        (50, 52, 30)
    """

    p: tuple[float, float, float] = (45.0, 47.0, 30.0)  # [doc]; yaw [set], or it swings: its default is 45
    i: tuple[float, float, float] = (80.0, 84.0, 5.0)  # [doc]; yaw [set]: its default is 80
    d: tuple[float, float, float] = (30.0, 34.0, 0.0)  # on measurement [doc]
    d_max: tuple[float, float, float] = (40.0, 46.0, 0.0)  # D while setpoints move [doc]
    # of the setpoint's change [rec]; the default is 20, with a boost of the feedforward that is not modelled. D-max by
    # the gyro (d_max_gain) does not show in the recording and is left out
    d_max_advance: float = setting(40.0, NOT_NEGATIVE)
    setpoint_smoothing: float = setting(
        0.0074, NOT_NEGATIVE
    )  # s, of the setpoint's change: feedforward_smooth_factor 65
    gyro_lpf1: tuple[float, float] = (250.0, 500.0)  # Hz, first order, at least and full throttle [doc]
    gyro_lpf2: float = setting(500.0, POSITIVE)  # Hz, first order [doc]
    dterm_lpf1: tuple[float, float] = (75.0, 150.0)  # Hz, first order, at least and full throttle [doc]
    dterm_lpf2: float = setting(150.0, POSITIVE)  # Hz, first order [doc]
    lpf_expo: float = setting(0.5, SHARE)  # curve of both between the ends: dyn_expo 5 [doc]
    yaw_lowpass: float = setting(100.0, POSITIVE)  # Hz, first order, on yaw's P [doc]
    iterm_relax_cutoff: float = setting(15.0, POSITIVE)  # Hz: roll and pitch integrate less while setpoints move [doc]
    iterm_relax_threshold: float = setting(40.0, POSITIVE)  # deg/s of setpoint above that: they do not at all [doc]
    iterm_windup: float = setting(0.8, SHARE)  # of the sum's limit: I stays within [doc]
    sum_limit: tuple[float, float, float] = (500.0, 500.0, 400.0)  # of P + I + D, of 1000 [doc]
    anti_gravity_gain: float = setting(80.0, NOT_NEGATIVE)  # more P and I while the throttle moves [doc]
    anti_gravity_cutoff: float = setting(5.0, POSITIVE)  # Hz, second order [doc]
    tpa_rate: float = setting(0.65, SHARE)  # share of D that is taken away at full throttle [doc]
    tpa_breakpoint: float = setting(0.35, Range(0, 0.99))  # throttle from which on it is [doc]
    motor_idle: float = setting(0.055, Range(0, 0.2))  # motor command at least throttle [doc]
    min_check: float = setting(1050.0, Range(1000, 1500))  # µs, where the throttle begins [doc]
    link_rate: float = setting(100.0, POSITIVE)  # Hz, of channels: held in between, in whole µs [set]

    def __post_init__(self) -> None:
        prefix = "BetaflightParameters: "
        plain = [field.name for field in fields(self) if field.type is float]
        check_numbers({}, {prefix + name: getattr(self, name) for name in plain})
        check_settings(self, prefix)
        for name in ("p", "i", "d", "d_max", "sum_limit"):
            check_three(prefix + name, getattr(self, name), NOT_NEGATIVE)
        for name in ("gyro_lpf1", "dterm_lpf1"):
            ends = getattr(self, name)
            if not (isinstance(ends, tuple) and len(ends) == 2 and all(end in POSITIVE for end in ends)):
                raise ValueError(f"{prefix}{name}={ends!r}: must be two cut-offs above 0, in Hz.")


def full_stick(body_rate: float) -> float:
    """Return the rate at full stick, deg/s, of a flight controller that is to reach a body rate in rad/s.

    It is set in steps of 10 deg/s, and rounded up.
    """
    return 10.0 * math.ceil(math.degrees(body_rate) / 10.0 - 1e-6)
