r"""Fly a vehicle, real or simulated in a process of its own: poses in, images drawn from them, commands out.

    python recipes/plant.py track=circle preset=easy                      # in one terminal: a vehicle
    python recipes/hil.py actor=circle arm=true laps=3                    # in another: an agent flies it
    python recipes/hil.py actor=pilot track=circle arm=true laps=3        # or the scripted pilot
    python recipes/hil.py actor=kidney arm=true link=crsf device=/dev/ttyUSB0 operator=keyboard \
        mass=0.62 full_thrust=17 reference_voltage=15.2 voltage=15.8      # or a real vehicle, by a radio's receiver
    python recipes/hil.py replay=runs/hil_kidney_20260101-120000          # the same again, from its file
    python recipes/hil.py report=runs/hil_kidney_20260101-120000

Read docs/hil.md before anything with propellers. Nothing here needs torch, but for actor=pilot and report=.
"""

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast, get_type_hints

from composing.command_line import agent_path, new_run_dir, plain_errors, start_logging
from composing.entry import recipe
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.tracks import Track, describe_track, load_track
from dreamer_racing.hil.battery import STALE, BatteryConfig
from dreamer_racing.hil.betaflight import rate_map
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.chain import ChainConfig, FlightChain, Outputs, describe_outputs, read_inputs
from dreamer_racing.hil.flyer import ActorFlyer, Flyer, check_contract
from dreamer_racing.hil.links import HEARING, LinkConfig, make_link
from dreamer_racing.hil.links.link import TransportLink
from dreamer_racing.hil.loop import FlightLoop
from dreamer_racing.hil.operator import KeyboardOperator, OperatorSource, TimedOperator, UdpOperator
from dreamer_racing.hil.pose import PoseSource
from dreamer_racing.hil.pose_sources import PoseConfig, make_poses
from dreamer_racing.hil.recording import FILE, TRACK, Flight, FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.hil.view import LiveView
from dreamer_racing.settings import POSITIVE, Range, check_settings, setting

PILOT = "pilot"
PILOT_RATE = 50.0  # Hz
SIMULATED = ("simulated", "betaflight_sitl")  # links with nobody to hurt
STATISTICS = "statistics.json"


LimitsConfig = make_dataclass(
    "LimitsConfig",
    [
        (name, float | None if kind in (float, int) else list[float] | None, field(default=None))
        for name, kind in get_type_hints(SafetyLimits).items()
    ],
)
"""`SafetyLimits` by their names; null: the default, or what the track says."""


@dataclass
class HilConfig:
    """`recipes/hil.py`."""

    actor: str | None = None  # pilot, an agent that ships by its name, or the path of an .onnx file or an agent
    track: str | None = None  # built-in track, or path to a YAML file; null: what the actor was trained on
    arm: bool = False  # whether the vehicle may be armed at all
    laps: int | None = setting(None, Range(1))  # after which it is DISARMED in the air; null: when the operator says so
    duration: float | None = setting(None, POSITIVE)  # s after arming, at which it is disarmed; null: no end
    patience: float | None = setting(None, POSITIVE)  # s to wait for arming; null: as long as it takes
    rate: float | None = setting(None, Range(10, 500))  # Hz; null: the actor's own, which is the only one it can have
    preset: str = "faithful"  # actor=pilot: what it takes the vehicle for, easy | faithful
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
    operator_port: int = setting(9102, Range(1, 65535))

    link: str = "simulated"  # simulated | udp | betaflight_sitl | crsf | sbus | msp | mavlink
    link_host: str = "127.0.0.1"  # to send to
    link_port: int | None = setting(None, Range(1, 65535))  # null: 9101, or the firmware's own
    device: str | None = None  # serial port
    baud: int | None = setting(None, Range(1))  # null: the protocol's own
    arm_channel: int = 4  # index of the channel that arms: 4 is AUX1
    mass: float | None = setting(None, POSITIVE)  # kg, with battery
    full_thrust: float | None = setting(None, POSITIVE)  # N, of all motors at full command and the reference voltage
    reference_voltage: float | None = setting(None, POSITIVE)  # V
    voltage: float | None = setting(None, POSITIVE)  # V, the battery's now; until a link that hears of it says more
    voltage_tolerance: float = setting(0.25, Range(0, 0.5))  # share of voltage= by which readings may differ from it
    voltage_smoothing: float = setting(0.5, Range(0, 60))  # s, time constant of the low-pass that readings go through

    limits: Any = field(default_factory=LimitsConfig)  # of safety: limits.speed_max=10; all of them: docs/hil.md
    renderer: str = "auto"  # auto | egl | osmesa
    record: bool = True  # write the flight to a file
    view: int | None = setting(None, Range(1, 65535))  # port of a page on this machine that shows what the actor sees


