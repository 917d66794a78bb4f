r"""Fly a vehicle, real or simulated in a process of its own: poses in, images drawn from them, commands out.

    python recipes/plant.py track=circle preset=easy                      # in one terminal: a vehicle
    python recipes/hil.py actor=circle arm=true laps=3                    # in another: an agent flies it
    python recipes/hil.py actor=pilot track=circle preset=easy arm=true laps=3   # or the scripted pilot
    python recipes/hil.py actor=identify track=circle arm=true     # or small steps, for recipes/identification.py
    python recipes/hil.py actor=circle_betaflight arm=true link=crsf device=/dev/ttyUSB0 operator=keyboard \
        mass=0.62 full_thrust=17 reference_voltage=15.2 voltage=15.8      # or a real vehicle, by a radio's receiver
    python recipes/hil.py replay=runs/hil_kidney_20260101-120000          # the same again, from its file
    python recipes/hil.py report=runs/hil_kidney_20260101-120000

Read docs/hil_safety.md before anything with propellers.
"""

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

from composing.entry import new_run_dir, plain_disk_errors, plain_errors, recipe
from composing.options import command
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dreamer_racing.envs.tracks import Track, describe_track, load_track
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.hil.chain import FlightChain, Outputs, first_difference
from dreamer_racing.hil.configuration import (
    IDENTIFY,
    PILOT,
    PILOT_RATE,
    SPARE,
    HilConfig,
    check,
    check_flight,
    link_config,
    make_chain,
    make_operator,
    make_pose_source,
    pilot_contract,
    stamping_of,
)
from dreamer_racing.hil.flyer import ActorFlyer, Flyer, trained_track
from dreamer_racing.hil.identify import IdentificationFlyer
from dreamer_racing.hil.links import make_link
from dreamer_racing.hil.links.link import TransportLink
from dreamer_racing.hil.loop import FlightLoop, summary_lines
from dreamer_racing.hil.pose import PoseSource
from dreamer_racing.hil.progress import flying_laps
from dreamer_racing.hil.recording import FILE, TRACK, Flight, FlightRecorder
from dreamer_racing.hil.view import LiveView
from dreamer_racing.settings import check_settings

STATISTICS = "statistics.json"
plain_hil_errors = partial(plain_errors, also=(ImportError,))
"""As `plain_errors`, also for links and pose sources whose optional packages are missing."""


@recipe("hil", HilConfig)
def main(config: HilConfig) -> None:
    """Fly, or replay or report a recorded flight."""
    with plain_hil_errors():
        check(config)
        if config.actor is None:
            raise SystemExit(replay(config) if config.replay else report(config))
    raise SystemExit(fly(config))


def make_flyer(config: HilConfig, track: Track | None = None) -> tuple[Flyer, dict[str, Any]]:
    """Make the flyer, a pilot for another track than the configuration's if given; return it with its contract."""
    assert config.actor is not None, "checked"
    if config.actor == PILOT:
        from dreamer_racing.plant.pilot import PilotFlyer

        if config.track is None:
            raise ValueError("track= is missing: actor=pilot has none of its own.")
        rate = config.rate or PILOT_RATE
        return PilotFlyer(track or load_track(config.track), config.preset, rate), pilot_contract(config)
    if config.actor == IDENTIFY:
        if config.track is None:
            raise ValueError("track= is missing: actor=identify needs its start and its bounds.")
        steps = IdentificationFlyer()
        config.duration = config.duration or steps.duration + SPARE
        return steps, pilot_contract(config)
    flyer = ActorFlyer(existing_agent_path("actor", config.actor))
    return flyer, flyer.contract


def fly(config: HilConfig) -> int:
    """Fly one flight; return the exit status: 0 if it flew, passed the gates of all laps=, and was not cut off."""
    with ExitStack() as opened:
        with plain_hil_errors():
            flight = prepare(config, opened)
        ended = flight.loop.run(config.duration, config.patience)  # errors in flight are defects: with traceback
        summary = conclude(config, flight, ended)
        try:  # before it is printed, which fails if the terminal was closed
            with plain_disk_errors():
                opened.close()
                if config.record:
                    text = json.dumps(summary, indent=2) + "\n"
                    (flight.folder / STATISTICS).write_text(text, encoding="utf-8")
        finally:
            print(*summary_lines(summary), sep="\n")
    wanted = 0 if config.laps is None else config.laps * flight.track.num_gates
    flown = flight.loop.flew and len(summary["passes"]) >= wanted
    return 0 if flown and not ended.startswith("cut") else 1


