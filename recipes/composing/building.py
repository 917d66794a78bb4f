"""The parts of a training run: what the configuration leaves open, then one part after the other, then the run."""

import math
import random
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.collectors import Collector

from composing.arena import (
    Environment,
    crash_causes,
    describe_file,
    make_report,
    reward_terms,
    scene_name,
    worlds_device,
)
from composing.checks import refuse_to_replace
from composing.command_line import CONFIG_DIR, new_run_dir
from composing.devices import choose_device
from composing.saved import flat_settings, saved_config
from composing.schema import DreamerConfig, ReplayRunConfig, RunConfig, Storage, is_race
from dreamer_racing import parallel
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.race.race import EPISODE_TIME
from dreamer_racing.envs.tracks import TrackError
from dreamer_racing.experience.collector_state import CollectorState
from dreamer_racing.experience.replay import StreamReplay, make_replay, replay_bytes
from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.figures.loggers import RunLogger, make_loggers
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.learners.learner import Learner, Policy
from dreamer_racing.learners.saved_dreamer import LossState
from dreamer_racing.machine import (
    available_memory,
    check_fits,
    check_space,
    git_commit,
)
from dreamer_racing.modules import Interface
from dreamer_racing.modules.stored_latents import LatentFormat
from dreamer_racing.training.checkpoint import BestCheckpoint, RunCheckpoints
from dreamer_racing.training.clock import RunClock
from dreamer_racing.training.directory import RunDirectory, replace_text
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import LockHeldByFirst, NoReport, UnwrittenMetrics
from dreamer_racing.training.journal import Journal, Schedule
from dreamer_racing.training.lock import RunLock
from dreamer_racing.training.metrics import MetricsLog, PendingMetrics
from dreamer_racing.training.replay_ratio import UpdatesOwed
from dreamer_racing.training.run import Report, Run

R = TypeVar("R", bound=Run)
OF_EACH_PROCESS = ("env", "tracker", "collector", "replay", "actor_loss")
"""Parts of a run that each of several processes has of its own; `actor_loss` keeps what its worlds flew."""


OF_WORLDS = ("env", "collector")
"""Parts that a run does not have where workers fly; where it goes on without them, its worlds begin anew."""


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


@contextmanager
def claimed(config: RunConfig) -> Iterator[RunLock | LockHeldByFirst]:
    """Take a run directory before anything large is made; of several processes the first one does.

    The run keeps it after the block; if the block fails, the next one gets it, and a folder that was made for it goes.

    Raises:
        ValueError: it holds another run, or is in use by a live one.
    """
    assert config.run_dir is not None, "resolve_common() names it"
    directory = Path(config.run_dir)
    lock = RunDirectory(directory).claim() if parallel.is_first() else LockHeldByFirst(directory)
    try:
        if parallel.is_first():
            refuse_to_replace(config)
        yield lock
    except BaseException:
        lock.abandon()
        raise


def write_configuration(directory: RunDirectory, config: RunConfig, overrides: Sequence[str], env_steps: int) -> None:
    """Keep what a run is started with, beside it and beside its best checkpoint."""
    for place in (directory, directory.best):
        replace_text(place.config, OmegaConf.to_yaml(OmegaConf.structured(config)))
    kept = [override for override in overrides if not override.startswith("resume=")]
    replace_text(directory.overrides, OmegaConf.to_yaml(OmegaConf.create(kept)))
    directory.note_start(env_steps, kept, git_commit(Path(__file__).parent))


def make_run_report(config: RunConfig, directory: Path, learner: Learner) -> Report:
    """Make the evaluation of a run during training, if this is the process that makes it."""
    if not parallel.is_first():
        return NoReport()
    asked = config.evaluation
    return make_report(config, directory, learner, asked.episodes, asked.video_steps, asked.start_noise)


def make_run_loggers(config: RunConfig, directory: RunDirectory, resumed: int | None) -> list[RunLogger]:
    """Make the loggers of a run, resumed behind its row at so many env_steps, and give them its configuration."""
    asked = config.logger
    loggers = make_loggers(directory.path, asked.tensorboard, asked.wandb.value, asked.project, resumed)
    plain = OmegaConf.create(OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True))
    for sink in loggers:
        sink.log_configuration(flat_settings(cast(DictConfig, plain)), OmegaConf.to_yaml(plain))
    return loggers


