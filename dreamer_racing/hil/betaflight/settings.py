"""The Betaflight settings that an actor needs, and their comparison with those of a flight controller.

Reference: https://betaflight.com/docs/wiki/guides/current/Betaflight-2025.12-CLI-commands and the same page of 4.5:
names, ranges and defaults. The firmware's src/main/fc/rc.c: rates; src/main/cli/cli.c: what a dump looks like;
src/main/flight/pid.h, src/main/pg/rx.c and src/main/sensors/gyro.c: defaults of feedforward, smoothing, spin recovery.
serial_update_rate_hz: src/main/msp/msp_serial.c (mspSerialProcess), src/main/fc/tasks.c. MSP override:
https://betaflight.com/docs/wiki/guides/current/MSP-Companion-Computer-Control.
"""

from __future__ import annotations

import enum
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

from dreamer_racing.hil.betaflight.status import ANGLE, ARM, HORIZON, MSP_OVERRIDE
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.settings import check_choice

AXES = {"roll": "body_rate_x", "pitch": "body_rate_y", "yaw": "body_rate_z"}
LINKS = ("crsf", "sbus", "msp", "msp_override", "betaflight_sitl")

_STEP = math.radians(10.0)  # rad/s: the unit of rc_rate and srate under ACTUAL rates
_LARGEST = 199  # in this unit: setpoints end at 1998 deg/s
_DEFAULTS_SINCE = (4, 5)  # release from which on the defaults below are known to hold
_NO_DUMP = (
    "This is not a dump of a Betaflight flight controller: {}. Open the CLI of the configurator, type `dump all`, save "
    "its output to a file, and give that file."
)


class Setting(NamedTuple):
    """A required setting."""

    name: str  # name of the setting, or of another property read from the dump
    value: str
    reason: str
    # the firmware's default, if it does not depend on board or release; `diff` leaves it out
    default: str | None = None
    section: str = ""  # `profile` or `rateprofile` if each profile has its own
    line: str = ""  # line for the CLI; made from name and value if empty
    former: str = ""  # its name in older releases
    absent: bool = False  # whether a firmware without the setting behaves as required: then `dump all` need not name it

    @property
    def command(self) -> str:
        """The line to type into the CLI."""
        if self.name.startswith("feature "):
            return self.name.replace(" ", " " if self.value == "ON" else " -")
        return self.line or f"set {self.name} = {self.value}"


class Status(enum.Enum):
    """How a flight controller's setting compares."""

    OK = "ok"
    DIFFERS = "differs"
    MISSING = "missing"


class Finding(NamedTuple):
    """A compared setting: the required one, the result, and the value found (None: unknown)."""

    wanted: Setting
    status: Status
    found: str | None

    def __str__(self) -> str:
        note = ""
        if self.status is Status.DIFFERS:
            note = f"found {self.found}: {self.wanted.reason}"
        elif self.status is Status.MISSING:
            note = "not in the text: use `dump all`, which lists every setting"
        return f"{self.status.value:8} {self.wanted.command:32} {note}".rstrip()


def rate_map(contract: dict[str, Any]) -> RateMap:
    """Return the rates at full stick of a flight controller that is configured by this module.

    They are the contract's largest, rounded up to the next 10 deg/s, which is Betaflight's resolution.

    Raises:
        ValueError: The contract has no body rates, or larger ones than Betaflight can follow.
    """
    return RateMap(**{axis: steps * _STEP for axis, steps in _rate_steps(contract).items()})


def wanted_settings(contract: dict[str, Any], link: str) -> list[Setting]:
    """Return all settings that an actor of a contract needs for one of the `LINKS`, in the order in which to type them.

    Raises:
        ValueError: There is no such link; or as `rate_map`.
    """
    switches = _ARMED_BY_PILOT if link == "msp_override" else _ARMED_BY_LINK
    return [*_receiver(link), *switches, *_MASTER, *_PROFILE, *_rates(contract)]


def print_settings(contract: dict[str, Any], link: str) -> list[str]:
    """Return lines for the CLI, in plain ASCII: other characters, tabs and question marks have a meaning there."""
    asked = ", ".join(f"{rate:.6g}" for rate in _asked_rates(contract).values())
    rates = rate_map(contract)
    full = [f"{axis}={getattr(rates, axis):.6g}" for axis in AXES]
    lines = [
        f"# Betaflight 4.5 and later, link {link}. First select the profile and rateprofile to fly with.",
        f"# The actor asks for up to {asked} rad/s about x, y, z. Full stick is this, rounded up to the next 10 deg/s:",
        f"# the link's RateMap must be {', '.join(full)} rad/s, not the actor's rates.",
    ]
    for wanted in wanted_settings(contract, link):
        former = f" Before 2025.12: set {wanted.former} = {wanted.value}" if wanted.former else ""
        lines += [f"# {wanted.reason}.{former}", wanted.command]
    return [*lines, "save"]


