"""Make the parts of a training run from its configuration: environment, learner, collector, replay, evaluation."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from omegaconf import OmegaConf
from torchrl.collectors import Collector

from composing.saved import OBSERVATION_SETTINGS, saved_config
from composing.schema import (
    EnvConfig,
    LatentPPORunConfig,
    PPORunConfig,
    ReplayRunConfig,
    RunConfig,
    SACRunConfig,
    WorldModelRunConfig,
    is_race,
)
from dreamer_racing import parallel
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, describe_track, load_track
from dreamer_racing.experience.replay import SequenceReplayConfig, StreamReplay, make_replay
from dreamer_racing.experience.replay_place import choose_place, replay_bytes
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.shipped_agent import is_agent, load_trained
from dreamer_racing.figures.report import EvaluationReport, ReturnReport
from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.learners.learner import Learner, Policy
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import find_targets
from dreamer_racing.modules import Interface, ModelSize, get_size
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.modules.rssm import LatentFormat
from dreamer_racing.training.checkpoint import load_state
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.session import Evaluator

if TYPE_CHECKING:
    from dreamer_racing.envs.control_suite import ControlSuiteEnv

Environment: TypeAlias = "DroneRacingEnv | ControlSuiteEnv"


def serialize_track_file(track: str) -> str | None:
    """Return the contents of a track file as JSON, to be saved with a run; None for a built-in track."""
    if track in BUILTIN_TRACKS:
        return None
    return json.dumps(describe_track(load_track(track))).replace("$", "\\u0024")  # OmegaConf would interpolate a $


def worlds_device(device: torch.device, env: EnvConfig) -> str:
    """Return the device for worlds: the learner's CUDA device if simulator and renderer run there, else the CPU."""
    fits = env.suite == "race" and env.renderer in ("auto", "warp")
    return str(device) if device.type == "cuda" and fits else "cpu"


def shared_env_arguments(config: RunConfig) -> dict[str, Any]:
    """Return the arguments that all `DroneRacingEnv`s of the run share, in training and evaluation."""
    return {"track": config.saved_track(), **config.env.arguments()}


def make_env(config: RunConfig, num_envs: int | None = None, num_threads: int | None = None) -> Environment:
    """Make the training environment, of `env.num_envs` worlds by default, and as many threads as `DroneRacingEnv`."""
    num_envs = num_envs or config.env.num_envs
    readers = privileged_losses(config) if isinstance(config, WorldModelRunConfig) else []
    if is_race(config):
        return DroneRacingEnv(
            num_envs=num_envs,
            privileged=bool(readers),
            seed=config.seed,
            num_threads=num_threads,
            **config.env.training_arguments(),
            **shared_env_arguments(config),
        )
    if readers:
        raise ValueError(
            f"{' and '.join(readers)}: read the race's privileged state, which env=dmc does not have. Choose other "
            "losses, e.g. loss=reconstruction, and with recipes/latent_ppo.py loss.critic=latent."
        )
    return make_suite(config, num_envs, config.seed, config.env.episode_steps)


def privileged_losses(config: WorldModelRunConfig) -> list[str]:
    """Return the run's settings, as NAME=VALUE, that choose losses which read the simulator's state."""
    model = config.loss.world_model
    readers = {f"loss.world_model={model}": any(PRIVILEGED in target.reads for target in find_targets(model))}
    if isinstance(config, LatentPPORunConfig):
        readers[f"loss.critic={config.loss.critic}"] = config.loss.critic == "state"
    return [words for words, reads in readers.items() if reads]


def make_suite(config: RunConfig, num_envs: int, seed: int, episode_steps: int | None = None) -> ControlSuiteEnv:
    """Make a Control Suite environment; for training, `episode_steps` sets the control steps of an episode."""
    from dreamer_racing.envs.control_suite import ControlSuiteEnv  # importing it opens a display

    sees: dict[str, Any] = {"from_pixels": config.env.from_pixels, "image_size": config.env.image_size}
    return ControlSuiteEnv(config.task, num_envs, seed=seed, episode_steps=episode_steps, **sees)


def make_evaluator(config: RunConfig, directory: Path, learner: Learner) -> Evaluator | None:
    """Make the evaluator used during training, in the first process."""
    if not parallel.is_first():
        return None
    asked = config.evaluation
    if is_race(config):
        worlds = {**shared_env_arguments(config), "start_noise": asked.start_noise}
        return EvaluationReport(directory, learner, worlds, asked.episodes, asked.video_steps)
    env = make_suite(config, min(8, asked.episodes), config.seed + 1)
    return ReturnReport(directory, learner, env, asked.episodes, asked.video_steps, config.seed + 1)


def size_of(config: WorldModelRunConfig) -> ModelSize:
    """Return the networks' size, with `model.sampled` and `model.state_std` filled in."""
    return replace(get_size(config.model.size), sampled=config.model.sampled, state_std=config.model.state_std)