def make_metrics(config: RunConfig, directory: RunDirectory, pending: PendingMetrics) -> MetricsLog | UnwrittenMetrics:
    """Make the metrics of a run, which go on from what is pending, if this is the process that writes them."""
    if not parallel.is_first():
        return UnwrittenMetrics()
    resumed = pending.written if config.resume else None
    return MetricsLog(directory.path, make_run_loggers(config, directory, resumed), resumed, pending)


def tell_how_far(env: Environment, curriculum: BodyRateCurriculum | None, rollouts: Rollouts, env_steps: int) -> None:
    """Tell the worlds of a resumed run how far it is: they may have begun anew."""
    if curriculum:
        env.body_rate_weight = curriculum.body_rate_weight
    rollouts.begin_at(env_steps)


def go_on_owing(owed: UpdatesOwed | None, config: RunConfig, env_steps: int) -> None:
    """Let a resumed run owe updates from here on by its replay ratio, and say so if that is another than before."""
    if owed is None:
        return
    trained = OmegaConf.to_object(saved_config(config.algorithm, Path(str(config.run_dir))))
    if owed.go_on(env_steps, cast(ReplayRunConfig, trained).replay_ratio):
        ratio = owed.ratio
        print(f"updates: from here on by {ratio.setting}={ratio.ratio:g}, {ratio.records} records each")


def assemble(
    kind: type[R],
    config: RunConfig,
    overrides: list[str],
    lock: RunLock | LockHeldByFirst,
    env: Environment,
    learner: Learner,
    collector: Collector,
    curriculum: BodyRateCurriculum | None,
    rollouts: Rollouts | None = None,
    **own: Any,
) -> R:
    """Put a run together in its directory, restored from a checkpoint if it continues one.

    Args:
        kind: the recipe's class of runs.
        config: resolved.
        overrides: from which it was composed.
        lock: of its directory.
        env: to train in.
        learner: what learns.
        collector: what flies.
        curriculum: of rewards, if there is one.
        rollouts: what it flies; None for one rollout after the other.
        own: further fields of ``kind``; a ``replay`` is saved with the run.
    """
    directory, rollouts = RunDirectory(lock.directory), rollouts or Rollouts(collector)
    tracker = EpisodeTracker(config.env.num_envs // parallel.count(), crash_causes(config))
    counters = {"env_steps": 0, "updates": 0, "episodes": 0}
    parts = {"learner": learner, "counters": counters, "env": env, "tracker": tracker}
    parts |= {"collector": CollectorState(collector)} | ({"curriculum": curriculum} if curriculum else {})
    parts |= {name: own[name] for name in ("replay", "owed", "lag", "passes") if name in own}
    if not rollouts.has_worlds:
        del parts["env"], parts["collector"]
    if not parallel.is_first() and isinstance(learner, DreamerLearner):
        parts["actor_loss"] = LossState(learner.losses["actor"], learner.agent)
    periods = {"log": config.logger.every, "evaluate": config.evaluation.every, "save": config.checkpoint.every}
    parts["journal"] = journal = Journal(Schedule(**periods), PendingMetrics())
    checkpoints = RunCheckpoints(directory.path, parts, config.checkpoint.keep, OF_EACH_PROCESS)
    clock = RunClock(counters, alone=parallel.count() == 1)
    if config.resume:
        clock.total = checkpoints.load(config.resume, may_lack=("owed", "lag", "passes", "journal", *OF_WORLDS))
        print(f"resumed {config.resume} at {counters['env_steps']:,} env_steps, {counters['updates']:,} updates")
        tell_how_far(env, curriculum, rollouts, counters["env_steps"])
        go_on_owing(own.get("owed"), config, counters["env_steps"])
        if not journal.restored:
            journal.begin_at(counters["env_steps"])
            print("its checkpoint is of an older version, without averages: the next row of metrics.csv begins here")
    flown: dict[str, Any] = {name: parts[name] for name in ("learner", "counters", "passes") if name in parts}
    best = BestCheckpoint(directory.path, flown, counters["env_steps"])
    parallel.together(lambda: None)  # all have read what is written anew now
    if parallel.is_first():
        directory.set_aside_after(counters["env_steps"])
        write_configuration(directory, config, overrides, counters["env_steps"])
    print(f"run directory: {directory.path}")
    return kind(
        config=config,
        directory=directory,
        env=env,
        collector=collector,
        rollouts=rollouts,
        tracker=tracker,
        curriculum=curriculum,
        learner=learner,
        report=make_run_report(config, directory.path, learner),
        metrics=make_metrics(config, directory, journal.pending),
        schedule=journal.schedule,
        checkpoints=checkpoints,
        best=best,
        counters=counters,
        clock=clock,
        lock=lock,
        **own,
    )