def check_dump(text: str, contract: dict[str, Any], link: str) -> list[Finding]:
    """Compare the output of ``dump all`` or ``diff all`` with the required settings.

    Raises:
        ValueError: The text is neither; or as `wanted_settings`.
    """
    wanted_all = wanted_settings(contract, link)
    values, version = _read_dump(text, {name: each.section for each in wanted_all for name in (each.name, each.former)})
    is_diff = re.search(r"^(defaults nosave|#\s*diff\b.*)\s*$", text, re.MULTILINE) is not None
    silence_is_default = is_diff and version is not None and version >= _DEFAULTS_SINCE
    findings = []
    for wanted in wanted_all:
        found = values.get(wanted.name, values.get(wanted.former, wanted.default if silence_is_default else None))
        same = wanted.absent and not is_diff if found is None else found.upper() == wanted.value.upper()
        status = Status.OK if same else Status.MISSING if found is None else Status.DIFFERS
        findings.append(Finding(wanted, status, found))
    return findings


def require_dump(path: Path, contract: dict[str, Any], link: str) -> int:
    """Refuse a flight controller whose dump, as in `check_dump`, does not fit an actor; return how many were compared.

    Raises:
        ValueError: Settings differ or are missing, and the message has a line for each; or as `check_dump`.
        OSError: There is no such file.
    """
    findings = check_dump(path.read_text(encoding="utf-8", errors="replace"), contract, link)
    if wrong := [str(finding) for finding in findings if finding.status is not Status.OK]:
        raise ValueError(
            f"betaflight_dump={path}: {len(wrong)} of {len(findings)} settings of the flight controller are not as "
            "this actor needs them:\n" + "\n".join(wrong)
        )
    return len(findings)


def gains_unlike_training(path: Path, contract: dict[str, Any]) -> list[str]:
    """Return a note on each P gain of a dump outside the range of training; none if the contract has no gains.

    They are not in `wanted_settings`: a real drone, whose rotors have inertia, may need others to turn the same way.
    """
    trained = contract.get("rate_loop") or {}
    if trained.get("kind") != "betaflight":
        return []
    names = [f"p_{axis}" for axis in AXES]
    values, _ = _read_dump(path.read_text(encoding="utf-8", errors="replace"), dict.fromkeys(names, "profile"))
    width = trained.get("trained_half_widths", {}).get("gains", 0.0)
    return [
        f"{name} is {values.get(name, 'not in the text')}, and the actor was trained with {known:g} ± {width:.0%}: "
        "measure how the drone turns, see docs/betaflight.md"
        for name, known in zip(names, trained["p"], strict=True)
        if name not in values or abs(float(values[name]) - known) > width * known
    ]


def _read_dump(text: str, sections: dict[str, str]) -> tuple[dict[str, str], tuple[int, int] | None]:
    """Return values by name, of the profiles selected at the end, and the firmware's release if stated."""
    version = re.search(r"^#\s*(\w+) ?/.* (\d+)\.(\d+)\.\d+", text, re.MULTILINE)
    settings = re.findall(r"^set \w+ = ", text, re.MULTILINE)
    if version is None and not settings:
        raise ValueError(_NO_DUMP.format("it has no lines of the Betaflight CLI"))
    if version is not None and version[1] != "Betaflight":
        raise ValueError(_NO_DUMP.format(f"it is from {version[1]}"))
    selected = {"": "", "profile": "0", "rateprofile": "0"}
    values: dict[tuple[str, str], str] = {}
    modes: dict[str, list[str]] = {}
    for line in text.splitlines():
        match line.split("#")[0].split():
            case ["profile" | "rateprofile" as section, number]:
                selected[section] = number
            case ["set", name, "=", *value]:
                values[name, selected[sections.get(name, "")]] = " ".join(value)
            case ["feature", name]:
                values[f"feature {name.removeprefix('-')}", ""] = "OFF" if name.startswith("-") else "ON"
            case ["rxfail", channel, *mode]:
                values[f"rxfail {channel}", ""] = " ".join(mode)
            case ["map", order]:
                values["map", ""] = order
            case ["aux", slot, *mode]:
                modes[slot] = mode
    values |= {(name, ""): value for name, value in _read_modes(list(modes.values())).items()}
    chosen = {name: value for (name, profile), value in values.items() if profile == selected[sections.get(name, "")]}
    return chosen, None if version is None else (int(version[2]), int(version[3]))


