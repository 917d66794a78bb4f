"""Flights from configuration: what `recipes/hil.py` can be told, what is refused, and the parts that a flight is of."""

from __future__ import annotations

import ipaddress
import logging
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.battery import BatteryConfig
from dreamer_racing.hil.betaflight import LINKS as BETAFLIGHT
from dreamer_racing.hil.betaflight import rate_map, require_dump
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.chain import LIFT, ChainConfig, FlightChain
from dreamer_racing.hil.flyer import (
    Flyer,
    check_contract,
    check_flown_by_betaflight,
    check_ranges,
    check_rate_loop,
)
from dreamer_racing.hil.links import HEARING, LINKS, LinkConfig
from dreamer_racing.hil.links.sitl import MSP_PORT
from dreamer_racing.hil.operator import (
    PORT,
    KeyboardOperator,
    OperatorSource,
    TimedOperator,
    UdpOperator,
    is_remote_terminal,
)
from dreamer_racing.hil.pose_sources import POSE_SOURCES, WITHOUT_VELOCITIES, PoseConfig
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.sticks import FIRST_SWITCH, ThrustMap
from dreamer_racing.settings import POSITIVE, Range, check_settings, setting

logger = logging.getLogger(__name__)

PILOT, IDENTIFY = "pilot", "identify"
PILOT_RATE = 50.0  # Hz
SIMULATED = ("simulated", "betaflight_sitl")  # links with nobody to hurt
ARMING = tuple(link for link in BETAFLIGHT if link != "msp_override")  # links that arm by a channel
OPERATORS = ("keyboard", "udp", "timed")
MADE_RATES = ("PoseStamped", "VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP")  # messages that have none
SPARE = 5.0  # s that the flight of actor=identify has beyond its steps, for its take-off
MOST = 1e4  # rad/s: as good as no limit


LimitsConfig = make_dataclass(
    "LimitsConfig",
    [
        (name, float | None if kind in (float, int) else list[float] | None, field(default=None))
        for name, kind in get_type_hints(SafetyLimits).items()
    ],
    namespace={"__module__": __name__},  # so that it can be pickled
)
"""`SafetyLimits` by their names; null: the default, or what the track says."""


