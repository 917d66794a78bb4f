"""Settings of a Betaflight flight controller, as plain numbers without torch.

Gains are in the units of the firmware's CLI, so that a ``diff all`` of a drone can be copied. Sources of numbers:
[doc] Betaflight's documentation and the defaults of 4.5 to 2026.6; [set] set by `hil.betaflight`; [rec] identified
from a recording of an unmodified firmware (`benchmarks/betaflight.py`); [choice] this project's choice.

Reference: https://betaflight.com/docs/wiki/guides/current/PID-Tuning-Guide, …/Freestyle-Tuning-Principles (filters,
TPA, D-max, anti-gravity, I-term relax), …/Betaflight-2025.12-CLI-commands (defaults); the firmware's
src/main/flight/pid.c, pid.h, pid_init.c, mixer.c, src/main/fc/rc.c and src/main/common/filter.c, for details that are
not documented.
"""

import math
from dataclasses import dataclass

from dreamer_racing.settings import NOT_NEGATIVE, POSITIVE, SHARE, Range, check_settings, check_three, setting

P_SCALE, I_SCALE, D_SCALE = 0.032029, 0.244381, 0.000529
"""Values of one unit of the gains, in thousandths of the motor range per deg/s, deg and deg/s² [doc]."""

YAW_I_SCALE = 2.5
"""Additional factor of yaw's I in the firmware [doc]."""

ANTI_GRAVITY_I, ANTI_GRAVITY_P = 0.34, 0.0034
"""Anti-gravity per unit of smoothed throttle change per second: addition to I, and relative increase of P [doc]."""

D_MAX_SCALE = 0.00008 / 35.0
"""Scale of d_max_advance: relative increase of D, up to D-max, per deg/s² of setpoint change [doc]."""

D_MAX_CUTOFF = 35.0
"""Cut-off of the second-order low-pass of the increase from D to D-max, Hz [doc]."""

PT2_CORRECTION = 1.0 / math.sqrt(math.sqrt(2.0) - 1.0)
"""Ratio of the cut-off of each of two equal first-order low-passes to that of the two in series [doc]."""


@dataclass(frozen=True)
class BetaflightParameters:
    """Settings of Betaflight's rate loop; tuples of three are roll, pitch and yaw.

    Raises:
        ValueError: the message gives the value, and what is allowed.

    Example:
        >>> BetaflightParameters(p=(50, 52, 30)).p
        (50, 52, 30)
    """

    p: tuple[float, float, float] = (45.0, 47.0, 30.0)  # [doc]; yaw [set], as it oscillates with its default, 45
    i: tuple[float, float, float] = (80.0, 84.0, 5.0)  # [doc]; yaw [set]: its default is 80
    d: tuple[float, float, float] = (30.0, 34.0, 0.0)  # on measurement [doc]
    d_max: tuple[float, float, float] = (40.0, 46.0, 0.0)  # D while setpoints move [doc]
    # D-max by the setpoint's change [rec]; the default is 20, with a feedforward boost that is not modelled. D-max by
    # the gyro (d_max_gain) has no visible effect in the recording and is not modelled
    d_max_advance: float = setting(40.0, NOT_NEGATIVE)
    # s, time constant of the setpoint's change: feedforward_smooth_factor 65
    setpoint_smoothing: float = setting(0.0074, NOT_NEGATIVE)
    gyro_lpf1: tuple[float, float] = (250.0, 500.0)  # Hz, first order, at zero and full throttle [doc]
    gyro_lpf2: float = setting(500.0, POSITIVE)  # Hz, first order [doc]
    dterm_lpf1: tuple[float, float] = (75.0, 150.0)  # Hz, first order, at zero and full throttle [doc]
    dterm_lpf2: float = setting(150.0, POSITIVE)  # Hz, first order [doc]
    lpf_expo: float = setting(0.5, SHARE)  # curve of both lpf1 between their ends: dyn_expo 5 [doc]
    yaw_lowpass: float = setting(100.0, POSITIVE)  # Hz, first order, on yaw's P [doc]
    iterm_relax_cutoff: float = setting(15.0, POSITIVE)  # Hz: roll and pitch integrate less while setpoints move [doc]
    iterm_relax_threshold: float = setting(40.0, POSITIVE)  # deg/s of high-passed setpoint that stop integration [doc]
    iterm_windup: float = setting(0.8, SHARE)  # limit of I, as a share of sum_limit [doc]
    sum_limit: tuple[float, float, float] = (500.0, 500.0, 400.0)  # limit of P + I + D, of 1000 [doc]
    anti_gravity_gain: float = setting(80.0, NOT_NEGATIVE)  # increases P and I while the throttle changes [doc]
    anti_gravity_cutoff: float = setting(5.0, POSITIVE)  # Hz, second order [doc]
    tpa_rate: float = setting(0.65, SHARE)  # relative reduction of D at full throttle [doc]
    tpa_breakpoint: float = setting(0.35, Range(0, 0.99))  # throttle above which D is reduced [doc]
    motor_idle: float = setting(0.055, Range(0, 0.2))  # motor command at zero throttle [doc]
    min_check: float = setting(1050.0, Range(1000, 1500))  # µs of the channel at zero throttle [doc]
    link_rate: float = setting(100.0, POSITIVE)  # Hz of channel frames, held in between, in whole µs [set]

    def __post_init__(self) -> None:
        prefix = "BetaflightParameters: "
        check_settings(self, prefix)
        for name in ("p", "i", "d", "d_max", "sum_limit"):
            check_three(prefix + name, getattr(self, name), NOT_NEGATIVE)
        for name in ("gyro_lpf1", "dterm_lpf1"):
            ends = getattr(self, name)
            if not (isinstance(ends, tuple) and len(ends) == 2 and all(end in POSITIVE for end in ends)):
                raise ValueError(f"{prefix}{name}={ends!r}: must be two cut-offs above 0, in Hz.")


def full_stick(body_rate: float) -> float:
    """Return the full-stick rate setting, deg/s, with which a flight controller can reach a body rate in rad/s.

    The setting has steps of 10 deg/s; it is rounded up.
    """
    return 10.0 * math.ceil(math.degrees(body_rate) / 10.0 - 1e-6)
