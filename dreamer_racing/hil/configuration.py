"""Configuration of `recipes/hil.py`: its options, their checks, and the construction of a flight's parts."""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.battery import BatteryConfig
from dreamer_racing.hil.betaflight import LINKS as BETAFLIGHT
from dreamer_racing.hil.betaflight import gains_unlike_training, rate_map, require_dump
from dreamer_racing.hil.chain import LIFT, ChainConfig, FlightChain
from dreamer_racing.hil.flyer import (
    Flyer,
    check_contract,
    check_flown_by_betaflight,
    check_ranges,
    check_rate_loop,
    thrust_note,
)
from dreamer_racing.hil.links import BATTERY_LINKS, LINKS, LinkConfig
from dreamer_racing.hil.links.sitl import MSP_PORT
from dreamer_racing.hil.operator import (
    PORT,
    KeyboardOperator,
    OperatorSource,
    TimedOperator,
    UdpOperator,
    is_remote_terminal,
)
from dreamer_racing.hil.pose import PoseSource
from dreamer_racing.hil.pose_sources import POSE_SOURCES, WITHOUT_VELOCITIES, make_poses
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.sticks import FIRST_SWITCH, ThrustMap
from dreamer_racing.settings import POSITIVE, Range, check_choice, check_settings, setting

logger = logging.getLogger(__name__)

PILOT, IDENTIFY = "pilot", "identify"
POLLED_IMU = ("msp", "msp_override", "betaflight_sitl")  # links whose samples answer the request of the tick before
PILOT_RATE = 50.0  # Hz
SIMULATED = ("simulated", "betaflight_sitl")  # links to simulated vehicles, which can hurt nobody
ARMING = tuple(link for link in BETAFLIGHT if link != "msp_override")  # links that arm by a channel
OPERATORS = ("keyboard", "udp", "timed")
THRUST_NUMBERS = ("mass", "full_thrust", "reference_voltage", "voltage")  # settings that make a `ThrustMap`
SPARE = 5.0  # s added to the flight of actor=identify for its take-off
UNLIMITED_RATE = 1e4  # rad/s: as good as no limit
IDENTIFICATION_STILL_TIME = 25.0  # s; its longest time on the spot, steps of yaw, is 17 s


LimitsConfig = make_dataclass(
    "LimitsConfig",
    [
        (name, float | None if kind in (float, int) else list[float] | None, field(default=None))
        for name, kind in get_type_hints(SafetyLimits).items()
    ],
    namespace={"__module__": __name__},  # so that it can be pickled
)
"""The fields of `SafetyLimits`; null: the default, or the track's value."""