ConfigStore.instance().store(name="hil_schema", node=HilConfig)


@recipe("hil")
def main(config: DictConfig) -> None:
    """Fly, or look at a flight."""
    start_logging()
    with plainly():
        settings = cast(HilConfig, OmegaConf.to_object(config))
        check(settings)
        if settings.actor is None:
            raise SystemExit(replay(settings) if settings.replay else report(settings))
    raise SystemExit(fly(settings))


@contextmanager
def plainly() -> Iterator[None]:
    """Say errors that a person can mend in a paragraph, a missing package among them."""
    with plain_errors():
        try:
            yield
        except ImportError as error:
            raise ValueError(str(error)) from error


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
    if config.operator not in ("auto", *OPERATORS):
        raise ValueError(f"operator={config.operator}: there are auto, {', '.join(OPERATORS)}.")
    if config.operator == "timed" and config.link not in SIMULATED:
        raise ValueError(
            f"operator=timed enables by itself, and link={config.link} may be a real vehicle: use keyboard."
        )
    by_itself = config.operator in ("auto", "timed") and config.link in SIMULATED
    if by_itself and not config.link_host.startswith("127."):
        raise ValueError(
            f"link_host={config.link_host} is another machine, where a real vehicle may be: operator=keyboard or udp."
        )
    if config.against and not config.report:
        raise ValueError(f"against={config.against} is for report=.")


OPERATORS = ("keyboard", "udp", "timed")


def fly(config: HilConfig) -> int:
    """Fly one flight; return the exit status: 0 if it was flown to its end."""
    with ExitStack() as opened:
        with plainly():
            flight = prepare(config, opened)
        ended = flight.loop.run(config.duration, config.patience)  # what breaks in flight is a defect: it shows as one
        with plainly():
            opened.close()
            summary = conclude(config, flight, ended)
    say(summary)
    return 0 if config.laps is None or len(summary["passes"]) >= config.laps * flight.track.num_gates else 1


class Prepared(NamedTuple):
    """A flight that can begin."""

    folder: Path
    track: Track
    chain: FlightChain
    poses: PoseSource
    link: TransportLink
    loop: FlightLoop


def prepare(config: HilConfig, opened: ExitStack) -> Prepared:
    """Make and open all that a flight needs; ``opened`` closes it.

    Raises:
        ValueError, OSError, ImportError: Something does not fit, cannot be used, or is not installed.
    """
    config.stamping = stamping_of(config)
    flyer, contract = make_flyer(config)
    track = load_track(config.track or contract["source"]["track"])
    chain = make_chain(config, flyer, track)
    opened.callback(chain.close)
    folder = Path(config.run_dir) if config.run_dir else new_run_dir("hil", track.name)
    link = opened.enter_context(closing(make_link(link_config(config, contract, flyer.rate))))
    poses = opened.enter_context(closing(make_poses(pose_config(config))))
    operator = opened.enter_context(closing(make_operator(config)))
    recorder = None
    if config.record:
        about = {"config": as_json(config), "track": track.name, "rate": flyer.rate, "contract": contract}
        recorder = opened.enter_context(FlightRecorder(folder / FILE, {**about, TRACK: describe_track(track)}))
    watchers: list[Callable[[Outputs], None]] = []
    if config.view is not None:
        view = opened.enter_context(closing(LiveView(config.view)))
        print(f"view: {view.address}")
        watchers.append(view.show)
    print(f"{config.actor} on {track.name} at {flyer.rate:g} Hz, link={config.link}, arm={config.arm}: {folder}")
    print(f"poses: {config.pose}, stamped by {config.stamping.value}")
    loop = FlightLoop(chain, poses, operator, link, flyer.rate, recorder, watchers)
    return Prepared(folder, track, chain, poses, link, loop)