@dataclass
class HilConfig:
    """`recipes/hil.py`."""

    # pilot, identify (small steps, for recipes/identification.py), an agent that ships by its name, or the path of an
    # .onnx file or an agent
    actor: str | None = None
    track: str | None = None  # built-in track, or path to a YAML file; null: what the actor was trained on
    arm: bool = False  # whether the vehicle may be armed at all
    laps: int | None = setting(None, Range(1))  # after which it is DISARMED in the air; null: when the operator says so
    duration: float | None = setting(None, POSITIVE)  # s after arming, at which it is disarmed; null: no end
    lift: float = LIFT  # weights of thrust, 1.1 to 1.5, that it is lifted with until it rises; 0: the actor takes off
    patience: float | None = setting(None, POSITIVE)  # s to wait for arming; null: as long as it takes
    rate: float | None = setting(None, Range(10, 500))  # Hz; null: the actor's own, which is the only one it can have
    preset: str = "faithful"  # actor=pilot: what it takes the vehicle for, easy | faithful | betaflight
    run_dir: str | None = None  # null: runs/hil_<track>_<time>
    replay: str | None = None  # a flight to play through the chain again
    report: str | None = None  # a flight to draw and to sum up
    against: str | None = None  # with report=: another flight, or an evaluation's trajectory (CSV), to draw beside it

    pose: str = "udp"  # udp | mavlink | ros2
    pose_host: str = "127.0.0.1"  # to listen on
    pose_port: int = setting(9100, Range(1, 65535))
    pose_device: str | None = None  # pose=mavlink: a serial port instead
    pose_baud: int | None = setting(None, Range(1))  # of it; null: 57600
    pose_topic: str | None = None  # pose=ros2
    pose_message: str | None = None  # which kind of message; null: ODOMETRY, or PoseStamped
    smoothing: float = setting(0.01, Range(0, 1))  # s, time constant of velocities where poses come without
    # a pose's time: receive (arrival less latency) | sender (its stamp); null: receive over UDP, else sender
    stamping: Stamping | None = None
    latency: float = setting(0.0, Range(0, 1))  # s from a pose's measurement to its arrival, at the least

    operator: str = "auto"  # keyboard | udp | timed (enables by itself); auto: timed where the link is simulated
    operator_host: str = "127.0.0.1"  # to listen on
    operator_port: int = setting(PORT, Range(1, 65535))

    link: str = "simulated"  # simulated | udp | betaflight_sitl | crsf | sbus | msp | msp_override | mavlink
    link_host: str = "127.0.0.1"  # to send to
    link_port: int | None = setting(None, Range(1, 65535))  # null: 9101, or the firmware's own
    serial_port: int = setting(MSP_PORT, Range(1, 65535))  # link=betaflight_sitl: TCP port of the firmware's MSP
    device: str | None = None  # serial port
    baud: int | None = setting(None, Range(1))  # null: the protocol's own
    arm_channel: int = 4  # index of the channel that arms: 4 is AUX1
    # what the vehicle is, a preset or the file of recipes/identification.py: an actor of another rate loop is refused;
    # null: a link to a Betaflight arms none that was trained with a proportional one
    vehicle: str | None = None
    force: bool = False  # fly all the same what is refused for its rate loop
    betaflight_dump: str | None = None  # what `dump all` gave; settings that are not the actor's: nothing is armed
    mass: float | None = setting(None, POSITIVE)  # kg, with battery
    full_thrust: float | None = setting(None, POSITIVE)  # N, of all motors at full command and the reference voltage
    reference_voltage: float | None = setting(None, POSITIVE)  # V
    voltage: float | None = setting(None, POSITIVE)  # V, the battery's now; until a link that hears of it says more
    voltage_tolerance: float = setting(0.25, Range(0, 0.5))  # share of voltage= by which readings may differ from it
    voltage_smoothing: float = setting(0.5, Range(0, 60))  # s, time constant of the low-pass that readings go through

    limits: Any = field(default_factory=LimitsConfig)  # of safety: limits.speed_max=10; all of them: docs/hil_safety.md
    renderer: str = "auto"  # auto | egl | osmesa
    record: bool = True  # write the flight to a file
    view: int | None = setting(None, Range(1, 65535))  # port of a page on this machine that shows what the actor sees


def check(config: HilConfig) -> None:
    """Refuse what does not go together.

    Raises:
        ValueError: the message names the field and what is allowed.
    """
    check_settings(config)
    wanted = [name for name in ("actor", "replay", "report") if getattr(config, name) is not None]
    if len(wanted) != 1:
        raise ValueError(
            f"give one of actor=, replay= and report=, not {' and '.join(wanted) or 'none'}: actor=kidney flies the "
            "agent that ships, actor=pilot track=kidney the scripted pilot."
        )
    for name, there in (("link", LINKS), ("pose", POSE_SOURCES)):
        if (value := getattr(config, name)) is not None and value not in there:
            raise ValueError(f"{name}={value}: there are {', '.join(there)}.")
    if config.operator not in ("auto", *OPERATORS):
        raise ValueError(f"operator={config.operator}: there are auto, {', '.join(OPERATORS)}.")
    if config.operator == "timed" and config.link not in SIMULATED:
        raise ValueError(
            f"operator=timed enables by itself, and link={config.link} may be a real vehicle: use keyboard."
        )
    by_itself = config.operator in ("auto", "timed") and config.link in SIMULATED
    if by_itself and not is_this_machine(config.link_host):
        raise ValueError(
            f"link_host={config.link_host} is another machine, where a real vehicle may be: operator=keyboard or udp."
        )
    remote = operator_of(config) == "keyboard" and is_remote_terminal()
    if config.arm and remote and config.link not in SIMULATED:
        raise ValueError(
            f"operator=keyboard over ssh: where the network drops, the enable stays and no kill arrives, and link="
            f"{config.link} may be a real vehicle. Use operator=udp, which lapses, with python -m "
            "dreamer_racing.hil.operator at the other end, or a terminal of this machine."
        )
    if config.against and not config.report:
        raise ValueError(f"against={config.against} is for report=.")
    check_read(config)