class Prepared(NamedTuple):
    """A flight that can begin."""

    folder: Path
    track: Track
    chain: FlightChain
    poses: PoseSource
    link: TransportLink
    loop: FlightLoop


def prepare(config: HilConfig, opened: ExitStack) -> Prepared:
    """Make and open all that a flight needs; ``opened`` closes it."""
    config.stamping = stamping_of(config)
    flyer, contract = make_flyer(config)
    track = load_track(config.track) if config.track else trained_track(contract)
    for note in check_flight(config, contract, track):
        print(f"note: {note}")
    chain = make_chain(config, flyer, track)
    opened.callback(chain.close)
    folder = Path(config.run_dir) if config.run_dir else new_run_dir("hil", track.name)
    link = opened.enter_context(closing(make_link(link_config(config, contract, flyer.rate))))
    poses = opened.enter_context(closing(make_pose_source(config)))
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
    lifted = f"straight up, with a thrust of up to {config.lift:g} times its weight until it rises, then by"
    print(f"take-off: {lifted if config.lift else 'by'} {config.actor}")
    if preset := contract["source"].get("preset"):
        print(f"drone: {config.actor} is made for preset={preset}: a simulated drone needs that, too")
    if config.pose == "udp":
        plant = f"{command('plant')} track={config.track or track.name}{f' preset={preset}' if preset else ''}"
        print(f"waiting for poses: if no vehicle sends any, start a simulated one in another terminal: {plant}")
    loop = FlightLoop(chain, poses, operator, link, flyer.rate, recorder, watchers)
    return Prepared(folder, track, chain, poses, link, loop)


def conclude(config: HilConfig, flight: Prepared, ended: str) -> dict[str, Any]:
    """Return the summary of a flight."""
    chain = flight.chain
    summary = {
        "ended": ended,
        "passes": [list(passed) for passed in chain.progress.passes],
        "laps": flying_laps(chain.progress.passes),
        "loop": flight.loop.statistics.summary(),
        "poses": {"rejected": flight.poses.rejected, "out_of_order": chain.clock.out_of_order},
        "commands_dropped": flight.link.dropped,
        "battery": None,
    }
    if (thrust := flight.link.thrust) is not None:
        battery = {"voltage_set": config.voltage, "voltage": thrust.voltage, "rejected": flight.link.rejected}
        summary["battery"] = battery | ({"readings": 0} if chain.battery is None else chain.battery.summary())
    return summary


def as_json(config: HilConfig) -> dict[str, Any]:
    """Return the configuration as JSON values."""
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True))


def replay(config: HilConfig) -> int:
    """Replay a recorded flight through the chain; return 0 if the outputs of all ticks are as recorded, else 1."""
    assert config.replay is not None, "checked"
    flight = Flight(Path(config.replay))
    try:
        flown = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(HilConfig), flight.about["config"]))
    except (KeyError, TypeError, OmegaConfBaseException) as error:
        raise ValueError(
            f"replay={config.replay} was flown with settings that this version does not know "
            f"({str(error).partition(chr(10))[0]}): replay it with the version named in its recording."
        ) from error
    settings, track = cast(HilConfig, flown), flight.track()
    check_settings(settings)
    flyer, _ = make_flyer(settings, track)
    settings.renderer = config.renderer
    with closing(make_chain(settings, flyer, track)) as chain:
        chain.warm_up()
        difference = first_difference(chain, flight.ticks)
    if difference:
        print(difference, file=sys.stderr)
        return 1
    print(f"replayed: {len(flight.ticks)} ticks, all equal to the recording{'' if flight.whole else ' (cut off)'}")
    return 0


def report(config: HilConfig) -> int:
    """Draw a recorded flight and print its summary."""
    from dreamer_racing.figures.hil import write_report

    assert config.report is not None, "checked"
    for line in write_report(Path(config.report), None if config.against is None else Path(config.against)):
        print(line)
    return 0


if __name__ == "__main__":
    main()