@dataclass
class HilConfig:
    """Options of `recipes/hil.py`."""

    # who flies: pilot (scripted), identify (small steps, for recipes/identification.py), the name of an included agent,
    # or the path of an .onnx file or of an agent
    actor: str | None = None
    track: str | None = None  # built-in track, or path to a YAML file; null: the actor's training track
    arm: bool = False  # whether the vehicle may be armed at all
    laps: int | None = setting(None, Range(1))  # laps after which it is DISARMED in the air; null: the operator ends it
    duration: float | None = setting(None, POSITIVE)  # s after arming until it is disarmed; null: no end
    lift: float = LIFT  # take-off thrust in weights, 1.1 to 1.5, until it rises; 0: the actor takes off by itself
    patience: float | None = setting(None, POSITIVE)  # s to wait for arming; null: no limit
    rate: float | None = setting(None, Range(10, 500))  # Hz of the loop; null: the actor's own, the only one it accepts
    preset: str = "faithful"  # actor=pilot: vehicle model that it assumes, easy | faithful | betaflight
    run_dir: str | None = None  # output folder; null: runs/hil_<track>_<time>
    replay: str | None = None  # a recorded flight to replay through the chain
    report: str | None = None  # a recorded flight to plot and summarise
    against: str | None = None  # with report=: another flight, or an evaluation's trajectory (CSV), to plot beside it

    pose: str = "udp"  # source of poses: udp | mavlink | ros2
    pose_host: str = "127.0.0.1"  # address to listen on
    pose_port: int = setting(9100, Range(1, 65535))
    pose_device: str | None = None  # pose=mavlink: a serial port instead of UDP
    pose_baud: int | None = setting(None, Range(1))  # baud rate of pose_device; null: 57600
    pose_topic: str | None = None  # pose=ros2: the topic
    pose_message: str | None = None  # message type; null: ODOMETRY (mavlink), PoseStamped (ros2)
    smoothing: float = setting(0.01, Range(0, 1))  # s, time constant of velocities estimated from poses that lack them
    # a pose's time: receive (arrival minus latency) | sender (its timestamp); null: receive over UDP, else sender
    stamping: Stamping | None = None
    latency: float = setting(0.0, Range(0, 1))  # least time from a pose's measurement to its arrival, s

    operator: str = "auto"  # keyboard | udp | timed (automatic); auto: timed for a simulated link, else keyboard
    operator_host: str = "127.0.0.1"  # address to listen on
    operator_port: int = setting(PORT, Range(1, 65535))

    link: str = "simulated"  # simulated | udp | betaflight_sitl | crsf | sbus | msp | msp_override | mavlink
    link_host: str = "127.0.0.1"  # address to send to
    link_port: int | None = setting(None, Range(1, 65535))  # null: 9101, or the firmware's default
    serial_port: int = setting(MSP_PORT, Range(1, 65535))  # link=betaflight_sitl: TCP port of the firmware's MSP
    device: str | None = None  # serial port of the link
    baud: int | None = setting(None, Range(1))  # null: the protocol's default
    arm_channel: int = 4  # index of the channel that arms: 4 is AUX1
    # the vehicle, a preset or a file of recipes/identification.py: an actor trained with another rate loop is refused;
    # null: a link to a Betaflight arms no actor that was trained with a proportional rate loop
    vehicle: str | None = None
    force: bool = False  # fly even if the rate loop does not match
    betaflight_dump: str | None = None  # file with the output of `dump all`; refused if settings are not the actor's
    mass: float | None = setting(None, POSITIVE)  # kg, with battery
    full_thrust: float | None = setting(None, POSITIVE)  # N, of all motors at full command and the reference voltage
    reference_voltage: float | None = setting(None, POSITIVE)  # V, at which full_thrust was measured
    voltage: float | None = setting(None, POSITIVE)  # V, the battery's now, until the link reports it
    voltage_tolerance: float = setting(0.25, Range(0, 0.5))  # share of voltage= by which readings may differ from it
    voltage_smoothing: float = setting(0.5, Range(0, 60))  # s, time constant of the low-pass of readings

    limits: Any = field(default_factory=LimitsConfig)  # safety limits, as limits.speed_max=10; see docs/hil_safety.md
    renderer: str = "auto"  # auto | egl | osmesa
    record: bool = True  # write the flight to a file
    view: int | None = setting(None, Range(1, 65535))  # port of a page on this machine that shows what the actor sees


def check(config: HilConfig) -> None:
    """Refuse settings that contradict each other.

    Raises:
        ValueError: The message names the field and what is allowed.
    """
    check_settings(config)
    wanted = [name for name in ("actor", "replay", "report") if getattr(config, name) is not None]
    if len(wanted) != 1:
        raise ValueError(
            f"give one of actor=, replay= and report=, not {' and '.join(wanted) or 'none'}: actor=kidney flies an "
            "included agent, actor=pilot track=kidney the scripted pilot."
        )
    for name, there in (("link", LINKS), ("pose", POSE_SOURCES)):
        if (value := getattr(config, name)) is not None:
            check_choice(name, value, there)
    check_choice("operator", config.operator, ("auto", *OPERATORS))
    if config.operator == "timed" and config.link not in SIMULATED:
        raise ValueError(
            f"operator=timed gives the enable by itself, but link={config.link} may be a real vehicle: use keyboard."
        )
    by_itself = config.operator in ("auto", "timed") and config.link in SIMULATED
    if by_itself and not is_this_machine(config.link_host):
        raise ValueError(
            f"link_host={config.link_host} is another machine, maybe a real vehicle: use operator=keyboard or udp."
        )
    remote = operator_of(config) == "keyboard" and is_remote_terminal()
    if config.arm and remote and not (config.link in SIMULATED and is_this_machine(config.link_host)):
        raise ValueError(
            f"operator=keyboard over ssh: if the network drops, the enable stays on and no kill arrives, and link="
            f"{config.link} may be a real vehicle. Use operator=udp, whose enable expires, with python -m "
            "dreamer_racing.hil.operator at the other end, or use a terminal of this machine."
        )
    if config.against and not config.report:
        raise ValueError(f"against={config.against} is only used with report=.")
    check_read(config)


