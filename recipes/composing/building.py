"""The parts of a training run: what the configuration leaves open, then one part after the other, then the run."""

import math
import random
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from composing.arena import (
    Environment,
    crash_causes,
    describe_file,
    make_evaluator,
    reward_terms,
    scene_name,
    worlds_device,
)
from composing.checks import refuse_to_replace
from composing.command_line import new_run_dir
from composing.options import CONFIG_DIR
from composing.saved import flat_settings
from composing.schema import DreamerConfig, ReplayRunConfig, RunConfig, Storage, is_race
from dreamer_racing import parallel
from dreamer_racing.devices import choose_device
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.race.race import EPISODE_TIME
from dreamer_racing.envs.tracks import TrackError
from dreamer_racing.experience.replay import StreamReplay, make_replay, replay_bytes
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
from dreamer_racing.training.directory import RunDirectory, replace_text
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import LockHeldByFirst, NoReport
from dreamer_racing.training.session import Evaluator, Session


def resolve_common(config: DictConfig, num_envs: int) -> torch.device:
    """Fill in what every recipe leaves open, and say what was chosen; return the learner's device."""
    device = choose_device(config.device)
    if config.device == "auto":
        print(f"device: {device} (device=auto)")
    config.device = str(device)
    if OmegaConf.is_missing(config.env, "num_envs"):
        config.env.num_envs = num_envs
    if not math.isfinite(config.env.control_rate):
        raise ValueError(f"env.control_rate={config.env.control_rate} Hz: must be a finite number.")
    if config.env.episode_steps is None and config.env.suite == "race":
        config.env.episode_steps = round(EPISODE_TIME * config.env.control_rate)
    if config.env.device == "auto":
        config.env.device = worlds_device(device, config.env)
        if device.type != "cpu":
            print(f"worlds: {config.env.device} (env.device=auto, env.renderer={config.env.renderer})")
    if config.env.suite == "race":
        note_track(config)
    if config.run_dir is None:
        config.run_dir = parallel.agreed(str(new_run_dir(config.algorithm, scene_name(cast(RunConfig, config)))))
    return device


def note_track(config: DictConfig) -> None:
    """Note what a track's file says, or where a run that goes on has noted it, say whether that has changed since."""
    if config.track_description is None:
        found: list[str | None] = []
        parallel.together(lambda: found.append(describe_file(config.track)))
        config.track_description = parallel.agreed(found[0])
        return
    with suppress(TrackError):  # it is gone, or none any more
        if describe_file(config.track) != config.track_description:
            print(f"track: as {config.track} was when the run was begun, which it no longer is")


def resolve_baseline(config: DictConfig, num_envs: Mapping[str, int]) -> DictConfig:
    """Fill in what a baseline leaves open, by what it sees (``pixels`` or ``state``), and say what was chosen.

    Args:
        config: of the recipe.
        num_envs: worlds flown side by side, of either.
    """
    resolve_common(config, num_envs["pixels" if config.env.from_pixels else "state"])
    if config.network.size == "auto":
        sees = "images" if config.env.from_pixels else "numbers"
        config.network.size = "paper" if config.env.from_pixels and config.budget != "smoke" else "small"
        print(f"network: {config.network.size} (network=auto, seeing {sees}, budget={config.budget})")
    numbers = cast(DictConfig, OmegaConf.load(CONFIG_DIR / "network" / f"{config.network.size}.yaml"))
    for name in ("layers", "units"):
        if OmegaConf.is_missing(config.network, name):
            config.network[name] = numbers[name]
    return config


def seed_generators(seed: int) -> None:
    """Seed all global generators, of which torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what libraries draw from
    torch.manual_seed(seed)


def make_curriculum(config: RunConfig) -> BodyRateCurriculum | None:
    """Make the schedule of the race's body-rate penalty; other suites have none."""
    return BodyRateCurriculum(config.curriculum) if is_race(config) else None


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
    curriculum: BodyRateCurriculum | None,
    batch_size: int,
    batch_length: int,
    latents: LatentFormat | None = None,
    **windows: Any,
) -> StreamReplay:
    """Make the replay, on the learner's device if it has room there; say where and how large.

    Args:
        config: resolved.
        env: whose records it is to hold.
        curriculum: by which old rewards are relabelled, if they are.
        batch_size: windows in a batch.
        batch_length: records in a window.
        latents: how they are kept with the records, if they are.
        windows: further arguments of `make_replay` on which windows are drawn.
    """
    settings, interface = config.replay, Interface.of(env)
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers, latents)
    assert config.run_dir is not None, "resolve_common() names it"
    files = RunDirectory(Path(config.run_dir)).replay if settings.storage is Storage.memmap else None
    storage_device = settings.device if files is None else "cpu"
    if storage_device == "auto":
        on_learner = config.device != "cpu" and size < 0.5 * available_memory(config.device)
        storage_device = config.device if on_learner else "cpu"
    if files is not None:
        shutil.rmtree(files, ignore_errors=True)  # of a run that was killed
    check_room(size, settings.capacity, storage_device, files)
    if files is not None:
        files.mkdir(parents=True, exist_ok=True)
    where = f"memory of {storage_device}" if files is None else f"files below {files}, until the process ends"
    print(f"replay: {settings.capacity:,} records, {size / 1e9:.1f} GB when full, in {where}")
    print(disk_needed(config, round(size * min(parallel.count(), config.total_env_steps / settings.capacity))))
    return make_replay(
        settings.capacity,
        config.env.num_envs,
        batch_size,
        batch_length,
        config.device,
        storage_device=storage_device,
        scratch_dir=files,
        seed=config.seed,
        transform=RelabelReward(curriculum) if curriculum and config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
        reward_keys=reward_terms(env),
        latents=latents,
        # Samples drawn ahead would not have the latents that the update before them leaves.
        prefetch=2 if config.device != "cpu" and storage_device == "cpu" and latents is None else None,
        **windows,
    )


