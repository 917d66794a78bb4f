"""Physical and control parameters of the quadrotor, as plain numbers without torch.

Sources of numbers: [paper] Romero et al., "Dream to Fly"; [rpg] public code of the same laboratory; [choice] this
project's choice, as none is published; [rec] the drone in the Betaflight recording with which `drone.betaflight` is
compared.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from dreamer_racing.envs.drone.betaflight import BetaflightParameters
from dreamer_racing.settings import (
    NOT_NEGATIVE,
    POSITIVE,
    check_choice,
    check_numbers,
    check_settings,
    check_three,
    is_number,
    quoted,
    setting,
    suggestion,
)

T = TypeVar("T")
GRAVITY = 9.81  # m/s²
INTEGRATORS = ("Euler", "RK4")
"""MuJoCo's names of the allowed integrators: `FusedFlight` corrects Euler to second order; RK4 needs no correction."""
MOTOR_LAGS = ("speed", "thrust")
"""Quantity with first-order lag to its target: a rotor's speed, or its thrust, which is the square of the speed."""


@dataclass(frozen=True)
class Randomisation:
    """Half-widths of the uniform, per-episode randomisation of each drone, relative unless a unit is given [rpg]."""

    mass: float = 0.05
    inertia: float = 0.10  # each axis independently
    drag: float = 0.10
    thrust: float = 0.10  # all four rotors together: battery voltage
    torque: float = 0.01
    delay_max: float = setting(0.040, NOT_NEGATIVE)  # s; the command delay is uniform in [delay_min, delay_max]
    delay_min: float = setting(0.0, NOT_NEGATIVE)  # s
    # only for drones with a Betaflight controller
    gains: float = 0.0  # P, I and D of each axis independently
    filters: float = 0.0  # cut-offs of the gyro filters, and of the D-term filters
    motor_lag: float = 0.0
    sag_max: float = 0.0  # share of thrust lost to battery sag at full load, uniform in [0, sag_max]

    def __post_init__(self) -> None:
        widths = {f"Randomisation: {name}": width for name, width in vars(self).items()}
        check_numbers({}, widths)
        check_settings(self, "Randomisation: ")
        for name, width in widths.items():
            if not name.endswith(("delay_max", "delay_min")) and not 0.0 <= width < 1.0:
                raise ValueError(f"{name}={width}: a relative half-width, must be at least 0 and below 1.")
        if self.delay_min > self.delay_max:
            raise ValueError(f"Randomisation: delay_min={self.delay_min}: must be at most delay_max={self.delay_max}.")