def _read_modes(modes: list[list[str]]) -> dict[str, str]:
    """Return the arm and override switches, and whether levelling is on with AUX1 at 2000 µs, others at 1000 µs.

    Each mode is given as its number (`hil.betaflight.status`), index of the switch, from and to in µs, and more.
    """
    ranges = [tuple(map(int, mode[:4])) for mode in modes if len(mode) >= 4 and all(map(str.isdigit, mode[:4]))]
    arms = [f"AUX{switch + 1} {low}-{high}" for mode, switch, low, high in ranges if mode == ARM and low < high]
    levels = [
        low <= (1000 if switch else 2000) < high for mode, switch, low, high in ranges if mode in (ANGLE, HORIZON)
    ]
    arming, overriding = (
        {switch for mode, switch, low, high in ranges if mode == wanted and low < high}
        for wanted in (ARM, MSP_OVERRIDE)
    )
    return {
        "ARM": ", ".join(arms) or "none",
        "levelling": "ON" if any(levels) else "OFF",
        "ARM by a switch": "ON" if arming else "OFF",
        "MSP OVERRIDE by another": "ON" if overriding - arming else "OFF",
    }


def _receiver(link: str) -> list[Setting]:
    """Return the settings by which the flight controller listens to a link."""
    check_choice("link", link, LINKS)
    if link == "betaflight_sitl":
        return [_MSP_RATE, *_SIMULATED]  # channels come over UDP, whichever receiver is set: see docs/hil_firmware.md
    if link == "msp_override":
        return [*_OVERRIDE, _MSP_RATE]
    serial = link != "msp"
    alone = "" if serial else "; no pilot can take over, so only for the bench or a cage"
    # a firmware built without one of these features has it off
    rx_serial = Setting(
        "feature RX_SERIAL",
        "ON" if serial else "OFF",
        "for a receiver at a UART: see the Ports tab",
        "ON",
        absent=not serial,
    )
    rx_msp = Setting(
        "feature RX_MSP", "OFF" if serial else "ON", f"makes MSP the only receiver{alone}", "OFF", absent=serial
    )
    if not serial:
        return [rx_serial, rx_msp, _MSP_RATE]
    # The one that is off comes first: the firmware keeps one receiver, not always the last set.
    return [rx_msp, rx_serial, Setting("serialrx_provider", link.upper(), "the protocol of the link")]


def _rates(contract: dict[str, Any]) -> list[Setting]:
    """Return the settings that make body rates linear in the sticks, and leave the throttle unchanged."""
    wanted = [("rates_type", "ACTUAL", "rates in units of 10 deg/s", "ACTUAL")]
    for axis, steps in _rate_steps(contract).items():
        full = f"full {axis} stick is {10 * steps} deg/s"
        wanted += [
            (f"{axis}_rc_rate", str(steps), f"{full}: the slope at the centre", "7"),
            (f"{axis}_srate", str(steps), f"{full}: the same slope everywhere, so it is linear", "67"),
            (f"{axis}_expo", "0", "no curve", "0"),
            (f"{axis}_rate_limit", "1998", "the largest value, so it clips nothing", "1998"),
        ]
    wanted += [
        ("thr_mid", "50", "with thr_expo: a linear throttle", "50"),
        ("thr_expo", "0", "no curve", "0"),
        ("throttle_limit_type", "OFF", "full throttle must be full thrust", "OFF"),
    ]
    return [Setting(*each, section="rateprofile") for each in wanted]


def _rate_steps(contract: dict[str, Any]) -> dict[str, int]:
    """Return the rates at full stick, in units of 10 deg/s, by axis."""
    steps = {axis: math.ceil(rate / _STEP - 1e-6) for axis, rate in _asked_rates(contract).items()}
    for axis, step in steps.items():
        if not 1 <= step <= _LARGEST:
            raise ValueError(
                f"action.channels: {AXES[axis]} of {step * _STEP:.4g} rad/s needs {axis} rates of {10 * step} deg/s; "
                f"Betaflight allows 10 to {10 * _LARGEST}."
            )
    return steps


def _asked_rates(contract: dict[str, Any]) -> dict[str, float]:
    """Return the largest body rates that an actor asks for, rad/s, by axis."""
    channels = {channel["name"]: channel for channel in contract["action"]["channels"]}
    for name in AXES.values():
        if name not in channels or channels[name]["unit"] != "rad/s":
            raise ValueError(f"action.channels has no {name} in rad/s: this actor does not command body rates.")
    return {axis: abs(channels[name]["offset"]) + abs(channels[name]["scale"]) for axis, name in AXES.items()}


