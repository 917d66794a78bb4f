"""Write a page on which to scrub through a flight in 3-D, with on-board image, action and value beside it.

    python recipes/dashboard.py agent=kidney
    python recipes/dashboard.py run=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dashboard.py run=runs/kidney_x against=runs/kidney_y output=page.html
    python recipes/dashboard.py run=runs/kidney_x serve=8080

Writes one self-contained HTML file: open it in a browser, without a server, or send it to somebody. `run=` and
`against=` take a stored flight: a run directory (its last evaluation), an output folder of recipes/evaluate.py or
recipes/fly.py, or a file *_trajectory.csv; or an included agent by its name, which is flown once, deterministically.
`agent=` flies checkpoints, too. `serve=` also shows it live, to browsers on this machine. Training curves are in
TensorBoard: the page says how to open it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from composing.building import shared_env_arguments
from composing.entry import plain_errors, recipe
from composing.restoring import FlightConfig, restore

from dreamer_racing.commands import from_here
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.protocol import fly as fly_races
from dreamer_racing.evaluation.trajectory import NUMBERS, read_flight
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.shipped_agent import is_agent
from dreamer_racing.figures.dashboard import serve, write_page
from dreamer_racing.figures.dashboard_panel import how_it_trained, missing
from dreamer_racing.figures.flights import NamedFlight
from dreamer_racing.figures.plotting import STORED, run_of, stage_name, stored_flights
from dreamer_racing.figures.scene_3d import check_viser
from dreamer_racing.settings import SEED, Range, setting

PAGE = "dashboard.html"


@dataclass
class DashboardConfig:
    """Configuration of `recipes/dashboard.py`."""

    run: str | None = None  # run directory, folder or file of stored flights, or name of an included agent
    agent: str | None = None  # instead of run=: agent, run directory or checkpoint to fly now, as in recipes/fly.py
    against: str | None = None  # another flight on the same track, given as run=, to show in the same scene
    output: str | None = None  # file; null: dashboard.html in the run's folder, for an agent in runs/agent_<name>
    serve: int | None = setting(None, Range(1, 65535))  # port on which to show it live, too, on this machine alone
    renderer: str = "auto"  # for flights that are flown now; as env.renderer in training, docs/options.md
    seed: int = setting(0, SEED)  # for flights that are flown now

    def check(self) -> None:
        """Refuse anything but one of run= and agent=, and an output that is not HTML."""
        if (self.run is None) == (self.agent is None):
            given = "neither is given" if self.run is None else f"both are given, {self.run} and {self.agent}"
            raise ValueError(f"run= names a stored flight, agent= what to fly now: give one of them; {given}.")
        if self.output is not None and Path(self.output).suffix not in (".html", ".htm"):
            raise ValueError(f"output={self.output}: the page is one HTML file, whose name ends in .html.")


class Source(NamedTuple):
    """A flight, and where it came from."""

    flight: NamedFlight
    folder: Path  # of the run, or else of the stored flight


@recipe("dashboard", DashboardConfig)
def main(config: DashboardConfig) -> None:
    """Find or fly the flights, write the page, and show it if asked to."""
    with plain_errors():
        check_viser()
        sources = find(config)
        training = [how_it_trained(source.folder for source in sources)]
        flights = [source.flight for source in sources]
        output = Path(config.output or Path(from_here(sources[0].folder)) / PAGE)
        size = write_page(output, flights, training)
    for line in (*training, *(line for flight in flights for line in missing(flight))):
        print(line.replace("`", ""))
    print(f"page: {output} ({size / 1e6:.1f} MB, opens in a browser without a server)")
    if config.serve is not None:
        try:
            serve(flights, config.serve, training, lambda live: print(f"live: {live} until Ctrl+C", flush=True))
        except KeyboardInterrupt:
            print("ended")


def find(config: DashboardConfig) -> list[Source]:
    """Find or fly the requested flight, and the one to compare it with, on the same track."""
    places = [locate("run", config.run) if config.run is not None else str(config.agent)]
    places += [] if config.against is None else [locate("against", config.against)]
    sources = [read(place) if isinstance(place, Path) else fly(place, config) for place in places]
    first, *others = (source.flight for source in sources)
    for other in others:
        if other.track != first.track:
            again = " with other gates" if other.track.name == first.track.name else ""
            raise ValueError(
                f"against={config.against} was flown on {other.track.name}{again}, {first.title} on "
                f"{first.track.name}: only flights on one track can be shown in one scene."
            )
    return sources


def locate(setting_name: str, place: str) -> Path | str:
    """Return what `run=` or `against=` names: the file of a stored flight, or the name of an agent to fly."""
    path = existing_agent_path(setting_name, place)
    if path.is_file():
        return path
    if is_agent(path):
        return place
    flights = stored_flights(path)
    if not flights:
        raise FileNotFoundError(
            f"{setting_name}={place} holds no flight: no *{NUMBERS} in it or in its evaluations/, where every "
            f"evaluation writes one. agent={place} flies its newest checkpoint now."
        )
    return flights[-1]


def read(file: Path) -> Source:
    """Read a stored flight with its track; its title names run and evaluation."""
    trajectory, track = read_flight(file)
    folder = run_of(file)
    stage = "" if file.name == f"{STORED[0]}{NUMBERS}" else f", {stage_name(file)}"
    return Source(NamedFlight(f"{folder.name}{stage}", track, trajectory), folder)


def fly(place: str, config: DashboardConfig) -> Source:
    """Fly the deterministic policy of an agent once, as recipes/fly.py does."""
    restored = restore(FlightConfig(checkpoint=place, renderer=config.renderer, seed=config.seed))
    worlds = shared_env_arguments(restored.trained) | {"seed": config.seed}
    policy, value_function = restored.flyer.evaluation_policy(), restored.flyer.value_function()
    flown = fly_races(policy, worlds, episodes=1, value_function=value_function)
    print(flown.summary())
    name = restored.checkpoint.name if is_agent(restored.checkpoint) else restored.run_dir.name
    title, track = f"{name}, {restored.env_steps:,} env_steps", load_track(worlds["track"])
    return Source(NamedFlight(title, track, flown.trajectories[0]), restored.run_dir)


if __name__ == "__main__":
    main()
