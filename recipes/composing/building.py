"""Make the parts of a training run from its configuration: environment, learner, collector, replay, evaluation."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torchrl.collectors import Collector

from composing.saved import OBSERVATION_SETTINGS, read_yaml
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
from dreamer_racing.evaluation.held_out import SEEN as OBSERVED
from dreamer_racing.evaluation.held_out import held_out_metrics, world_model_metrics
from dreamer_racing.experience.replay import SequenceReplayConfig, Storage, StreamReplay, make_replay, replay_bytes
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.onnx_actor import CONTRACT, read_contract
from dreamer_racing.export.shipped_agent import check_env, is_agent, load_networks
from dreamer_racing.figures.report import EvaluationReport, ReturnReport
from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.learners.learner import Evaluable, Learner, Policy
from dreamer_racing.learners.saved import check_size
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import find_targets
from dreamer_racing.machine import (
    available_memory,
    check_fits,
    check_space,
)
from dreamer_racing.modules import Agent, Interface, ModelSize, get_size
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.modules.rssm import LatentFormat
from dreamer_racing.training.checkpoint import load_state
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import NoReport
from dreamer_racing.training.schedule import ModelLag
from dreamer_racing.training.session import Evaluator, Session

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
    """Make the training environment.

    Args:
        config: resolved.
        num_envs: number of worlds; None: `env.num_envs`.
        num_threads: CPU threads that step and draw a race's worlds; None: one per CPU, at most `OMP_NUM_THREADS`.
    """
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

    env = config.env
    return ControlSuiteEnv(
        config.task,
        num_envs,
        from_pixels=env.from_pixels,
        image_size=env.image_size,
        seed=seed,
        episode_steps=episode_steps,
    )


def make_evaluator(
    config: RunConfig,
    directory: Path,
    learner: Evaluable,
    episodes: int,
    video_steps: int,
    start_noise: float = 0.0,
    **options: Any,
) -> Evaluator:
    """Make the evaluator for the run's environment; in a race, `options` go to `EvaluationReport`."""
    if is_race(config):
        worlds = {**shared_env_arguments(config), "start_noise": start_noise}
        return EvaluationReport(directory, learner, worlds, episodes, video_steps, **options)
    seed = config.seed + 1
    env = make_suite(config, min(8, episodes), seed)
    return ReturnReport(directory, learner, env, episodes, video_steps, seed)


WINDOWS, RECORDS = 32, 2_000
"""Held-out windows per measurement, and the newest records of a world that they are drawn from."""


def size_of(config: WorldModelRunConfig) -> ModelSize:
    """Return the networks' size, with `model.sampled` and `model.state_std` filled in."""
    return replace(get_size(config.model.size), sampled=config.model.sampled, state_std=config.model.state_std)


def make_agent(config: WorldModelRunConfig, interface: Interface) -> Agent:
    """Make the networks of a resolved configuration, with initial weights from torch's generator."""
    decodes = any(target.decodes for target in find_targets(config.loss.world_model))
    return Agent(size_of(config), interface, decodes, config.loss.min_std, config.loss.max_std).to(config.device)


def load_initial_weights(learner: WorldModelLearner, config: WorldModelRunConfig, env: Environment) -> str:
    """Load the weights that ``init_from`` names into a new learner; return a log line that describes them.

    Raises:
        FileNotFoundError: there is no such run, checkpoint or agent.
        ValueError: it has another model size, or was trained with another camera, control rate or loss; or its
            configuration is damaged.
    """
    source = str(config.init_from)
    folder = existing_agent_path("init_from", source)
    if not is_agent(folder):
        saved = read_yaml(RunDirectory.of(latest_checkpoint(folder)).config, DictConfig)
        for name in OBSERVATION_SETTINGS:
            there, here = OmegaConf.select(saved, name), OmegaConf.select(OmegaConf.structured(config), name)
            if there != here:
                raise ValueError(f"{name}={here}: init_from={source} was trained with {name}={there}; use the same.")
        state, metadata = load_state(folder, "learner")
        unmatched = learner.adopt(state)
        kind = "averaged" if "averaged" in state else "trained"
        line = f"weights: {kind}, of {folder} at {metadata['env_steps']:,} env_steps (init_from=), heads and critic too"
        if unmatched.initial:
            line += f"; not in that run, so untrained: {' and '.join(unmatched.initial)}"
        return line + (f"; not loaded: {' and '.join(unmatched.unused)}" if unmatched.unused else "")
    contract = read_contract(folder / CONTRACT)
    check_size(contract["model"], learner.size)
    if not isinstance(env, DroneRacingEnv):
        raise ValueError(f"init_from={source}: this agent was trained on races, and this run has none.")
    check_env(folder, contract, env)
    for agent in filter(None, (learner.agent, learner.averaged)):
        load_networks(folder, agent)
    return f"weights: encoder, RSSM and actor of {folder} (init_from=); heads and critic start untrained"


def make_learner(
    config: RunConfig, interface: Interface, device: torch.device | str, seed: int | None = None
) -> Learner:
    """Make the learner of a configuration, for training or for restoring a checkpoint.

    Args:
        config: resolved.
        interface: shapes of observations and actions.
        device: of the networks.
        seed: of the initial weights; None: the run's.
    """
    seed = config.seed if seed is None else seed
    if isinstance(config, WorldModelRunConfig):
        kind = LatentPPO if isinstance(config, LatentPPORunConfig) else DreamerV3
        return kind.make(size_of(config), interface, config.loss, config.model, device=device, seed=seed)
    if isinstance(config, PPORunConfig):
        return PPOLearner(NetworkSize(config.network.layers, config.network.units), interface, config.ppo, device, seed)
    if isinstance(config, SACRunConfig):
        return SACLearner(NetworkSize(config.network.layers, config.network.units), interface, config.sac, device, seed)
    raise NotImplementedError(f"make_learner() has no branch for {type(config).__name__}: add one.")