def check_room(size: int, capacity: int, device: str, files: Path | None) -> None:
    """Refuse replays of so many bytes and records, of which each process has one, if they do not fit together.

    Args:
        size: bytes of one.
        capacity: its records.
        device: whose memory it is kept in.
        files: the folder in which it is kept instead, or None.

    Raises:
        ValueError: the message gives what is needed, what there is, and what to change.
    """
    asked = f"replay.capacity={capacity * parallel.count():,}"
    if files is not None:
        check_space(size * parallel.count(), files, asked)
    else:
        check_fits(size * parallel.count_here() if device == "cpu" else size, device, asked)


def disk_needed(config: ReplayRunConfig, replay: int) -> str:
    """Say what checkpoints with a replay of so many bytes take at their peak, and what there is for them."""
    assert config.run_dir is not None, "resolve_common() names it"
    directory = RunDirectory(Path(config.run_dir))
    there = sum(file.stat().st_size for file in directory.checkpoints.rglob("*") if file.is_file())
    peak, free = (config.checkpoint.keep + 1) * replay, shutil.disk_usage(directory.path).free + there
    line = (
        f"disk: at most {peak / 1e9:.1f} GB of replay in checkpoint.keep={config.checkpoint.keep} checkpoints and the "
        f"one that is being written, a seventh of that if images compress as a race's do; {free / 1e9:.1f} GB free"
    )
    advice = "lower checkpoint.keep= or replay.capacity=, or choose another run_dir=; a run goes on without saving"
    return f"{line}: MAY NOT BE ENOUGH, {advice}" if peak > free else line


def make_sequence_replay(
    config: DreamerConfig, env: Environment, curriculum: BodyRateCurriculum | None, latents: LatentFormat | None
) -> StreamReplay:
    """Make the replay of a world model, with the latents beside its records if they are kept."""
    asked = config.replay
    assert asked.held_out is not None, "resolve() says"
    return make_run_replay(
        config,
        env,
        curriculum,
        config.model.batch_size,
        config.model.batch_length,
        latents=latents,
        recent_share=asked.recent_share,
        recent_records=asked.recent_records,
        held_out=asked.held_out,
    )


def write_configuration(directory: RunDirectory, config: RunConfig, overrides: Sequence[str], env_steps: int) -> None:
    """Keep what a run is started with, beside it and beside its best checkpoint."""
    for place in (directory, directory.best):
        replace_text(place.config, OmegaConf.to_yaml(OmegaConf.structured(config)))
    kept = [override for override in overrides if not override.startswith("resume=")]
    replace_text(directory.overrides, OmegaConf.to_yaml(OmegaConf.create(kept)))
    directory.note_start(env_steps, kept, git_commit(Path(__file__).parent))


def make_run_evaluator(config: RunConfig, directory: Path, learner: Learner) -> Evaluator:
    """Make the evaluation of a run during training, if this is the process that makes it."""
    if not parallel.is_first():
        return NoReport()
    asked = config.evaluation
    return make_evaluator(config, directory, learner, asked.episodes, asked.video_steps, asked.start_noise)


def make_tracker(config: RunConfig) -> EpisodeTracker:
    """Make what finds the finished episodes of this process's worlds."""
    return EpisodeTracker(config.env.num_envs // parallel.count(), crash_causes(config))


def adapt_rewards(
    env: Environment, curriculum: BodyRateCurriculum | None, episodes: TensorDictBase
) -> dict[str, float]:
    """Let the curriculum, if there is one, set the body-rate penalty of what comes; return metrics."""
    if curriculum is None:
        return {}
    env.body_rate_weight = curriculum.update(episodes["return"])
    return {"curriculum/body_rate_weight": env.body_rate_weight}


def make_run_loggers(config: RunConfig, directory: RunDirectory, resumed: int | None) -> list[RunLogger]:
    """Make the loggers of a run, resumed behind its row at so many env_steps, and give them its configuration."""
    asked = config.logger
    loggers = make_loggers(directory.path, asked.tensorboard, asked.wandb.value, asked.project, resumed)
    plain = OmegaConf.create(OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True))
    for sink in loggers:
        sink.log_configuration(flat_settings(cast(DictConfig, plain)), OmegaConf.to_yaml(plain))
    return loggers


def open_session(config: RunConfig, overrides: Sequence[str]) -> Session:
    """Take a run directory, before anything large is made, for a session in it.

    Raises:
        ValueError: it holds another run, or is in use by a live one.
    """
    assert config.run_dir is not None, "resolve_common() names it"
    directory = RunDirectory(Path(config.run_dir))
    lock = directory.claim() if parallel.is_first() else LockHeldByFirst(directory.path)
    try:
        if parallel.is_first():
            refuse_to_replace(config)
    except BaseException:
        lock.abandon()
        raise
    return Session(
        config,
        lock,
        lambda env_steps: write_configuration(directory, config, overrides, env_steps),
        lambda resumed: make_run_loggers(config, directory, resumed),
    )
