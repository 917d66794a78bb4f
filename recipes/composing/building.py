"""The parts of a training run: what the configuration leaves open, then one part after the other, then the run."""

import random
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.collectors import Collector

from composing.arena import Environment, make_evaluator
from composing.checks import check
from composing.saved import settings_of
from composing.schema import ReplayRunConfig, RunConfig, is_race
from dreamer_racing import parallel
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.experience.replay import SequenceReplayConfig, Storage, StreamReplay, make_replay, replay_bytes
from dreamer_racing.figures.loggers import RunLogger, make_loggers
from dreamer_racing.learners.learner import Learner, Policy
from dreamer_racing.machine import (
    available_memory,
    check_fits,
    check_space,
    git_commit,
)
from dreamer_racing.modules import Interface
from dreamer_racing.modules.stored_latents import LatentFormat
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint, replace_text
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import LockHeldByFirst, NoReport
from dreamer_racing.training.session import Evaluator, Session


def seed_generators(seed: int) -> None:
    """Seed all global generators, of which torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what libraries draw from
    torch.manual_seed(seed)


def num_gates(env: Environment) -> int:
    """Return how many gates the track has; 0 where there is no race."""
    return env.track.num_gates if isinstance(env, DroneRacingEnv) else 0


def make_curriculum(config: RunConfig, env: Environment) -> BodyRateCurriculum:
    """Make what moves the body-rate penalty of a race's rewards; elsewhere it moves nothing."""
    return BodyRateCurriculum(config.curriculum, env if is_race(config) else None)


def make_collector(config: RunConfig, env: Environment, policy: Policy) -> Collector:
    """Make the collector of rollouts [num_envs, rollout_steps], on the worlds' device.

    Worlds on a CPU have to wait for the actions of a policy on a CUDA device; beside it, all is in order by itself.
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
    """Make the replay, on the learner's device if it has room there; say where and how large.

    Args:
        config: resolved.
        env: whose records it is to hold.
        curriculum: by which old rewards are relabelled, if they are.
        batch: windows in a batch, and records in a window.
        latents: how they are kept with the records, if they are.
    """
    settings, interface, shown = config.replay, Interface.of(env), env.observation_spec.keys()
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers, latents)
    files = run_directory(config).replay if settings.storage is Storage.memmap else None
    device = settings.device if files is None else "cpu"
    if device == "auto":
        fits = config.device != "cpu" and size < 0.5 * available_memory(config.device)
        device = config.device if fits else "cpu"
    if files is not None:
        shutil.rmtree(files, ignore_errors=True)  # of a run that was killed
    check_room(size, settings.capacity, device, files)
    if files is not None:
        files.mkdir(parents=True, exist_ok=True)
    where = f"memory of {device}" if files is None else f"files below {files}, until the process ends"
    print(f"replay: {settings.capacity:,} records, {size / 1e9:.1f} GB when full, in {where}")
    print(disk_needed(config, round(size * min(parallel.count(), config.total_env_steps / settings.capacity))))
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
        # The terms are those of which the curriculum recomputes rewards.
        reward_keys=["reward", *(name for name in ("reward_base", "body_rate_norm") if name in shown)],
        latents=latents,
        # Samples drawn ahead would not have the latents that the update before them leaves.
        prefetch=2 if config.device != "cpu" and device == "cpu" and latents is None else None,
        **windows,
    )


def check_room(size: int, capacity: int, device: str, files: Path | None) -> None:
    """Refuse replays that do not fit together; each process has one, of so many bytes and records."""
    asked = f"replay.capacity={capacity * parallel.count():,}"
    if files is not None:
        check_space(size * parallel.count(), files, asked)
    else:
        check_fits(size * parallel.count_here() if device == "cpu" else size, device, asked)


def disk_needed(config: ReplayRunConfig, replay: int) -> str:
    """Say what checkpoints with a replay of so many bytes take at their peak, and what there is for them."""
    directory = run_directory(config)
    there = sum(file.stat().st_size for file in directory.checkpoints.rglob("*") if file.is_file())
    peak, free = (config.checkpoint.keep + 1) * replay, shutil.disk_usage(directory.path).free + there
    line = (
        f"disk: at most {peak / 1e9:.1f} GB of replay in checkpoint.keep={config.checkpoint.keep} checkpoints and the "
        f"one that is being written, a seventh of that if images compress as a race's do; {free / 1e9:.1f} GB free"
    )
    advice = "lower checkpoint.keep= or replay.capacity=, or choose another run_dir=; a run goes on without saving"
    return f"{line}: MAY NOT BE ENOUGH, {advice}" if peak > free else line


def write_configuration(directory: RunDirectory, config: RunConfig, overrides: Sequence[str], env_steps: int) -> None:
    """Keep what a run is started with, beside it and beside its best checkpoint."""
    for place in (directory, directory.best):
        replace_text(place.config, OmegaConf.to_yaml(OmegaConf.structured(config)))
    kept = [override for override in overrides if not override.startswith("resume=")]
    replace_text(directory.overrides, OmegaConf.to_yaml(OmegaConf.create(kept)))
    directory.note_start(env_steps, kept, git_commit(Path(__file__).parent))


def run_directory(config: RunConfig) -> RunDirectory:
    """Return that of a resolved configuration."""
    assert config.run_dir is not None, "resolve_common() names it"
    return RunDirectory(Path(config.run_dir))


def make_run_evaluator(config: RunConfig, directory: Path, learner: Learner) -> Evaluator:
    """Make the evaluation of a run during training, if this is the process that makes it."""
    if not parallel.is_first():
        return NoReport()
    asked = config.evaluation
    return make_evaluator(config, directory, learner, asked.episodes, asked.video_steps, asked.start_noise)


def make_tracker(config: RunConfig) -> EpisodeTracker:
    """Make what finds the finished episodes of this process's worlds."""
    return EpisodeTracker(config.env.num_envs // parallel.count(), CrashCause if is_race(config) else None)


def make_run_loggers(config: RunConfig, directory: RunDirectory, resumed: int | None) -> list[RunLogger]:
    """Make the loggers of a run, resumed behind its row at so many env_steps, and give them its configuration."""
    loggers = make_loggers(directory.path, config.logger, resumed)
    plain = cast(DictConfig, OmegaConf.create(OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True)))
    for sink in loggers:
        sink.log_configuration(settings_of(plain), OmegaConf.to_yaml(plain))
    return loggers


def open_session(config: RunConfig, overrides: Sequence[str]) -> Session:
    """Take a run directory for a session in it, if the run can work at all.

    Raises:
        ValueError: it cannot; or the directory holds another run, or is in use by a live one.
    """
    check(config)
    directory = run_directory(config)
    lock = directory.claim() if parallel.is_first() else LockHeldByFirst(directory.path)
    if parallel.is_first() and not config.resume:
        with suppress(FileNotFoundError):
            newest = latest_checkpoint(directory.checkpoints)
            lock.abandon()
            raise ValueError(
                f"run_dir={config.run_dir} holds a run already, with {newest.name}: continue it with "
                f"resume={config.run_dir}, or choose another run_dir."
            )
    return Session(
        config,
        lock,
        lambda env_steps: write_configuration(directory, config, overrides, env_steps),
        lambda resumed: make_run_loggers(config, directory, resumed),
    )