_MSP_RATE = Setting(
    "serial_update_rate_hz",
    "500",
    "the firmware reads one MSP message per update: at 100 Hz commands and requests queue up",
    "100",
)
_OVERRIDE = (
    Setting("feature RX_MSP", "OFF", "the pilot's receiver stays: MSP must not be the receiver", "OFF", absent=True),
    Setting("msp_override_channels_mask", "15", "MSP sets roll, pitch, yaw and throttle, and nothing else", "0"),
    Setting(
        "msp_override_failsafe", "OFF", "a lost receiver must cause a failsafe, whatever MSP sends", "OFF", absent=True
    ),
)
_ARMED_BY_PILOT = (
    Setting("ARM by a switch", "ON", "the pilot arms and disarms, by any switch of the receiver",
            line=f"aux 0 {ARM} 0 1700 2100 0 0"),
    Setting("MSP OVERRIDE by another", "ON", "the pilot hands over and takes back control; ANGLE must be off meanwhile",
            line=f"aux 1 {MSP_OVERRIDE} 1 1700 2100 0 0"),
)  # fmt: skip
_ARMED_BY_LINK = (
    Setting("ARM", "AUX1 1700-2100", "AUX1 arms, at 2000 us; nothing else may arm",
            line=f"aux 0 {ARM} 0 1700 2100 0 0"),
    Setting("levelling", "OFF", "in the Modes tab, by hand: sticks mean rates with AUX1 at 2000 us, the others at 1000",
            line="# ANGLE and HORIZON off"),
)  # fmt: skip
_MASTER = (
    Setting("map", "AETR1234", "roll, pitch, throttle, yaw: the order of the link's channels", "AETR1234",
           line="map AETR1234"),
    Setting("mid_rc", "1500", "the sticks' centre", "1500"),
    Setting("deadband", "0", "small rates must have an effect", "0"),
    Setting("yaw_deadband", "0", "small rates must have an effect", "0"),
    Setting("yaw_control_reversed", "OFF", "the link already sets the sign of yaw", "OFF"),
    Setting("min_check", f"{ThrustMap.min_check:.0f}", "the throttle begins here, as in the link's ThrustMap", "1050"),
    Setting("motor_idle", f"{1e4 * ThrustMap.idle:.0f}", f"{ThrustMap.idle:.1%}, as in the link's ThrustMap", "550",
            former="dshot_idle_value"),
    Setting("feature AIRMODE", "ON", "rates must be controlled at the lowest throttle, too", "ON"),
    Setting("failsafe_delay", "5", "motors stop 0.5 s after the last message: the last line of defence", "15"),
    Setting("failsafe_procedure", "DROP", "in a room, a drone must fall rather than fly on", "DROP"),
    *(
        Setting(f"rxfail {channel}", "a", f"{stick} when the radio link is lost: sticks centred, throttle low", "a",
                line=f"rxfail {channel} a")
        for channel, stick in enumerate(("roll", "pitch", "yaw", "throttle"))
    ),
    Setting("rc_smoothing", "OFF", "rates must act at once; this filter delays them, more if commands are rare", "ON"),
    Setting("yaw_spin_recovery", "OFF", "the firmware must not take over in flight: the loop cuts a tumbling drone",
            "AUTO"),
)  # fmt: skip
_SIMULATED = tuple(
    Setting(name, value, "the plant's rotors have no spin-up torque: the default would oscillate", default, "profile")
    for name, value, default in (("p_yaw", "30", "45"), ("i_yaw", "5", "80"))
)
_PROFILE = (
    *(
        Setting(f"f_{axis}", "0", "no feedforward: each command is a step, which it would amplify", default, "profile")
        for axis, default in (("roll", "120"), ("pitch", "125"), ("yaw", "120"))
    ),
    Setting("dyn_idle_min_rpm", "0", "idle is a fraction of the command, not a speed", "0", "profile", absent=True),
    Setting("thrust_linear", "0", "the link's ThrustMap does this", "0", "profile"),
    Setting("throttle_boost", "0", "throttle must mean thrust, even when it changes fast", "5", "profile"),
    Setting("vbat_sag_compensation", "0", "the link's ThrustMap corrects for the battery voltage", "0", "profile"),
    Setting("motor_output_limit", "100", "full throttle must be full thrust", "100", "profile"),
)
