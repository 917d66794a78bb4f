"""The parts of a training run: what the configuration leaves open, then one part after the other, then the run."""

import random
import shutil
from collections.abc import Sequence
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
    make_evaluator,
    reward_terms,
)
from composing.checks import refuse_to_replace
from composing.saved import flat_settings
from composing.schema import ReplayRunConfig, RunConfig, Storage, WorldModelRunConfig, is_race
from dreamer_racing import parallel
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, RelabelReward
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


def seed_generators(seed: int) -> None:
    """Seed all global generators, of which torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what libraries draw from
    torch.manual_seed(seed)


class Rewards:
    """Moves the body-rate penalty of a race's rewards by a curriculum; elsewhere there is none.

    Args:
        config: of the run.
        env: whose rewards they are.
    """

    def __init__(self, config: RunConfig, env: Environment) -> None:
        self.curriculum = BodyRateCurriculum(config.curriculum) if is_race(config) else None
        self._env = env

    def adapt(self, episodes: TensorDictBase) -> dict[str, float]:
        """Set the penalty of what comes, by finished episodes ``[E]``; return metrics."""
        if self.curriculum is None:
            return {}
        self._env.body_rate_weight = self.curriculum.update(episodes["return"])
        return {"curriculum/body_rate_weight": self._env.body_rate_weight}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {} if self.curriculum is None else self.curriculum.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, also in worlds that begin anew."""
        if self.curriculum is not None:
            self.curriculum.load_state_dict(state_dict)
            self._env.body_rate_weight = self.curriculum.body_rate_weight


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
    rewards: Rewards,
    batch_size: int,
    batch_length: int,
    latents: LatentFormat | None = None,
    **windows: Any,
) -> StreamReplay:
    """Make the replay, on the learner's device if it has room there; say where and how large.

    Args:
        config: resolved.
        env: whose records it is to hold.
        rewards: by whose curriculum old rewards are relabelled, if they are.
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
        transform=RelabelReward(rewards.curriculum) if rewards.curriculum and config.curriculum.relabel else None,
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
    config: WorldModelRunConfig, env: Environment, rewards: Rewards, latents: LatentFormat | None
) -> StreamReplay:
    """Make the replay of a world model, with the latents beside its records if they are kept."""
    asked = config.replay
    assert asked.held_out is not None, "resolve() says"
    return make_run_replay(
        config,
        env,
        rewards,
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
