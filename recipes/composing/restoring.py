"""Restore a trained policy for the recipes that fly it, and describe where their results come from."""

import time
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import MISSING

from composing.building import Environment, make_env, make_learner, serialize_track_file, worlds_device
from composing.saved import trained_config
from composing.schema import RunConfig, WorldModelRunConfig, is_race
from dreamer_racing.devices import choose_device
from dreamer_racing.envs.drone.parameters import name_of_preset
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import hash_track
from dreamer_racing.export.actor_step import ActorStep
from dreamer_racing.export.contract import hash_weights
from dreamer_racing.export.shipped_agent import (
    AVERAGED,
    TRAINED,
    ShippedAgent,
    choose_weights,
    config_folder,
    find_trained,
    is_agent,
    kept_weights,
    results_of,
)
from dreamer_racing.learners.learner import Evaluable, Learner
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.machine import command_line, provenance
from dreamer_racing.modules import Interface
from dreamer_racing.settings import COUNT, SEED, setting
from dreamer_racing.training.checkpoint import SavedState, load_components
from dreamer_racing.training.schedule import Schedule


@dataclass
class FlightConfig:
    """Settings that the recipes which fly a trained policy share."""

    checkpoint: str = MISSING  # run directory, checkpoint, or agent (docs/agents.md)
    weights: str = "auto"  # auto | averaged | trained: which to fly; auto takes the averaged ones if there are any
    episodes: int = setting(100, COUNT)  # per condition
    # worlds that fly in parallel; null: one per episode, so that every policy flies the same races
    num_envs: int | None = setting(None, COUNT)
    track: str | None = None  # null: the track it was trained on
    decoys: str | None = None  # +decoys=paper | none; null: as in training, or none if track= is given
    preset: str | None = None  # null: the physics it was trained on
    run_dir: str | None = None  # null: the run directory of the checkpoint
    device: str = "auto"
    renderer: str = "auto"
    seed: int = setting(0, SEED)


@dataclass
class Restored:
    """A trained agent, and the race that it will fly."""

    checkpoint: Path  # or the folder of an agent
    trained: RunConfig  # configuration of its run, with the requested race in place of the training race
    trained_on: str  # track of the training
    flyer: Evaluable
    weights: str  # averaged | trained
    env_steps: int
    machine: dict[str, Any]  # with versions and commit, as of the start
    started: float  # s, by the monotonic clock

    @property
    def run_dir(self) -> Path:
        """Directory for results: the checkpoint's run directory, or for an agent a folder below runs/."""
        return results_of(self.checkpoint)

    @property
    def weights_sha256(self) -> str | None:
        """SHA-256 of the weights that act, as in an export's contract; None for the baselines."""
        if isinstance(self.flyer, WorldModelLearner):
            return hash_weights(ActorStep(self.flyer.evaluation_agent))
        return hash_weights(ActorStep(self.flyer.agent)) if isinstance(self.flyer, ShippedAgent) else None

    def provenance(self, config: FlightConfig) -> dict[str, Any]:
        """Return the provenance of an evaluation that ends now."""
        return {
            "command": command_line(),
            "checkpoint": config.checkpoint,
            "algorithm": self.trained.algorithm,
            "weights": self.weights,
            "weights_sha256": self.weights_sha256,
            "env_steps": self.env_steps,
            "trained_on": self.trained_on,
            "track": self.trained.track,
            "track_sha256": hash_track(self.trained.saved_track()),
            "decoys": self.trained.decoys,
            "preset": name_of_preset(self.trained.env.preset),
            "control_rate": self.trained.env.control_rate,
            "worlds_device": self.trained.env.device,
            "renderer": self.trained.env.renderer,
            "episodes": config.episodes,
            "seed": config.seed,
            "wall_clock_seconds": round(time.monotonic() - self.started, 1),
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            **self.machine,
        }


def restore(config: FlightConfig) -> Restored:
    """Restore the policy of a checkpoint or agent, for the race that the configuration names."""
    started, machine = time.monotonic(), provenance()
    torch.set_float32_matmul_precision("high")  # as in training
    device = choose_device(config.device)
    checkpoint = find_trained(config.checkpoint)
    trained = trained_config(config_folder(checkpoint))
    torch.manual_seed(config.seed)
    if not is_race(trained):
        raise ValueError(f"{checkpoint} was trained on {trained.task}; this recipe evaluates races.")
    trained_on = trained.track
    if config.track:
        trained.track, trained.track_description, trained.decoys = config.track, None, None
    trained.track_description = trained.track_description or serialize_track_file(trained.track)  # as the file is now
    trained.decoys = config.decoys or trained.decoys
    trained.env.preset = config.preset or trained.env.preset
    trained.env.renderer = config.renderer
    flyer: Evaluable
    if is_agent(checkpoint):
        with closing(_probe(trained)) as env:
            flyer = shipped = ShippedAgent.load(checkpoint, cast(DroneRacingEnv, env), device)
        weights = choose_weights(config.weights, shipped.about["weights"], checkpoint)
        env_steps = shipped.about["env_steps"]
    else:
        flyer, counters = restore_learner(trained, checkpoint, device, config.weights)
        weights = TRAINED if getattr(flyer, "averaged", None) is None else AVERAGED
        env_steps = counters["env_steps"]
    trained.env.device = worlds_device(device, trained.env)
    if device.type != "cpu":
        print(f"worlds: {trained.env.device} (renderer={config.renderer})")
    print(f"checkpoint: {checkpoint} ({trained.algorithm}, trained on {trained_on}, {env_steps:,} env_steps)")
    print(f"weights: {weights}{' (weights=auto)' if config.weights == 'auto' else ''}")
    return Restored(checkpoint, trained, trained_on, flyer, weights, env_steps, machine, started)


def restore_learner(
    config: RunConfig, checkpoint: Path, device: torch.device, weights: str = "auto"
) -> tuple[Learner, dict[str, int]]:
    """Restore the learner of a run's checkpoint with the requested weights, and the run's counters."""
    saved, counters = SavedState(), dict[str, int]()
    parts: dict[str, Any] = {"learner": saved, "counters": counters}  # read together, so of one checkpoint
    if isinstance(config, WorldModelRunConfig):  # its gates come from the checkpoint
        parts["schedule"] = Schedule(config.schedule, config.scheduled, config.total_env_steps)
    load_components(checkpoint, parts)
    chosen = choose_weights(weights, kept_weights(saved.state), checkpoint)
    if isinstance(config, WorldModelRunConfig):
        config.model.cuda_graph = False
        config.model.average_rate = (config.model.average_rate or 1.0) if chosen == AVERAGED else None
    with closing(_probe(config)) as env:
        learner = make_learner(config, Interface.of(env), device)
    learner.load_state_dict(saved.state)
    if (schedule := parts.get("schedule")) is not None:
        # Saved with the networks; the schedule of a run that was made longer would give other values.
        left_out = ("min_std", "max_std", "start_on_line")
        numbers = {name: value for name, value in schedule.at(counters["env_steps"]).items() if name not in left_out}
        cast(WorldModelLearner, learner).adjust(**numbers)
    return learner, counters


def _probe(config: RunConfig) -> Environment:
    """Make an environment with one world on the CPU, wherever it was trained, to read its specs."""
    env = replace(config.env, device="cpu", start_on_line=0.0)  # planning a line is slow
    return make_env(replace(config, env=env), num_envs=1)