@dataclass(frozen=True)
class QuadrotorParameters:
    """Physical and control parameters of the drone, in SI units.

    Raises:
        ValueError: the message gives the value, and what is allowed.

    Example:
        >>> QuadrotorParameters().hover_action
        -0.26407
    """

    mass: float = setting(0.6, POSITIVE)  # kg [paper]
    inertia: tuple[float, float, float] = (0.002410, 0.001800, 0.003759)  # kg m², principal axes = body axes [paper]
    arm_length: float = setting(0.14, POSITIVE)  # m, centre to rotor [paper]; X layout [choice]
    torque_constant: float = setting(0.022, POSITIVE)  # m: N m of yaw torque per N of rotor thrust [paper]
    rotor_thrust_max: float = setting(4.0, POSITIVE)  # N, thrust-to-weight ratio 2.72 [paper]
    motor_time_constant: float = 0.033  # s, first-order lag [rpg]; inf: constant speeds
    motor_lag_of: str = "speed"  # one of `MOTOR_LAGS`
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0)  # N/(m/s), linear rotor drag in the body frame
    body_rate_max: tuple[float, float, float] = (10.0, 10.0, 4.0)  # rad/s at action ±1 [rpg]
    collective_thrust_scale: float = setting(13.33, POSITIVE)  # m/s²: c = scale · (1 + a) [rpg]
    rate_gain: float = setting(15.0, POSITIVE)  # 1/s, proportional body-rate loop [choice]
    betaflight: BetaflightParameters | None = None  # replaces the proportional loop and its mixer
    command_delay: float = setting(0.0, NOT_NEGATIVE)  # s; with a `randomisation` the delay is drawn by that
    physics_dt: float = setting(0.002, POSITIVE)  # s [rpg]
    control_dt: float = setting(0.02, POSITIVE)  # s, 50 Hz [rpg]
    integrator: str = "Euler"  # one of `INTEGRATORS`
    randomisation: Randomisation | None = None

    def __post_init__(self) -> None:
        prefix, three = "QuadrotorParameters: ", {"inertia": POSITIVE, "drag": NOT_NEGATIVE, "body_rate_max": POSITIVE}
        check_settings(self, prefix)
        for name, allowed in three.items():
            check_three(prefix + name, getattr(self, name), allowed)
        if not (is_number(self.motor_time_constant) and self.motor_time_constant > 0.0):
            raise ValueError(f"{prefix}motor_time_constant={self.motor_time_constant}: must be above 0.")
        if self.integrator not in INTEGRATORS:
            there = " or ".join(INTEGRATORS)
            raise ValueError(f"{prefix}integrator={quoted(self.integrator)}: must be {there}, as MuJoCo calls them.")
        if self.motor_lag_of not in MOTOR_LAGS:
            raise ValueError(f"{prefix}motor_lag_of={quoted(self.motor_lag_of)}: must be {' or '.join(MOTOR_LAGS)}.")
        for name, kind in (("randomisation", Randomisation), ("betaflight", BetaflightParameters)):
            value = getattr(self, name)
            if not (value is None or isinstance(value, kind)):
                raise ValueError(f"{prefix}{name}={quoted(value)}: must be a {kind.__name__} or None.")
        steps = self.control_dt / self.physics_dt
        if abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
            raise ValueError(
                f"QuadrotorParameters: control_dt={self.control_dt} s must be a whole multiple of "
                f"physics_dt={self.physics_dt} s (e.g. 0.02 and 0.002)."
            )

    @property
    def physics_steps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_dt / self.physics_dt)

    @property
    def hover_action(self) -> float:
        """Collective-thrust action that holds altitude when level."""
        return round(GRAVITY / self.collective_thrust_scale - 1.0, 5)

    @property
    def rotor_positions(self) -> tuple[tuple[float, float], ...]:
        """(x, y) of the rotors in m: rear right, front right, rear left, front left (Betaflight's order)."""
        d = self.arm_length / math.sqrt(2.0)
        return ((-d, -d), (d, -d), (-d, d), (d, d))


ROTOR_SPINS = (1.0, -1.0, -1.0, 1.0)  # sign of the yaw torque on the body of each rotor (Betaflight's "props in")

PRESETS: dict[str, QuadrotorParameters] = {
    "easy": QuadrotorParameters(),
    "faithful": QuadrotorParameters(
        drag=(0.26, 0.28, 0.42),  # [rpg]
        command_delay=0.020,  # [rpg]
        physics_dt=0.001,  # [rpg]
        randomisation=Randomisation(),
    ),
    "betaflight": QuadrotorParameters(
        drag=(0.26, 0.28, 0.42),  # [rpg]
        motor_time_constant=0.030,  # [rec]
        motor_lag_of="thrust",  # [rec]
        betaflight=BetaflightParameters(),
        command_delay=0.010,  # [rec]: from the RC channel to the controller
        physics_dt=0.001,  # [rec]: the firmware's loop period
        randomisation=Randomisation(
            gains=0.2, filters=0.2, motor_lag=0.3, sag_max=0.15, delay_min=0.005, delay_max=0.035
        ),
    ),
}


SUFFIXES = (".yaml", ".yml")
"""File name suffixes of drone files."""


def load_preset(preset: str | QuadrotorParameters) -> QuadrotorParameters:
    """Return the parameters of a named preset (`easy`, `faithful`, `betaflight`), a drone file, or those given.

    A drone file, for example of a measured drone, varies a preset, whose randomisation stays; drawn delays are moved by
    the change of ``command_delay``::

        preset: betaflight
        parameters:                 # fields of `QuadrotorParameters`, in SI units
          mass: 0.62
          betaflight:               # fields of `BetaflightParameters`
            p: [45, 47, 30]
        about: {}                   # sources of the numbers; not read

    Raises:
        ValueError: unknown name, or an invalid drone file.
    """
    if isinstance(preset, QuadrotorParameters):
        return preset
    if isinstance(preset, str) and preset.endswith(SUFFIXES):
        return _read_drone(Path(preset))
    check_choice("preset", preset, sorted(PRESETS))
    return PRESETS[preset]


def name_of_preset(preset: str) -> str:
    """Return a preset's name; of a drone file its name and a hash of its content, without its folder."""
    if not preset.endswith(SUFFIXES):
        return preset
    return f"{Path(preset).name} {hashlib.sha256(Path(preset).read_bytes()).hexdigest()[:8]}"


