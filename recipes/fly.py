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
import numpy as np
from composing.building import shared_env_arguments
from composing.entry import plain_errors, recipe
from composing.restoring import FlightConfig, restore
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import set_num_threads, tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.race.pilot import PilotPolicy, ScriptedPilot
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.envs.viewer import RaceWindow, ViewerUnavailableError, WindowClosedError, check_window
from dreamer_racing.evaluation.by_hand import KINDS, FlightAbandonedError, HandPolicy, PygameSticks, check_by_hand
from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.evaluate import Episode, Evaluation, Trajectory, evaluate
from dreamer_racing.evaluation.trajectory import write_flight
from dreamer_racing.figures.chase import chase_beside_onboard
from dreamer_racing.figures.film import enlarge_to_watch, onboard_beside_map, write_gif, write_video
from dreamer_racing.figures.hud import caption, laps_completed, race_words
from dreamer_racing.figures.top_down import plot_top_down
from dreamer_racing.settings import COUNT, SEED, check_choice, setting
from dreamer_racing.terminal import say
from dreamer_racing.training.directory import EVALUATION

GIF_SIZE = 256  # pixels, least side of either picture
GIF_STRIDE = 2  # control steps a frame: 25 frames a second
CHASE_STRIDE, CHASE_COLORS = 3, 32  # of chase.gif, in which the whole picture moves
PILOT, TRACK, PRESET = "scripted", "kidney", "easy"  # defaults without an agent
VIEWS = ("map", "chase")
GIF_STEPS = 300  # control steps shown if there is no second lap
BREAK = 1.0  # s between two flights in the viewer

Acting = Callable[[TensorDictBase], TensorDictBase]


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
        """Refuse what would fail only after the flight.

        Raises:
            ValueError: bad value; the message names the field and what is allowed.
        """
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
            check_display(self)


def scripted(track: Track, parameters: QuadrotorParameters) -> Acting:
    """Make the pilot that plans a line through the gates and follows it."""
    return PilotPolicy(ScriptedPilot(track, parameters))


def hover(track: Track, parameters: QuadrotorParameters) -> Acting:
    """Make the pilot that stays at the start."""
    still = tensor([parameters.hover_action, 0.0, 0.0, 0.0])
    return TensorDictModule(lambda position: still.repeat(len(position), 1), [("privileged", "position")], ["action"])


PILOTS: dict[str, Callable[[Track, QuadrotorParameters], Acting]] = {"scripted": scripted, "hover": hover}


@recipe("fly", FlyConfig)
def main(config: FlyConfig) -> None:
    """Fly or watch."""
    set_num_threads(1)  # with a single drone, more threads would only keep cores busy waiting
    if config.viewer:
        watch(config)
    else:
        fly(config)


def check_display(config: FlyConfig) -> None:
    """Refuse viewer=true if no window can be opened, and name the alternative.

    Raises:
        ValueError: no window can be opened here.
    """
    try:
        check_window()
    except ViewerUnavailableError as error:
        raise ValueError(
            f"{error}; leave out viewer=true for a video, a GIF and a plot in {config.run_dir}."
        ) from error


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
        outside = open_view(flight.env) if config.view == "chase" else None
        result = flight.fly()
        flight.env.close()
        laps = ", ".join(f"{duration:.2f} s" for duration in result.lap_times)
        say(f"{result.summary()}\n{'laps':<18} {laps or 'none'}")
        write(directory, flight.env.track, result)
        if outside is not None:
            film_from_outside(directory, outside, flight.env.track, result.trajectories[0])


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
    camera = Camera()
    if config.image_size is not None:
        camera = replace(camera, width=config.image_size, height=config.image_size)
    if config.camera_tilt is not None:
        camera = replace(camera, tilt=config.camera_tilt)
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


def write(directory: Path, track: Track, result: Evaluation) -> None:
    """Write numbers and plot, and of flights with images a video and a GIF; print where."""
    trajectory = result.trajectories[0]
    (directory / EVALUATION).write_text(result.to_json())
    stored = write_flight(directory / "flight", trajectory, track)
    plot_top_down(track, trajectory, directory / "top_down.png")
    for earlier in ("onboard.mp4", "onboard.gif", "chase.mp4", "chase.gif"):
        (directory / earlier).unlink(missing_ok=True)  # so that none is mistaken for this flight's
    files = f"{directory}: {EVALUATION}, {', '.join(stored)}, top_down.png"
    if trajectory.pixels is None:
        print(f"{'files':<18} {files} (there is no video: the agent sees numbers)")
        return
    words = race_words(track, trajectory)
    film = caption(enlarge_to_watch(trajectory.pixels.numpy()), words)
    filmed = write_video(directory / "onboard.mp4", film, fps=1 / trajectory.control_dt, scale=1)
    first, last = second_lap(trajectory)
    frames = onboard_beside_map(track, trajectory.part(first, last), GIF_SIZE)[::GIF_STRIDE]
    gif = caption(frames, words[first : last + 1 : GIF_STRIDE])
    size = write_gif(directory / "onboard.gif", gif, fps=1 / (GIF_STRIDE * trajectory.control_dt))
    print(f"{'files':<18} {files}, {'onboard.mp4, ' if filmed else ''}onboard.gif ({size / 1e6:.2f} MB)")


def open_view(env: DroneRacingEnv) -> ChaseView:
    """Make the chase view, so that missing OpenGL fails before the flight."""
    with plain_errors():
        return ChaseView(env.track, env.worlds.parameters, size=GIF_SIZE)


def film_from_outside(directory: Path, view: ChaseView, track: Track, trajectory: Trajectory) -> None:
    """Write a video of the whole flight and a GIF of its second lap, seen from outside and by the drone."""
    frames, words = chase_beside_onboard(view, trajectory), race_words(track, trajectory)
    view.close()
    filmed = write_video(directory / "chase.mp4", caption(frames, words), fps=1 / trajectory.control_dt, scale=1)
    first, last = second_lap(trajectory)
    shown = slice(first, last + 1, CHASE_STRIDE)
    gif = caption(frames[shown], words[shown])
    size = write_gif(directory / "chase.gif", gif, fps=1 / (CHASE_STRIDE * trajectory.control_dt), colors=CHASE_COLORS)
    print(f"{'from outside':<18} {directory}: {'chase.mp4, ' if filmed else ''}chase.gif ({size / 1e6:.2f} MB)")


def second_lap(trajectory: Trajectory) -> tuple[int, int]:
    """Return the first and last step of the second lap, flown at racing speed; else of the flight's beginning."""
    ends = (np.diff(laps_completed(trajectory)).nonzero()[0] + 1).tolist()
    return (ends[0], ends[1]) if len(ends) > 1 else (0, min(GIF_STEPS, len(trajectory.action)))


if __name__ == "__main__":
    main()