def measure(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, scheduled: Mapping[str, float]
) -> dict[str, Tensor | float]:
    """Return the current hyperparameters, and the world model's metrics on the newest held-out records."""
    groups = zip(("world_model", "behavior"), learner.optimizer.param_groups, strict=True)
    numbers: dict[str, Any] = {f"schedule/{name}": value for name, value in scheduled.items()}
    numbers |= {f"learning_rate/{name}": group["lr"] for name, group in groups}
    windows = replay.held_out(WINDOWS, OBSERVED + learner.config.imagination_horizon, RECORDS)
    if windows is None or not session.counters["updates"]:
        return numbers
    with session.undisturbed():
        return numbers | held_out_metrics(learner, windows)


def measure_lag(
    session: Session, config: WorldModelRunConfig, learner: WorldModelLearner, replay: StreamReplay, lag: ModelLag
) -> dict[str, Tensor | float]:
    """Measure the world model's error on the newest records, before it trains on them."""
    length = config.model.batch_length
    if config.replay.context:  # windows begin with stored latents: the newest rollout suffices
        length = min(length, config.rollout_steps)
    if (windows := replay.newest(length)) is None:
        return {}
    with session.undisturbed():
        return lag.add_fresh_error(parallel.averaged(world_model_metrics(learner, windows)))


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
    """Make the replay buffer, on the learner's device if it fits there; print its place and size.

    Args:
        config: resolved.
        env: environment whose records it stores.
        curriculum: recomputes old rewards, if `curriculum.relabel` is set.
        batch: windows per batch, and records per window.
        latents: format of the latents stored with the records; None: none are stored.
    """
    settings, interface, shown = config.replay, Interface.of(env), env.observation_spec.keys()
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers, latents)
    files = config.run_directory.replay if settings.storage is Storage.memmap else None
    device = settings.device if files is None else "cpu"
    if device == "auto":
        fits = config.device != "cpu" and size < 0.5 * available_memory(config.device)
        device = config.device if fits else "cpu"
    if files is not None:
        shutil.rmtree(files, ignore_errors=True)  # left by a run that was killed
    check_room(size, settings.capacity, device, files)
    if files is not None:
        files.mkdir(parents=True, exist_ok=True)
    where = f"memory of {device}" if files is None else f"files below {files}, until the process ends"
    print(f"replay: {settings.capacity:,} records, {size / 1e9:.1f} GB when full, in {where}")
    print(disk_needed(config, round(size * min(parallel.num_processes(), config.total_env_steps / settings.capacity))))
    windows = {}
    if isinstance(settings, SequenceReplayConfig):
        windows = {name: getattr(settings, name) for name in ("recent_share", "recent_records", "held_out")}
    return make_replay(
        settings.capacity,
        config.env.num_envs,
        *batch,
        config.device,
        storage_device=device,
        scratch_dir=files,
        seed=config.seed,
        transform=RelabelReward(curriculum) if curriculum.env is not None and config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
        # The curriculum recomputes rewards from these terms.
        reward_keys=["reward", *(name for name in ("reward_base", "body_rate_norm") if name in shown)],
        latents=latents,
        # Prefetched samples would lack the latents that the update before them stores.
        prefetch=2 if config.device != "cpu" and device == "cpu" and latents is None else None,
        **windows,
    )


def check_room(size: int, capacity: int, device: str, files: Path | None) -> None:
    """Refuse replays that do not all fit; each process has one of `size` bytes and `capacity` records."""
    asked = f"replay.capacity={capacity * parallel.num_processes():,}"
    if files is not None:
        check_space(size * parallel.num_processes(), files, asked)
    else:
        check_fits(size * parallel.num_local_processes() if device == "cpu" else size, device, asked)


def disk_needed(config: ReplayRunConfig, replay: int) -> str:
    """Return a line on the peak disk use of checkpoints with a replay of `replay` bytes, and on the free space."""
    directory = config.run_directory
    there = sum(file.stat().st_size for file in directory.checkpoints.rglob("*") if file.is_file())
    peak, free = (config.checkpoint.keep + 1) * replay, shutil.disk_usage(directory.path).free + there
    line = (
        f"disk: at most {peak / 1e9:.1f} GB for the replay in checkpoint.keep={config.checkpoint.keep} checkpoints and "
        f"the one being written, about a seventh of that for images of races; {free / 1e9:.1f} GB free"
    )
    advice = "lower checkpoint.keep= or replay.capacity=, or choose another run_dir=; else saving may fail"
    return f"{line}: MAY NOT BE ENOUGH, {advice}" if peak > free else line


def make_run_evaluator(config: RunConfig, directory: Path, learner: Learner) -> Evaluator:
    """Make the evaluator used during training; processes other than the first get one that does nothing."""
    if not parallel.is_first():
        return NoReport()
    asked = config.evaluation
    return make_evaluator(config, directory, learner, asked.episodes, asked.video_steps, asked.start_noise)


def make_tracker(config: RunConfig) -> EpisodeTracker:
    """Make the tracker of finished episodes in this process's worlds."""
    return EpisodeTracker(config.env.num_envs // parallel.num_processes(), CrashCause if is_race(config) else None)