def conclude(config: HilConfig, flight: Prepared, ended: str) -> dict[str, Any]:
    """Return what came of a flight, and write it beside its recording."""
    chain = flight.chain
    summary = {
        "ended": ended,
        "passes": [list(passed) for passed in chain.progress.passes],
        "laps": lap_times(chain),
        "loop": flight.loop.statistics.summary(),
        "poses": {"rejected": flight.poses.rejected, "out_of_order": chain.clock.out_of_order},
        "commands_dropped": flight.link.dropped,
        "battery": battery_summary(config, chain, flight.link),
    }
    if config.record:
        (flight.folder / STATISTICS).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def make_flyer(config: HilConfig, track: Track | None = None) -> tuple[Flyer, dict[str, Any]]:
    """Make who flies, and return its contract: of a pilot, what such an actor's would say of its commands.

    Args:
        config: Says who.
        track: That a pilot is to fly; None: the one of its name.
    """
    assert config.actor is not None, "checked"
    if config.actor == PILOT:
        from dreamer_racing.plant.pilot import PilotFlyer  # needs torch, which actors do without

        if config.track is None:
            raise ValueError("track= is missing: actor=pilot has none of its own.")
        rate = config.rate or PILOT_RATE
        return PilotFlyer(track or load_track(config.track), config.preset, rate), pilot_contract(config.track)
    path = agent_path(config.actor)
    flyer = ActorFlyer(path)
    check_contract(flyer.contract, config.track or flyer.contract["source"]["track"], config.rate)
    return flyer, flyer.contract


def pilot_contract(track: str) -> dict[str, Any]:
    """Return what an actor's contract would say of the pilot."""
    drone = QuadrotorParameters()
    channels = [
        {"name": f"body_rate_{axis}", "unit": "rad/s", "offset": 0.0, "scale": rate}
        for axis, rate in zip("xyz", drone.body_rate_max, strict=True)
    ]
    scale = drone.collective_thrust_scale
    thrust = {"name": "collective_thrust", "unit": "m/s^2", "offset": scale, "scale": scale}
    return {"source": {"track": track}, "action": {"channels": [thrust, *channels]}}


def make_chain(config: HilConfig, flyer: Flyer, track: Track) -> FlightChain:
    """Make the chain of a flyer."""
    given = {name: value for name, value in vars(config.limits).items() if value is not None}
    limits = SafetyLimits.of_track(track, **given)
    settings = ChainConfig(limits, stamping_of(config), config.latency, config.laps, config.arm, battery_config(config))
    camera = None if flyer.camera is None else NoseCamera(track, flyer.camera, config.renderer)
    return FlightChain(flyer, track, settings, camera)


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
    name = config.operator
    if name == "auto":
        name = "timed" if config.link in SIMULATED else "keyboard"
        print(f"operator: {name} (operator=auto, link={config.link})")
    if name == "udp":
        return UdpOperator(config.operator_port, config.operator_host)
    return TimedOperator() if name == "timed" else KeyboardOperator()