def check_read(config: HilConfig) -> None:
    """Refuse settings that nothing would read, as another link or source of poses is chosen.

    Raises:
        ValueError: the message names the setting and what it is for.
    """
    default = vars(HilConfig())
    given = {name: value for name, value in vars(config).items() if value != default[name]}
    if config.actor is None:
        mode, read = ("replay", "renderer") if config.replay is not None else ("report", "against")
        if unread := [name for name in given if name not in (mode, read)]:
            raise ValueError(f"{unread[0]}= is for flights, and {mode}= is of one that was flown: leave it out.")
    throttle = config.link not in ("simulated", "udp")
    message = config.pose_message or {"ros2": "PoseStamped"}.get(config.pose)
    for names, is_read, reader in (
        (("preset",), config.actor == PILOT, "actor=pilot"),
        (("renderer",), config.actor not in (PILOT, IDENTIFY), "an actor that sees"),
        (("force",), config.vehicle is not None or config.link in BETAFLIGHT, "vehicle=, or a link to a Betaflight"),
        (("vehicle",), config.actor not in (PILOT, IDENTIFY), "an actor that was trained"),
        (("baud",), config.device is not None, "device="),
        (("link_host", "link_port"), config.device is None, "a link over the network, without device="),
        (("serial_port",), config.link == "betaflight_sitl", "link=betaflight_sitl"),
        (("arm_channel",), config.link in ARMING, f"link={', '.join(ARMING)}"),
        (("mass", "full_thrust", "reference_voltage", "voltage"), throttle, "a link that takes a throttle"),
        (("voltage_tolerance", "voltage_smoothing"), config.link in HEARING, f"link={', '.join(HEARING)}"),
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
    """Return who answers for the flight, also where that is left open."""
    if config.operator != "auto":
        return config.operator
    return "timed" if config.link in SIMULATED else "keyboard"


def is_this_machine(host: str) -> bool:
    """Whether an address is one of the loopback; of names only localhost is: others may mean any machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_flight(config: HilConfig, contract: dict[str, Any], track: Track) -> list[str]:
    """Refuse to fly where actor, track, limits and flight controller are not of one kind; arming comes after this.

    Returns:
        What was not compared, or is as a person wants it, in words.

    Raises:
        ValueError: The message names what differs, line by line where settings of the flight controller do.
        OSError: There is no such dump.
    """
    found: list[str | None] = []
    if config.actor not in (PILOT, IDENTIFY):
        found.append(check_contract(contract, track, config.rate))
        if config.vehicle is not None:
            found.append(check_rate_loop(contract, config.vehicle, config.force))
        elif config.arm and config.link in BETAFLIGHT:
            found.append(check_flown_by_betaflight(contract, config.link, config.force))
    notes = [note for note in found if note is not None]
    notes += check_ranges(contract, limits_of(config, track), given_limits(config))
    if config.betaflight_dump is not None:
        if config.link not in BETAFLIGHT:
            raise ValueError(
                f"betaflight_dump={config.betaflight_dump} is for link={', '.join(BETAFLIGHT)}: leave it out."
            )
        if config.arm_channel != FIRST_SWITCH:
            raise ValueError(
                f"betaflight_dump= is compared with arming by AUX1, arm_channel={FIRST_SWITCH}, and arm_channel="
                f"{config.arm_channel}: leave one out."
            )
        count = require_dump(Path(config.betaflight_dump), contract, config.link)
        notes.append(f"flight controller: {count} settings as wanted (betaflight_dump={config.betaflight_dump})")
    elif config.arm and config.link in BETAFLIGHT:
        notes.append("flight controller: its settings were not compared; betaflight_dump= of a `dump all` does that")
    if config.link == "msp_override":
        notes.append(
            "link=msp_override: the pilot arms, hands over, takes back and disarms; a cut, or the end of the flight, "
            "is throttle low: motors idle until the pilot disarms"
        )
    return notes


def given_limits(config: HilConfig) -> dict[str, Any]:
    """Return the limits of safety that were set."""
    return {name: value for name, value in vars(config.limits).items() if value is not None}


def limits_of(config: HilConfig, track: Track) -> SafetyLimits:
    """Return the limits of safety."""
    return SafetyLimits.of_track(track, **tolerances_of(config) | given_limits(config))


def pilot_contract(config: HilConfig) -> dict[str, Any]:
    """Return what an actor's contract would say of the pilot."""
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
    """Make the chain of a flyer."""
    limits = limits_of(config, track)
    settings = ChainConfig(
        limits, stamping_of(config), config.latency, config.laps, config.arm, battery_config(config), config.lift
    )
    camera = None if flyer.camera is None else NoseCamera(track, flyer.camera, config.renderer)
    return FlightChain(flyer, track, settings, camera)


def tolerances_of(config: HilConfig) -> dict[str, float]:
    """Return limits of safety that follow from where poses come from, and from who flies, unless they are given.

    Body rates that are made from attitudes cannot contradict them, but lag behind. Who hovers is not stranded.
    """
    made = config.pose_message in MADE_RATES or (config.pose == "ros2" and config.pose_message is None)
    hovers = {"still_time": 3600.0} if config.actor == IDENTIFY else {}
    return {**({"rate_tolerance": MOST} if made else {}), **hovers}


def stamping_of(config: HilConfig) -> Stamping:
    """Return how poses are stamped: what is read when the loop comes to it looks younger than it is."""
    if config.stamping is not None:
        return config.stamping
    kernel = config.pose == "udp" or (config.pose == "mavlink" and config.pose_device is None)
    return Stamping.receive if kernel else Stamping.sender


def link_config(config: HilConfig, contract: dict[str, Any], rate: float) -> LinkConfig:
    """Return what the link needs: sticks as `dreamer_racing.hil.betaflight` has the flight controller set."""
    numbers = {name: getattr(config, name) for name in ("mass", "full_thrust", "reference_voltage", "voltage")}
    missing = [name for name, number in numbers.items() if number is None]
    if missing and config.link not in ("simulated", "udp"):
        raise ValueError(f"{missing[0]}= is missing: link={config.link} turns thrust into a throttle by it.")
    thrust = None if missing else ThrustMap(**numbers)
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
    """Return what is known of the battery; None where nothing more comes to be known."""
    if config.link not in HEARING or config.voltage is None:
        return None
    return BatteryConfig(voltage=config.voltage, tolerance=config.voltage_tolerance, smoothing=config.voltage_smoothing)


def check_battery(config: HilConfig, thrust: ThrustMap) -> None:
    """Refuse to believe voltages that the thrust map cannot reckon with: in flight nothing may be refused.

    Raises:
        ValueError: The message names the setting and the voltage.
    """
    battery = battery_config(config)
    for voltage in () if battery is None else battery.limits:
        try:
            replace(thrust, voltage=voltage)
        except ValueError as error:
            raise ValueError(
                f"voltage_tolerance={config.voltage_tolerance:g}: with it {voltage:.4g} V would be believed. {error}"
            ) from error


def pose_config(config: HilConfig) -> PoseConfig:
    """Return where poses come from."""
    return PoseConfig(
        name=config.pose,
        host=config.pose_host,
        port=config.pose_port,
        device=config.pose_device,
        baud=config.pose_baud,
        topic=config.pose_topic,
        message=config.pose_message,
        smoothing=config.smoothing,
    )


def make_operator(config: HilConfig) -> OperatorSource:
    """Open where the operator's word comes from, and say which it is if that was left open."""
    name = operator_of(config)
    if config.operator == "auto":
        logger.info("operator: %s (operator=auto, link=%s)", name, config.link)
    if name == "udp":
        return UdpOperator(config.operator_port, config.operator_host)
    return TimedOperator() if name == "timed" else KeyboardOperator()