def check_read(config: HilConfig) -> None:
    """Refuse settings that the chosen mode, actor, link or pose source does not use, and say what they are for."""
    default = vars(HilConfig())
    given = {name: value for name, value in vars(config).items() if value != default[name]}
    if config.actor is None:
        mode, read = ("replay", "renderer") if config.replay is not None else ("report", "against")
        if unread := [name for name in given if name not in (mode, read)]:
            raise ValueError(f"{unread[0]}= is for new flights, and {mode}= reads a recorded one: leave it out.")
    throttle = config.link not in ("simulated", "udp")
    message = config.pose_message or {"ros2": "PoseStamped"}.get(config.pose)
    for names, is_read, reader in (
        (("preset",), config.actor == PILOT, "actor=pilot"),
        (("renderer",), config.actor not in (PILOT, IDENTIFY), "an actor with a camera"),
        (("rate",), config.actor != IDENTIFY, "an actor other than identify, which flies at a rate of its own"),
        (("force",), config.vehicle is not None or config.link in BETAFLIGHT, "vehicle=, or a link to a Betaflight"),
        (("vehicle",), config.actor not in (PILOT, IDENTIFY), "a trained actor"),
        (("baud",), config.device is not None, "device="),
        (("link_host", "link_port"), config.device is None, "a link over the network, without device="),
        (("serial_port",), config.link == "betaflight_sitl", "link=betaflight_sitl"),
        (("arm_channel",), config.link in ARMING, f"link={', '.join(ARMING)}"),
        (THRUST_NUMBERS, throttle, "a link that sends a throttle"),
        (("voltage_tolerance", "voltage_smoothing"), config.link in BATTERY_LINKS, f"link={', '.join(BATTERY_LINKS)}"),
        (("pose_host", "pose_port"), config.pose_device is None and config.pose != "ros2", "poses over the network"),
        (("pose_device",), config.pose == "mavlink", "pose=mavlink"),
        (("pose_baud",), config.pose_device is not None, "pose_device="),
        (("pose_topic",), config.pose == "ros2", "pose=ros2"),
        (("pose_message",), config.pose != "udp", "pose=mavlink or ros2"),
        (("smoothing",), message in WITHOUT_VELOCITIES, f"poses without velocities, {', '.join(WITHOUT_VELOCITIES)}"),
        (("operator_host", "operator_port"), config.operator == "udp", "operator=udp"),
    ):
        for name in names:
            if name in given and not is_read:
                raise ValueError(
                    f"{name}={given[name]} is for {reader}, which is not given: add that, or leave {name}= out."
                )


def operator_of(config: HilConfig) -> str:
    """Return the name of the operator's source, with ``auto`` resolved."""
    if config.operator != "auto":
        return config.operator
    return "timed" if config.link in SIMULATED else "keyboard"


