"""Measure how much a real drone may differ from the simulated one: success and lap time over one change at a time.

    python recipes/sim_to_real.py actor=kidney preset=easy
    python recipes/sim_to_real.py actor=pilot track=figure8 flights=10 processes=2
    python recipes/sim_to_real.py actor=kidney preset=easy beside=pilot      # both, in one picture

Flies the whole chain of recipes/hil.py (images, actor, safety, packets) against the plant of recipes/plant.py, without
a clock: commands 0 to 100 ms late, mass and thrust 20 % off, noisy poses, few poses. Writes sim_to_real.json and .png.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from composing.entry import new_run_dir, plain_errors, recipe

from dreamer_racing.envs.drone.parameters import load_preset
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.figures.sim_to_real import plot_study
from dreamer_racing.hil.flyer import ActorFlyer, Flyer, check_contract, trained_track
from dreamer_racing.machine import available_cpus, provenance
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.study import SWEEPS, study
from dreamer_racing.settings import COUNT, Range, check_choice, setting
from dreamer_racing.terminal import say

PILOT = "pilot"
RESULT, RESULT_BESIDE = "sim_to_real.json", "sim_to_real_pilot.json"


@dataclass
class SimToRealConfig:
    """Configuration of `recipes/sim_to_real.py`."""

    actor: str = PILOT  # pilot, name of an included agent, or path of an agent
    track: str | None = None  # built-in track, or path to a YAML file; null: what the actor was trained on
    preset: str = "faithful"  # physics before anything is changed: easy | faithful | betaflight
    rate: float = setting(50.0, Range(10, 500))  # Hz, of the pilot; an actor has its own
    flights: int = setting(5, COUNT)  # per value, with different noise
    sweeps: list[str] | None = None  # parameters to change, one at a time; null: all
    processes: int | None = setting(None, COUNT)  # that fly in parallel; null: one per core
    # second study in the same picture: pilot, which flies it too, or sim_to_real.json of another one
    beside: str | None = None
    run_dir: str | None = None  # null: runs/sim_to_real_<track>_<time>


@recipe("sim_to_real", SimToRealConfig)
def main(config: SimToRealConfig) -> None:
    """Fly the study, print each flight, write the files."""
    with plain_errors():
        track, make_flyer = check(config)
        folder = Path(config.run_dir) if config.run_dir else new_run_dir("sim_to_real", track.name)
        folder.mkdir(parents=True, exist_ok=True)
        studies = [(config.actor, make_flyer)]
        others = []
        if config.beside == PILOT:
            studies.append((PILOT, partial(PilotFlyer, track, config.preset, config.rate)))
        elif config.beside:
            other = json.loads(Path(config.beside).read_text(encoding="utf-8"))
            if not isinstance(other, dict) or not other.keys() >= {"flights", "provenance"}:
                raise ValueError(f"beside={config.beside} is no {RESULT} of another study.")
            others.append(other)
    results = [fly(actor, make, track, config) for actor, make in studies]
    for result, name in zip(results, (RESULT, RESULT_BESIDE), strict=False):
        (folder / name).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    plot_study([*results, *others], folder / RESULT.replace("json", "png"))
    print(f"written to {folder}")


def fly(actor: str, make_flyer: Callable[[], Flyer], track: Track, config: SimToRealConfig) -> dict[str, Any]:
    """Fly every value of every sweep, print each result, and return all results with their provenance."""
    flown = []
    sweeps, processes = config.sweeps or list(SWEEPS), config.processes or available_cpus()
    for flight in study(make_flyer, track, config.preset, config.flights, sweeps, processes):
        flown.append(flight._asdict())
        lap = "–" if flight.lap_time is None else f"{flight.lap_time:.2f} s"
        words = f"{flight.sweep} {flight.value:g}: {flight.gates} gates, laps of {lap}, {flight.ended}"
        say(f"{actor}: {words}")
    made = {**provenance(), "date": time.strftime("%Y-%m-%d", time.gmtime()), "actor": actor, "track": track.name}
    return {"provenance": {**made, "preset": config.preset, "flights": config.flights}, "flights": flown}


def check(config: SimToRealConfig) -> tuple[Track, Callable[[], Flyer]]:
    """Check the settings; return the track and the factory of the flyer."""
    load_preset(config.preset)
    for name in config.sweeps or ():
        check_choice("sweeps", name, SWEEPS)
    if config.actor == PILOT:
        if config.track is None:
            raise ValueError("track= is missing: actor=pilot has none of its own.")
        if config.beside == PILOT:
            raise ValueError("beside=pilot and actor=pilot: it would fly the same twice; leave one out.")
        track = load_track(config.track)
        return track, partial(PilotFlyer, track, config.preset, config.rate)
    path = existing_agent_path("actor", config.actor)
    contract = read_contract(path)
    track = load_track(config.track) if config.track else trained_track(contract)
    check_contract(contract, track)
    return track, partial(ActorFlyer, path)


if __name__ == "__main__":
    main()
