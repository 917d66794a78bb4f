"""Measure what a trained policy looks at, and whether it needs to.

    python recipes/perception.py checkpoint=runs/dreamer_v3_figure8_20260101-120000
    python recipes/perception.py checkpoint=runs/dreamer_v3_figure8_20260101-120000 track=figure8 +decoys=paper

Flies without and with decoys, measures the angle between the camera's axis and gates and decoys and how long each is in
view, then flies with frozen, blank and noise images. Writes perception.json, perception.md and perception.png; an
earlier report is never overwritten. docs/evaluation.md says what is measured.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from composing.building import shared_env_arguments
from composing.entry import plain_disk_errors, plain_errors, recipe
from composing.restoring import FlightConfig, Restored, restore
from composing.schema import RunConfig

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track, decoys_for, with_decoys
from dreamer_racing.evaluation.image_corruptions import CORRUPTIONS, CorruptedPolicy
from dreamer_racing.evaluation.protocol import MODES, Result, fly
from dreamer_racing.evaluation.sight import NO_NOISE, START_NOISE, SightResults, measure_sight, sight_report
from dreamer_racing.figures.protocol import plot_sight
from dreamer_racing.settings import COUNT, setting
from dreamer_racing.terminal import say
from dreamer_racing.training.directory import fresh_directory, replace_text

RESULT = "perception.json"
WITHOUT, WITH = "without decoys", "with decoys"


@dataclass
class PerceptionConfig(FlightConfig):
    """Configuration of `recipes/perception.py`."""

    num_envs: int | None = setting(None, COUNT)  # null: one per episode; sight is measured in the first flight of each
    decoys: str | None = None  # +decoys=paper; null: those that the track defines, if any
    run_dir: str | None = None  # null: <run of the checkpoint>/perception


@recipe("perception", PerceptionConfig)
def main(config: PerceptionConfig) -> None:
    """Restore the policy, fly it with and without decoys and with corrupted images, report."""
    with plain_errors():
        restored = restore(config)
        if not restored.trained.env.from_pixels:
            raise ValueError(f"{restored.checkpoint} sees numbers, not images: there is nothing to measure.")
        tracks = tracks_to_fly(restored.trained)
        directory = fresh_directory(config.run_dir or restored.run_dir / "perception", RESULT)
    looked = fly_and_look(config, restored, tracks)
    corrupted = {noise: fly_corrupted(config, restored, noise) for noise in (NO_NOISE, START_NOISE)}
    provenance = restored.provenance(config)
    with plain_disk_errors():
        write(directory, looked, corrupted, provenance, shared_env_arguments(restored.trained)["camera"])
    say(f"\nwritten to {directory}")


def tracks_to_fly(trained: RunConfig) -> dict[str, Track]:
    """Return the track without decoys and, if it defines places for them, with them."""
    track = trained.saved_track()
    if trained.decoys is None and not track.decoys:
        track = with_decoys(track, decoys_for(track))
    plain = {WITHOUT: with_decoys(track, "none")}
    if not track.decoys:
        print(f"decoys: none, {track.name} has no place for them")
        return plain
    return plain | {WITH: track}


def fly_and_look(config: PerceptionConfig, restored: Restored, tracks: dict[str, Track]) -> dict[str, SightResults]:
    """Fly the deterministic policy without and with decoys from the same noisy starts; measure what it looked at."""
    worlds = shared_env_arguments(restored.trained) | {"start_noise": START_NOISE, "seed": config.seed}
    decoys = next(reversed(tracks.values())).decoys  # also for flights without: where they would stand
    looked = {}
    for name, track in tracks.items():
        flown = fly(
            restored.flyer.evaluation_policy(),
            {**worlds, "track": track},
            config.episodes,
            num_envs=config.num_envs,
            num_trajectories=config.episodes,
            record_pixels=False,
        )
        say(f"\n{name}, {len(flown.trajectories)} flights recorded\n{flown.summary()}")
        sights = measure_sight(flown.trajectories, track, worlds["camera"], decoys)
        looked[name] = SightResults(track, flown.gates_per_episode, flown.success_rate, flown.trajectories[0], sights)
    return looked


def fly_corrupted(config: PerceptionConfig, restored: Restored, start_noise: float) -> list[Result]:
    """Fly the policy in both modes on the requested track, with every corruption of its images."""
    trained = restored.trained
    worlds = shared_env_arguments(trained) | {"start_noise": start_noise, "seed": config.seed}
    results = []
    for name, make in CORRUPTIONS.items():
        for mode in MODES:
            policy = CorruptedPolicy(restored.flyer.evaluation_policy(), make())
            flown = fly(policy, worlds, config.episodes, mode == "deterministic", config.num_envs, num_trajectories=0)
            results.append(Result(Path(trained.env.preset).name, name, mode, worlds["track"], flown))
            say(f"\n{name} images, {mode} policy, start noise {start_noise:g}\n{flown.summary()}")
    return results


def write(
    directory: Path,
    looked: dict[str, SightResults],
    corrupted: dict[float, list[Result]],
    provenance: dict[str, Any],
    camera: Camera,
) -> None:
    """Write numbers, tables and the plot; `corrupted` maps the noise of starts to flights with corrupted images."""
    title = f"{provenance['algorithm']} on {provenance['track']}, {provenance['env_steps']:,} env_steps"
    plot_sight(looked, camera, directory / "perception.png", title)
    (directory / "perception.md").write_text(sight_report(title, looked, corrupted, provenance), encoding="utf-8")
    numbers = {
        "flights": {name: kind.to_dict() for name, kind in looked.items()},
        "image_corruptions": [
            {"images": result.condition, "start_noise": noise, **result.to_dict()}
            for noise, results in corrupted.items()
            for result in results
        ],
        "provenance": provenance,
    }
    replace_text(directory / RESULT, json.dumps(numbers, indent=2, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
