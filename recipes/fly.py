"""Fly a track and look at it: lap times, a plot from above, an on-board video and a small GIF.

    python recipes/fly.py track=kidney preset=easy pilot=scripted run_dir=runs/fly
    python recipes/fly.py agent=kidney
    python recipes/fly.py agent=kidney view=chase
    python recipes/fly.py agent=kidney viewer=true
    python recipes/fly.py track=figure8 pilot=keyboard

A scripted pilot sees the true state, not images: it shows what a track demands, and which lap times are possible. An
agent has learned to fly by its camera's images: give an included one by its name (docs/agents.md), or a path. With
`pilot=keyboard` and `pilot=gamepad` you fly, by the camera's images in a window (arrows: roll and pitch; A, D: yaw;
W, S: throttle). `viewer=true` shows agents and scripted pilots live in MuJoCo's viewer, the camera's image in a corner,
and writes nothing. Windows need a display. `view=chase` needs none: it films the drone from behind.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import composing  # noqa: F401 - first: explains how to run this if packages are missing
from composing.building import shared_env_arguments
from composing.entry import plain_errors, recipe
from composing.restoring import FlightConfig, restore
from torch import set_num_threads

from dreamer_racing.envs.race.pilot import PILOTS
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.envs.viewer import RaceWindow, ViewerUnavailableError, WindowClosedError, check_window
from dreamer_racing.evaluation.by_hand import KINDS, FlightAbandonedError, HandPolicy, PygameSticks, check_by_hand
from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.evaluate import Episode, Evaluation, evaluate
from dreamer_racing.figures.film import GIF_SIZE
from dreamer_racing.figures.report import film_from_outside, report_flight
from dreamer_racing.settings import COUNT, SEED, check_choice, setting
from dreamer_racing.terminal import say

PILOT, TRACK, PRESET = "scripted", "kidney", "easy"  # defaults without an agent
VIEWS = ("map", "chase")
BREAK = 1.0  # s between two flights in the viewer


@dataclass
class FlyConfig:
    """Configuration of `recipes/fly.py`."""

    agent: str | None = None  # name of one in agents/, or path to an agent, a run directory or a checkpoint
    pilot: str | None = None  # scripted | hover | keyboard | gamepad; null: scripted, if there is no agent
    track: str | None = None  # built-in track, or path to a YAML file; null: kidney, or what the agent was trained on
    preset: str | None = None  # physics: easy | faithful | betaflight; null: easy, or what the agent was trained on
    run_dir: str = "runs/fly"
    # pixels, side of the on-board image; null: 64, or the agent's own, as with the next two
    image_size: int | None = setting(None, COUNT)
    camera_tilt: float | None = None  # degrees upwards; null: 25
    control_rate: float | None = setting(None, COUNT)  # Hz; null: 50
    renderer: str = "auto"  # as env.renderer in training, docs/options.md
    view: str = "map"  # map | chase; chase: also chase.mp4 and chase.gif, the drone from behind beside its own view
    viewer: bool = False  # watch agent or pilot live in a window instead of writing files
    seed: int = setting(0, SEED)

    def check(self) -> None:
        """Refuse what would fail only after the flight."""
        if self.agent is not None and self.pilot is not None:
            raise ValueError(f"pilot={self.pilot} and agent={self.agent}: give one of them.")
        if self.pilot is not None:
            check_choice("pilot", self.pilot, (*PILOTS, *KINDS))
        if self.pilot in KINDS:
            if self.viewer:
                raise ValueError(
                    f"viewer=true and pilot={self.pilot}, which has a window of its own: give one of them."
                )
            check_by_hand(self.pilot)
        check_choice("view", self.view, VIEWS)
        if self.viewer and self.view == "chase":
            raise ValueError("viewer=true and view=chase, which films the flight: give one of them.")
        if self.viewer:
            try:
                check_window()
            except ViewerUnavailableError as error:
                instead = f"leave out viewer=true for a video, a GIF and a plot in {self.run_dir}"
                raise ValueError(f"{error}; {instead}.") from error


@recipe("fly", FlyConfig)
def main(config: FlyConfig) -> None:
    """Fly or watch."""
    set_num_threads(1)  # with a single drone, more threads would only keep cores busy waiting
    if config.viewer:
        watch(config)
    else:
        fly(config)


@dataclass
class PlannedFlight:
    """A race that is about to be flown."""

    env: DroneRacingEnv
    fly: Callable[..., Evaluation]  # one episode of all laps; takes further arguments of `evaluate`


def make_flight(config: FlyConfig) -> PlannedFlight:
    """Prepare the flight of a pilot or an agent."""
    return pilots_flight(config) if config.agent is None else agents_flight(config)


def fly(config: FlyConfig) -> None:
    """Fly one episode of all laps, and write its numbers, plot and films."""
    with folder_to_fill(Path(config.run_dir)) as directory:
        flight = make_flight(config)
        outside = None
        if config.view == "chase":
            with plain_errors():  # without OpenGL
                outside = ChaseView(flight.env.track, flight.env.worlds.parameters, size=GIF_SIZE)
        result = flight.fly()
        flight.env.close()
        laps = ", ".join(f"{duration:.2f} s" for duration in result.lap_times)
        say(f"{result.summary()}\n{'laps':<18} {laps or 'none'}")
        print(f"{'files':<18} {directory}: {report_flight(directory, flight.env.track, result)}")
        if outside is not None:
            films = film_from_outside(directory, outside, flight.env.track, result.trajectories[0])
            print(f"{'from outside':<18} {directory}: {films}")


@contextmanager
def folder_to_fill(directory: Path) -> Iterator[Path]:
    """Make a folder, so that failing to fails before the flight; remove it at the end if nothing was written to it."""
    made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    with plain_errors():
        directory.mkdir(parents=True, exist_ok=True)
    try:
        yield directory
    finally:
        for folder in made:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def watch(config: FlyConfig) -> None:
    """Show one episode of all laps after the other in a window, until it is closed."""
    flight = make_flight(config)
    window = RaceWindow(flight.env.worlds)
    print("close the window, or press Ctrl-C, to end")
    try:
        with suppress(WindowClosedError, KeyboardInterrupt):
            for number in count(1):
                print(f"flight {number}: {in_words(flight.fly(on_step=window.show, num_trajectories=0).episodes[0])}")
                time.sleep(BREAK)
    finally:
        window.close()
        flight.env.close()


def in_words(episode: Episode) -> str:
    """Return how a flight ended, and its lap times, in words."""
    laps = ", ".join(f"{duration:.2f} s" for duration in episode.lap_times)
    return f"{episode.outcome.replace('_', ' ')} after {episode.gates_passed} gates, laps: {laps or 'none'}"


def pilots_flight(config: FlyConfig) -> PlannedFlight:
    """Prepare a flight by a pilot that sees the true state, or by hand."""
    pilot, preset = config.pilot or PILOT, config.preset or PRESET
    looks: dict[str, Any] = {"width": config.image_size, "height": config.image_size, "tilt": config.camera_tilt}
    camera = replace(Camera(), **{name: value for name, value in looks.items() if value is not None})
    worlds: dict[str, Any] = {"evaluation": True, "camera": camera, "renderer": config.renderer}
    if config.control_rate is not None:
        worlds["control_rate"] = config.control_rate
    with plain_errors():
        env = DroneRacingEnv(config.track or TRACK, 1, preset=preset, seed=config.seed, **worlds)
    print(f"{pilot} pilot on {env.track.name}, {env.track.laps} laps, physics: {preset}")
    if pilot in KINDS:
        return PlannedFlight(env, partial(fly_by_hand, pilot, env))
    policy = PILOTS[pilot](env.track, env.worlds.parameters)
    return PlannedFlight(env, partial(evaluate, env, policy, episodes=1))


def fly_by_hand(kind: str, env: DroneRacingEnv) -> Evaluation:
    """Let the user fly in a window; exit without writing anything if the flight is abandoned."""
    parameters = env.worlds.parameters
    with plain_errors():
        sticks = PygameSticks(kind, parameters.control_dt)
    try:
        return evaluate(env, HandPolicy(sticks, parameters.hover_action), episodes=1)
    except FlightAbandonedError:
        print("flight abandoned: nothing is written")
        raise SystemExit(0) from None
    finally:
        sticks.close()


def agents_flight(config: FlyConfig) -> PlannedFlight:
    """Prepare a flight by the deterministic policy of a trained agent."""
    with plain_errors():
        race = FlightConfig(track=config.track, preset=config.preset, renderer=config.renderer, seed=config.seed)
        restored = restore(replace(race, checkpoint=str(config.agent)))
        for name in ("image_size", "camera_tilt", "control_rate"):
            given, trained = getattr(config, name), getattr(restored.trained.env, name)
            if given is not None and given != trained:
                raise ValueError(
                    f"{name}={given}: {config.agent} was trained with {name}={trained}, which cannot change."
                )
        worlds = shared_env_arguments(restored.trained) | {"seed": config.seed}
        track = load_track(worlds["track"])
    print(f"{config.agent} on {track.name}, {track.laps} laps, physics: {restored.trained.env.preset}")
    course = Course(restored.flyer.evaluation_policy(), worlds, episodes=1)
    return PlannedFlight(course.base, partial(course.evaluate, value_function=restored.flyer.value_function()))


if __name__ == "__main__":
    main()