def is_this_machine(host: str) -> bool:
    """Return whether a host is a loopback address or localhost; any other name may mean another machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_flight(config: HilConfig, contract: dict[str, Any], track: Track) -> list[str]:
    """Refuse to fly if actor, track, limits and flight controller do not match; called before arming.

    Returns:
        Notes for a person: what was not compared, and which mismatches the settings allow.

    Raises:
        ValueError: Something does not match; the message names it, with a line per setting of the flight controller.
        OSError: The dump's file does not exist.
    """
    loop: str | None = None
    if config.actor not in (PILOT, IDENTIFY):
        check_contract(contract, track, config.rate)
        if config.vehicle is not None:
            loop = check_rate_loop(contract, config.vehicle, config.force)
        elif config.arm and config.link in BETAFLIGHT:
            loop = check_flown_by_betaflight(contract, config.link, config.force)
        elif config.arm and config.link not in SIMULATED:
            loop = f"rate loop: not compared with that of the vehicle behind link={config.link}; for that give vehicle="
    notes = [] if loop is None else [loop]
    notes += check_ranges(contract, limits_of(config, track), given_limits(config))
    if config.actor not in (PILOT, IDENTIFY) and (thrust := thrust_map(vars(config))) is not None:
        notes += thrust_note(contract, thrust.collective_thrust_max)
    notes += imu_note(contract, config.link)
    if config.betaflight_dump is not None:
        if config.link not in BETAFLIGHT:
            raise ValueError(
                f"betaflight_dump={config.betaflight_dump} is for link={', '.join(BETAFLIGHT)}: leave it out."
            )
        if config.arm_channel != FIRST_SWITCH:
            raise ValueError(
                f"betaflight_dump= is only checked for arming by AUX1, arm_channel={FIRST_SWITCH}, not arm_channel="
                f"{config.arm_channel}: leave one out."
            )
        count = require_dump(Path(config.betaflight_dump), contract, config.link)
        notes.append(f"flight controller: {count} settings as required (betaflight_dump={config.betaflight_dump})")
        notes += gains_unlike_training(Path(config.betaflight_dump), contract)
    elif config.arm and config.link in BETAFLIGHT:
        notes.append("flight controller: its settings were not checked; for that give betaflight_dump= of a `dump all`")
    if config.link == "msp_override":
        notes.append(
            "link=msp_override: the pilot arms, hands over control, takes it back and disarms; a cut, or the end of "
            "the flight, only sets the throttle low: motors idle until the pilot disarms"
        )
    return notes


def imu_note(contract: dict[str, Any], link: str) -> list[str]:
    """Return a note if a link's IMU samples are of another age than those of training."""
    if (imu := contract.get("imu")) is None or link == "mavlink":  # its samples are up to a control step old
        return []
    trained, polled = imu["trained_errors"]["delay"], link in POLLED_IMU
    if trained == polled:
        return []
    age = "are about one control step old" if polled else "are fresh"
    return [f"imu: samples of link={link} {age}, and in training they were {trained} control steps old (env.imu=)"]


def given_limits(config: HilConfig) -> dict[str, Any]:
    """Return the safety limits that the user has set."""
    return {name: value for name, value in vars(config.limits).items() if value is not None}


def without_body_rates(config: Mapping[str, Any]) -> bool:
    """Return whether a configuration's poses carry no body rates, so that these are estimated from attitudes."""
    message, source = config.get("pose_message"), config.get("pose")
    return message in WITHOUT_VELOCITIES or (source == "ros2" and message is None)


def limits_of(config: HilConfig, track: Track) -> SafetyLimits:
    """Return the safety limits of a flight: the user's, else those of pose source and flyer, else the default.

    Body rates estimated from attitudes only lag behind them, and identification turns on the spot for a while.
    """
    tolerances = {"rate_tolerance": UNLIMITED_RATE} if without_body_rates(vars(config)) else {}
    hovers = {"still_time": IDENTIFICATION_STILL_TIME} if config.actor == IDENTIFY else {}
    return SafetyLimits.of_track(track, **tolerances | hovers | given_limits(config))