def load_initial_weights(learner: WorldModelLearner, config: WorldModelRunConfig, env: Environment) -> str:
    """Load the weights that ``init_from`` names into a new learner, if they fit; return a log line on them."""
    source, behavior = str(config.init_from), config.init_behavior
    folder = existing_agent_path("init_from", source)
    if not is_agent(folder):
        saved = saved_config(RunDirectory.of(latest_checkpoint(folder)).path)
        for name in OBSERVATION_SETTINGS:
            there, here = OmegaConf.select(saved, name), OmegaConf.select(OmegaConf.structured(config), name)
            if there != here:
                raise ValueError(f"{name}={here}: init_from={source} was trained with {name}={there}; use the same.")
        state, metadata = load_state(folder, "learner")
        unmatched = learner.adopt(state, behavior)
        kind = "averaged" if "averaged" in state else "trained"
        which = "heads and critic too" if behavior else "the world model alone (init_behavior=false)"
        line = f"weights: {kind}, of {folder} at {metadata['env_steps']:,} env_steps (init_from=), {which}"
        line += f"; not in that run, so untrained: {' and '.join(unmatched.initial)}" if unmatched.initial else ""
        return line + (f"; not loaded: {' and '.join(unmatched.unused)}" if unmatched.unused else "")
    if not isinstance(env, DroneRacingEnv):
        raise ValueError(f"init_from={source}: this agent was trained on races, and this run has none.")
    load_trained(folder, env, *filter(None, (learner.agent, learner.averaged)), actor=behavior)
    loaded, others = ("encoder, RSSM and actor", "heads and critic") if behavior else ("encoder and RSSM", "all others")
    return f"weights: {loaded} of {folder} (init_from=); {others} start untrained"


def make_learner(
    config: RunConfig, interface: Interface, device: torch.device | str, seed: int | None = None
) -> Learner:
    """Make the learner of a resolved configuration; the initial weights are by its seed unless another is given."""
    seed = config.seed if seed is None else seed
    if isinstance(config, WorldModelRunConfig):
        kind = LatentPPO if isinstance(config, LatentPPORunConfig) else DreamerV3
        return kind.make(size_of(config), interface, config.loss, config.model, device=device, seed=seed)
    if isinstance(config, PPORunConfig):
        return PPOLearner(NetworkSize(config.network.layers, config.network.units), interface, config.ppo, device, seed)
    if isinstance(config, SACRunConfig):
        return SACLearner(NetworkSize(config.network.layers, config.network.units), interface, config.sac, device, seed)
    raise NotImplementedError(f"make_learner() has no branch for {type(config).__name__}: add one.")


def seed_generators(seed: int) -> None:
    """Seed all global random generators; torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - libraries draw from it
    torch.manual_seed(seed)


def num_gates(env: Environment) -> int:
    """Return how many gates the track has; 0 where there is no race."""
    return env.track.num_gates if isinstance(env, DroneRacingEnv) else 0


def make_curriculum(config: RunConfig, env: Environment) -> BodyRateCurriculum:
    """Make the curriculum of the body-rate penalty; outside races it changes nothing."""
    return BodyRateCurriculum(config.curriculum, env if is_race(config) else None)


def make_collector(config: RunConfig, env: Environment, policy: Policy) -> Collector:
    """Make the collector of rollouts [num_envs, rollout_steps], on the worlds' device.

    CPU worlds must wait for the actions of a policy on a CUDA device; on the same device, kernels run in order anyway.
    """
    return Collector(
        with_memory(env, policy.make_primer()),
        policy,
        frames_per_batch=config.env.num_envs * config.rollout_steps,
        total_frames=-1,
        env_device=env.device,
        policy_device=config.device,
        storing_device=env.device,
        track_traj_ids=False,
        no_cuda_sync=env.device.type == "cuda",
    )


def make_run_replay(
    config: ReplayRunConfig,
    env: Environment,
    curriculum: BodyRateCurriculum,
    batch: tuple[int, int],
    latents: LatentFormat | None = None,
) -> StreamReplay:
    """Make the replay of an environment's records, on the learner's device if it fits; print its place and size.

    A batch has so many windows of so many records. The curriculum recomputes old rewards, if `curriculum.relabel`.
    """
    settings, interface, shown = config.replay, Interface.of(env), env.observation_spec.keys()
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers, latents)
    place = choose_place(settings, size, config.device, config.run_directory.replay)
    place.prepare()
    print(place)
    saved = round(size * min(parallel.num_processes(), config.total_env_steps / settings.capacity))
    print(config.checkpoint.disk_needed(saved, config.run_directory))
    windows = {}
    if isinstance(settings, SequenceReplayConfig):
        windows = {name: getattr(settings, name) for name in ("recent_share", "recent_records", "held_out")}
    return make_replay(
        settings.capacity,
        config.env.num_envs,
        *batch,
        config.device,
        storage_device=place.device,
        scratch_dir=place.files,
        seed=config.seed,
        transform=RelabelReward(curriculum) if curriculum.env is not None and config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
        # The curriculum recomputes rewards from these terms.
        reward_keys=["reward", *(name for name in ("reward_base", "body_rate_norm") if name in shown)],
        latents=latents,
        # Prefetched samples would lack the latents that the update before them stores.
        prefetch=2 if config.device != "cpu" and place.device == "cpu" and latents is None else None,
        **windows,
    )


def make_tracker(config: RunConfig) -> EpisodeTracker:
    """Make the tracker of finished episodes in this process's worlds."""
    return EpisodeTracker(config.env.num_envs // parallel.num_processes(), CrashCause if is_race(config) else None)