def battery_summary(config: HilConfig, chain: FlightChain, link: TransportLink) -> dict[str, Any] | None:
    """Return what the thrust map reckoned with at the end, and what was heard; None where there is no thrust map."""
    if link.thrust is None:
        return None
    summary = {"voltage_set": config.voltage, "voltage": link.thrust.voltage, "rejected": link.rejected}
    if (battery := chain.battery) is None:
        return {**summary, "readings": 0}
    age = battery.age if math.isfinite(battery.age) else None
    return {**summary, "readings": battery.readings, "implausible": battery.implausible, "last_reading_age_s": age}


def lap_times(chain: FlightChain) -> list[float]:
    """Return the times of whole laps from the first gate on, s."""
    firsts = [passed.time for passed in chain.progress.passes if passed.gate == 0]
    return [later - earlier for earlier, later in pairwise(firsts)]


def as_json(config: HilConfig) -> dict[str, Any]:
    """Return the configuration as JSON values."""
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True))


def say(summary: dict[str, Any]) -> None:
    """Print what came of a flight."""
    laps = ", ".join(f"{lap:.2f} s" for lap in summary["laps"]) or "none"
    print(f"ended: {summary['ended']}")
    print(f"gates passed: {len(summary['passes'])}, laps: {laps}")
    for name, row in summary["loop"].items():
        if isinstance(row, dict):
            print(f"{name:<9} p50 {row['p50_ms']:6.2f} ms   p99 {row['p99_ms']:6.2f} ms   max {row['max_ms']:6.2f} ms")
    print(f"ticks: {summary['loop']['ticks']}, overruns: {summary['loop']['overruns']}")
    if summary["battery"] is not None:
        print(in_words(summary["battery"]))


def in_words(battery: dict[str, Any]) -> str:
    """Say by which voltage thrust became a throttle, and where that came from."""
    if not battery["readings"]:
        return f"battery: nothing usable was heard of it; thrust was reckoned by voltage={battery['voltage_set']:g}"
    age = battery["last_reading_age_s"]
    old = f", the last one {age:.1f} s before the end: STALE" if age > STALE else ""
    left_out = f", {battery['implausible']} implausible ones left out" if battery["implausible"] else ""
    return f"battery: {battery['voltage']:.2f} V at the end, by {battery['readings']} readings{left_out}{old}"


def replay(config: HilConfig) -> int:
    """Play a flight through the chain again; return 0 if every tick comes out as it was written, 1 otherwise."""
    assert config.replay is not None, "checked"
    flight = Flight(Path(config.replay))
    flown = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(HilConfig), flight.about["config"]))
    settings = cast(HilConfig, flown)
    if not flight.holds_track:
        print("note: the recording does not hold its track: it is taken as it is now")
    track = flight.track()
    flyer, _ = make_flyer(settings, track)
    settings.renderer = config.renderer
    with closing(make_chain(settings, flyer, track)) as chain:
        return play(flight, chain)


def play(flight: Flight, chain: FlightChain) -> int:
    """Put every tick of a flight through a chain; return 0 if all come out as they were written, 1 otherwise."""
    chain.warm_up()
    for index, tick in enumerate(flight.ticks):
        again = json.loads(json.dumps(describe_outputs(chain.tick(read_inputs(tick["in"])))))
        if differing := [name for name, value in tick["out"].items() if not same(value, again.get(name))]:
            name = differing[0]
            print(f"tick {index}: {name} was {tick['out'][name]}, and is {again.get(name)} now", file=sys.stderr)
            return 1
    print(f"replayed: {len(flight.ticks)} ticks, every one as it was written{'' if flight.whole else ' (cut off)'}")
    return 0


def same(one: Any, other: Any) -> bool:
    """Whether two JSON values are equal, bit for bit, not-a-number included."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return one == other


def report(config: HilConfig) -> int:
    """Draw a flight and sum it up."""
    from dreamer_racing.figures.hil import write_report

    assert config.report is not None, "checked"
    for line in write_report(Path(config.report), None if config.against is None else Path(config.against)):
        print(line)
    return 0


if __name__ == "__main__":
    main()