def pilot_contract(config: HilConfig) -> dict[str, Any]:
    """Return the contract that the pilot would have if it were an actor."""
    drone = QuadrotorParameters()
    channels = [
        {"name": f"body_rate_{axis}", "unit": "rad/s", "offset": 0.0, "scale": rate}
        for axis, rate in zip("xyz", drone.body_rate_max, strict=True)
    ]
    scale = drone.collective_thrust_scale
    thrust = {"name": "collective_thrust", "unit": "m/s^2", "offset": scale, "scale": scale}
    source = {"track": config.track, **({"preset": config.preset} if config.actor == PILOT else {})}
    return {"source": source, "action": {"channels": [thrust, *channels]}}


def make_chain(config: HilConfig, flyer: Flyer, track: Track) -> FlightChain:
    """Make the flight chain of a flyer."""
    limits = limits_of(config, track)
    settings = ChainConfig(
        limits, stamping_of(config), config.latency, config.laps, config.arm, battery_config(config), config.lift
    )
    return FlightChain(flyer, track, settings, config.renderer)


def stamping_of(config: HilConfig) -> Stamping:
    """Return how poses are stamped: by arrival only if the kernel stamps packets; others seem newer than they are."""
    if config.stamping is not None:
        return config.stamping
    kernel = config.pose == "udp" or (config.pose == "mavlink" and config.pose_device is None)
    return Stamping.receive if kernel else Stamping.sender


def thrust_map(config: Mapping[str, Any]) -> ThrustMap | None:
    """Return the map from throttle to thrust of a configuration; None if a number of it is not given."""
    numbers: dict[str, Any] = {name: config.get(name) for name in THRUST_NUMBERS}
    return None if None in numbers.values() else ThrustMap(**numbers)


def link_config(config: HilConfig, contract: dict[str, Any], rate: float) -> LinkConfig:
    """Return the link's settings, with the stick rates that `dreamer_racing.hil.betaflight` configures."""
    missing = [name for name in THRUST_NUMBERS if getattr(config, name) is None]
    if missing and config.link not in ("simulated", "udp"):
        raise ValueError(f"{missing[0]}= is missing: link={config.link} needs it to convert thrust to throttle.")
    thrust = thrust_map(vars(config))
    if thrust is not None:
        check_battery(config, thrust)
    port = 9101 if config.link_port is None and config.link in ("simulated", "udp") else config.link_port
    return LinkConfig(
        config.link,
        config.link_host,
        port,
        config.device,
        config.baud,
        rate_map(contract),
        thrust,
        config.arm_channel,
        rate,
        imu=contract.get("imu") is not None,
        serial_port=config.serial_port,
    )


def battery_config(config: HilConfig) -> BatteryConfig | None:
    """Return the battery's settings; None if the link reports no voltage, or none is given."""
    if config.link not in BATTERY_LINKS or config.voltage is None:
        return None
    return BatteryConfig(voltage=config.voltage, tolerance=config.voltage_tolerance, smoothing=config.voltage_smoothing)


def check_battery(config: HilConfig, thrust: ThrustMap) -> None:
    """Refuse a tolerance that accepts voltages beyond the thrust map's range, as nothing can be refused in flight."""
    battery = battery_config(config)
    for voltage in () if battery is None else battery.limits:
        try:
            replace(thrust, voltage=voltage)
        except ValueError as error:
            raise ValueError(
                f"voltage_tolerance={config.voltage_tolerance:g}: it would accept a reading of {voltage:.4g} V. {error}"
            ) from error


def make_pose_source(config: HilConfig) -> PoseSource:
    """Open the source of poses."""
    return make_poses(
        config.pose,
        host=config.pose_host,
        port=config.pose_port,
        device=config.pose_device,
        baud=config.pose_baud,
        topic=config.pose_topic,
        message=config.pose_message,
        smoothing=config.smoothing,
    )


def make_operator(config: HilConfig) -> OperatorSource:
    """Open the operator's source, and log which it is if ``operator=auto``."""
    name = operator_of(config)
    if config.operator == "auto":
        logger.info("operator: %s (operator=auto, link=%s)", name, config.link)
    if name == "udp":
        return UdpOperator(config.operator_port, config.operator_host)
    return TimedOperator() if name == "timed" else KeyboardOperator()