def _read_drone(path: Path) -> QuadrotorParameters:
    if not path.is_file():
        raise ValueError(f"preset={path}: there is no such file.")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    changes = content.get("parameters", {}) if isinstance(content, dict) else None
    if not isinstance(changes, dict):
        raise ValueError(f"{path} is not a drone file: it needs preset: (a name) and parameters: (fields and values).")
    base = content.get("preset")
    if not isinstance(base, str) or base not in PRESETS:
        there = ", ".join(sorted(PRESETS))
        raise ValueError(f"{path}: preset: {quoted(base)} is not one of {there}{suggestion(str(base), PRESETS)}.")
    try:
        return _around_own_delay(PRESETS[base], _with_changes(PRESETS[base], changes))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _with_changes(base: T, changes: Mapping[str, Any]) -> T:
    """Return a copy of a dataclass with changed fields; lists become tuples, and mappings change inner dataclasses."""
    names = sorted(set(vars(base)) - {"randomisation"})
    values: dict[str, Any] = {}
    for name, value in changes.items():
        if name not in names:
            raise ValueError(f"there is no parameter {quoted(name)}{suggestion(name, names)}: {', '.join(names)}.")
        before = getattr(base, name)
        if isinstance(value, dict) and not is_dataclass(before):
            raise ValueError(f"{name}={quoted(value)}: {name} has no fields.")
        inner = isinstance(value, dict)
        values[name] = _with_changes(before, value) if inner else tuple(value) if isinstance(value, list) else value
    return replace(base, **values)  # type: ignore[type-var]  # a dataclass, of any kind


def _around_own_delay(base: QuadrotorParameters, drone: QuadrotorParameters) -> QuadrotorParameters:
    """Return a drone whose drawn delays lie around its own as those of ``base`` do; other widths are relative."""
    widths = drone.randomisation
    if widths is None:
        return drone
    change = drone.command_delay - base.command_delay
    moved = {name: max(getattr(widths, name) + change, 0.0) for name in ("delay_min", "delay_max")}
    return replace(drone, randomisation=replace(widths, **moved))


def save_drone(path: Path, drone: QuadrotorParameters, about: Mapping[str, Any]) -> None:
    """Write a drone to a .yaml file for `load_preset`, as differences from the preset `faithful` or `betaflight`.

    An existing file is replaced. The randomisation is not written; ``about`` are the numbers' sources, plain values.
    """
    base = "faithful" if drone.betaflight is None else "betaflight"
    content = {"preset": base, "parameters": _differences(PRESETS[base], drone), "about": dict(about)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100), encoding="utf-8")


def _differences(base: Any, changed: Any) -> dict[str, Any]:
    """Return the fields in which one dataclass differs from another, as plain values."""
    found: dict[str, Any] = {}
    for name, now in vars(changed).items():
        before = getattr(base, name)
        if before != now and name != "randomisation":
            inner = is_dataclass(before) and is_dataclass(now)
            found[name] = _differences(before, now) if inner else list(now) if isinstance(now, tuple) else now
    return found


MIN_CONTROL_RATE = 10.0
"""Lowest control rate, Hz, at which a drone at 18 m/s flies 1.8 m per step [choice]."""


def at_control_rate(parameters: QuadrotorParameters, rate: float | None) -> QuadrotorParameters:
    """Return the same drone at another control rate in Hz, or unchanged if None.

    Raises:
        ValueError: the rate is too low, or a control step would not be a whole number of physics steps.
    """
    if rate is None:
        return parameters
    check_numbers({}, {"control_rate": rate})
    if not rate >= MIN_CONTROL_RATE:
        raise ValueError(
            f"control_rate={rate} Hz: must be at least {MIN_CONTROL_RATE:g}: a control step may pass at most two gates."
        )
    steps = round(1.0 / (rate * parameters.physics_dt))
    if steps < 1 or abs(rate * steps * parameters.physics_dt - 1.0) > 1e-6:
        raise ValueError(
            f"control_rate={rate} Hz: a control step must be a whole number of physics steps of "
            f"{parameters.physics_dt * 1e3:g} ms, for example 50 or 25 Hz."
        )
    return replace(parameters, control_dt=steps * parameters.physics_dt)


def without_randomisation(parameters: QuadrotorParameters) -> QuadrotorParameters:
    """Return the same drone with nominal parameters in every episode (drag and delay stay)."""
    return replace(parameters, randomisation=None)
