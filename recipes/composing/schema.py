"""Typed configuration of the recipes: hydra refuses a value of the wrong type, naming the field."""

import json
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig

from dreamer_racing import parallel
from dreamer_racing.devices import choose_device
from dreamer_racing.envs.config import EnvConfig
from dreamer_racing.envs.race.curriculum import BodyRateSchedule
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.tracks import Track, read_track, with_decoys
from dreamer_racing.experience.ray_cluster import WorkersConfig
from dreamer_racing.experience.replay import ReplayConfig, SequenceReplayConfig, Storage
from dreamer_racing.figures.loggers import LoggerConfig
from dreamer_racing.learners import PPOConfig, SACConfig
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses, LossConfig, find_objective
from dreamer_racing.modules import get_size
from dreamer_racing.modules.autoencoder import smallest_map
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SEED, Range, check_settings, setting
from dreamer_racing.training.checkpoint import CheckpointConfig
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.schedule import (
    DreamerV3ScheduleConfig,
    LatentPPOScheduleConfig,
    ReplayRatio,
    ScheduleConfig,
)
from dreamer_racing.training.session import EvaluationConfig


@dataclass
class ModelConfig(LearnerConfig):
    """Size of the networks and its numbers: `size=auto` chooses by device; missing numbers come from the size."""

    size: str = MISSING
    sampled: bool = True  # latent states are sampled, as in DreamerV3; false: they are the probabilities
    state_std: bool = True  # the actions' deviation depends on the state, as in DreamerV3; false: one number per action
    batch_size: int = setting(MISSING, COUNT)  # windows in a batch
    batch_length: int = setting(MISSING, Range(2))  # records in a window
    replay_ratio: float = setting(MISSING, POSITIVE)  # records trained on per environment step
    imagination_horizon: int = setting(MISSING, COUNT)
    imagination_starts: int | None = setting(MISSING, COUNT)
    learning_rate: float = setting(MISSING, POSITIVE)
    warmup_updates: int = setting(MISSING, NOT_NEGATIVE)


class CollectorKind(Enum):
    """What collects rollouts: this process between updates, or workers on a Ray cluster."""

    local = "local"
    ray = "ray"


@dataclass
class RunConfig:
    """Settings that all training recipes share."""

    algorithm: str = MISSING  # name of the recipe
    track: str = "kidney"  # name of a built-in track, or path to a YAML file
    # set by the recipe: a track file's contents as JSON when the run began, which the run and its evaluations use
    track_description: str | None = None
    decoys: str | None = None  # +decoys=paper: gates that are only drawn, on tracks that define places for them
    task: str = "walker_walk"  # with env=dmc: domain_task of the Control Suite
    budget: str = "none"  # none | smoke | cpu | paper: length of the run, and settings that depend on it
    total_env_steps: int = setting(1_000_000, COUNT)  # control steps summed over environments
    rollout_steps: int = setting(MISSING, COUNT)  # control steps of every environment between updates
    seed: int = setting(0, SEED)
    device: str = "auto"  # auto | cpu | cuda | cuda:1 ...
    run_dir: str | None = None  # null: runs/<algorithm>_<track>_<time>
    resume: str | None = None  # run directory or checkpoint to continue
    env: EnvConfig = field(default_factory=EnvConfig)
    curriculum: BodyRateSchedule = field(default_factory=BodyRateSchedule)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    many_processes: ClassVar[bool] = False  # whether torchrun may start several that train together

    @property
    def run_directory(self) -> RunDirectory:
        """The run's directory, once `resolve_common` has chosen it."""
        assert self.run_dir is not None, "resolve_common() sets it"
        return RunDirectory(Path(self.run_dir))

    def saved_track(self) -> Track:
        """Return the track; that of a file is as it was when the run began, even if the file has changed."""
        noted = self.track_description
        track = self.track if noted is None else read_track(json.loads(noted), f"track_description of {self.track}")
        return with_decoys(track, self.decoys)

    def check(self) -> None:
        """Refuse settings with which a resolved run could not work, by their names and with what would be right."""
        check_settings(self)
        self.logger.check()
        if parallel.asked_for() > 1 and not self.many_processes:
            raise ValueError(
                f"WORLD_SIZE={parallel.asked_for()}: algorithm={self.algorithm} trains in one process; only "
                "recipes/dreamer_v3.py and latent_ppo.py support torchrun. Start it without torchrun."
            )
        env, noise = self.env, self.evaluation.start_noise
        env.check()
        if not is_race(self):
            if noise:
                raise ValueError(
                    f"evaluation.start_noise={noise} is for races, and env.suite={env.suite}: leave it at 0."
                )
            return
        track = self.saved_track()
        env.check_race(track)
        try:
            StartSampler(track, start_noise=noise)
        except ValueError as error:
            raise ValueError(f"evaluation.{error}") from error
        schedule = getattr(self, "schedule", None)
        if schedule is None or schedule.start_on_line.to is None:  # else the share changes in the run
            env.check_shares()


@dataclass
class ReplayRunConfig(RunConfig):
    """Settings that training recipes with a replay buffer share."""

    prefill: int = setting(MISSING, NOT_NEGATIVE)  # env_steps collected before the first update
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    ratio_group: ClassVar[str] = "model"  # group of settings that has replay_ratio

    def make_replay_ratio(self) -> ReplayRatio:
        """Make the replay ratio, which counts the updates that are due."""
        raise NotImplementedError

    def check(self) -> None:
        """Check as `RunConfig.check`, and the replay's device; refuse settings with which there would be no update."""
        super().check()
        if self.replay.device != "auto" and self.replay.storage is Storage.memmap:
            raise ValueError(f"replay.device={self.replay.device} is for replay.storage=tensor: leave it out.")
        choose_device(self.replay.device, "replay.device")
        if self.total_env_steps <= self.prefill:
            raise ValueError(
                f"total_env_steps={self.total_env_steps} must be above prefill={self.prefill}, the steps before the "
                "first update: raise the one, or lower the other."
            )
        replay, steps = self.make_replay_ratio(), self.total_env_steps
        if not replay.updates(steps):
            raise ValueError(
                f"{self.ratio_group}.replay_ratio={replay.ratio} is too low: total_env_steps={steps:,} minus "
                f"prefill={self.prefill:,} gives less than one update of {replay.records} records. Raise "
                "total_env_steps or the ratio, or lower the prefill."
            )


@dataclass
class WorldModelRunConfig(ReplayRunConfig):
    """Settings that the recipes with a world model share."""

    # run, checkpoint or agent (docs/agents.md) whose weights a new run begins with; track and physics may differ
    init_from: str | None = None
    init_behavior: bool = True  # whether actor and critics begin with those weights, too; false: only the world model
    # none: the algorithm as published; race: for racing on a CPU; images: race, but no network sees the simulator's
    # state in training; gpu: race for a GPU, unmeasured; suite: for the Control Suite on a CPU; auto: race or suite,
    # but none with env.from_pixels=false, budget=smoke or paper, or another model than cpu_small
    tuned: str = "auto"
    prefill: int = setting(4_000, NOT_NEGATIVE)
    rollout_steps: int = setting(8, COUNT)
    # local: collection and updates alternate; ray: workers on a Ray cluster collect, also during updates
    collector: CollectorKind = CollectorKind.local
    num_workers: int | None = setting(None, COUNT)  # with collector=ray; null: 2
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    replay: SequenceReplayConfig = field(default_factory=SequenceReplayConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    many_processes: ClassVar[bool] = True

    def make_replay_ratio(self) -> ReplayRatio:
        """Make the replay ratio, which counts the updates that are due."""
        model = self.model
        return ReplayRatio(model.replay_ratio, model.batch_size * model.batch_length, self.prefill)

    @property
    def scheduled(self) -> dict[str, Any]:
        """Configurations whose settings the schedule changes, by their dotted names."""
        return {"loss": self.loss, "env": self.env, "model": self.model}

    @property
    def weight_interval(self) -> int:
        """Largest age of the workers' weights, in env_steps."""
        return self.workers.weight_interval or 2 * self.env.num_envs * self.rollout_steps

    def check(self) -> None:
        """Check as `ReplayRunConfig.check`, and refuse invalid schedules, networks and workers."""
        super().check()
        self.schedule.check(self.scheduled, self.env.suite)
        self.check_windows()
        self.check_collector()

    def check_windows(self) -> None:
        """Refuse image sizes that the CNN cannot divide, and windows longer than a world's prefill."""
        env, size = self.env, get_size(self.model.size)
        try:
            smallest_map(env.image_size, size.cnn_patch, len(size.cnn_multipliers))
        except ValueError as error:
            raise ValueError(f"env.{error}") from error
        if self.tuned == "images" and not env.from_pixels:
            raise ValueError(
                "tuned=images is for agents that see images, and env.from_pixels=false shows them the state: leave one "
                "out."
            )
        prefilled, length = self.prefill // env.num_envs, self.model.batch_length
        if prefilled < length:
            raise ValueError(
                f"prefill={self.prefill} gives each of env.num_envs={env.num_envs} worlds {prefilled} records, "
                f"and the first update needs windows of model.batch_length={length}: prefill must be at least "
                f"{env.num_envs * length}."
            )

    def check_collector(self) -> None:
        """Refuse worker settings without collector=ray, several learners with it, and unequal shares of the worlds."""
        workers, num_envs, asked = self.num_workers, self.env.num_envs, self.workers
        if self.collector is not CollectorKind.ray:
            if given := worker_settings(self):
                raise ValueError(f"{given[0]} is for collector=ray: add that, or leave it out.")
            return
        assert workers is not None, "resolve_workers() sets it"
        if parallel.asked_for() > 1:
            raise ValueError(
                f"WORLD_SIZE={parallel.asked_for()} with collector=ray: workers fly for a single learner. Start it "
                "without torchrun, or set collector=local."
            )
        if num_envs % workers:
            raise ValueError(
                f"env.num_envs={num_envs} worlds cannot be shared equally by num_workers={workers}: make it a "
                f"multiple, e.g. env.num_envs={-(-num_envs // workers) * workers}, or choose another number of workers."
            )
        asked.check(num_envs * self.rollout_steps)


@dataclass
class DreamerV3RunConfig(WorldModelRunConfig):
    """Configuration of `recipes/dreamer_v3.py`."""

    algorithm: str = "dreamer_v3"
    loss: DreamerV3Losses = field(default_factory=DreamerV3Losses)
    schedule: DreamerV3ScheduleConfig = field(default_factory=DreamerV3ScheduleConfig)

    def check(self) -> None:
        """Check as `WorldModelRunConfig.check`, and refuse objectives of collected steps and losses beyond a window."""
        super().check()
        find_objective(self.loss.actor, collected=False)
        steps, length = self.loss.open_loop_steps, self.model.batch_length
        if steps >= length:
            raise ValueError(
                f"loss.open_loop_steps={steps} must be less than the records of a window, model.batch_length={length}."
            )


@dataclass
class LatentPPORunConfig(WorldModelRunConfig):
    """Configuration of `recipes/latent_ppo.py`."""

    algorithm: str = "latent_ppo"
    loss: LatentPPOLosses = field(default_factory=LatentPPOLosses)
    schedule: LatentPPOScheduleConfig = field(default_factory=LatentPPOScheduleConfig)

    @property
    def scheduled(self) -> dict[str, Any]:
        """Configurations whose settings the schedule changes, by their dotted names."""
        return super().scheduled | {"loss.ppo": self.loss.ppo}

    @property
    def newest_records(self) -> int:
        """Records of each world on which the model's error decides whether the actor waits."""
        length = self.model.batch_length
        # Windows that begin with stored latents: the newest rollout suffices.
        return min(length, self.rollout_steps) if self.replay.context else length

    def check(self) -> None:
        """Check as `WorldModelRunConfig.check`, and refuse objectives of imagined steps."""
        super().check()
        find_objective(self.loss.actor, collected=True)


@dataclass
class NetworkConfig:
    """Hidden layers of the baselines' actor and critic: `size=auto` chooses by the observations."""

    size: str = MISSING  # auto | paper | small
    layers: int = setting(MISSING, NOT_NEGATIVE)
    units: int = setting(MISSING, COUNT)


@dataclass
class PPORunConfig(RunConfig):
    """Configuration of `recipes/ppo.py`."""

    algorithm: str = "ppo"
    rollout_steps: int = setting(32, COUNT)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)

    def check(self) -> None:
        """Check as `RunConfig.check`, and refuse more minibatches than a rollout has records."""
        super().check()
        self.ppo.check(self.env.num_envs, self.rollout_steps)


@dataclass
class SACRunConfig(ReplayRunConfig):
    """Configuration of `recipes/sac.py`."""

    algorithm: str = "sac"
    prefill: int = setting(10_000, NOT_NEGATIVE)
    rollout_steps: int = setting(1, COUNT)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sac: SACConfig = field(default_factory=SACConfig)

    ratio_group: ClassVar[str] = "sac"

    def make_replay_ratio(self) -> ReplayRatio:
        """Make the replay ratio, which counts the updates that are due."""
        return ReplayRatio(self.sac.replay_ratio, self.sac.batch_size, self.prefill)


RECIPES: dict[str, type[RunConfig]] = {
    schema.algorithm: schema for schema in (DreamerV3RunConfig, LatentPPORunConfig, PPORunConfig, SACRunConfig)
}
"""Configuration classes by algorithm, which is also the name of its file in recipes/ and recipes/config/."""


def worker_settings(config: WorldModelRunConfig | DictConfig) -> list[str]:
    """Return the settings of workers that differ from their defaults, as NAME=VALUE."""
    chosen = {name: (getattr(config.workers, name), default) for name, default in vars(WorkersConfig()).items()}
    given = [] if config.num_workers is None else [f"num_workers={config.num_workers}"]
    return given + [f"workers.{name}={value}" for name, (value, default) in chosen.items() if value != default]


def is_race(config: RunConfig) -> bool:
    """Return whether the run trains on drone races, rather than on the Control Suite."""
    return config.env.suite == "race"


store = ConfigStore.instance()
for _algorithm, _schema in RECIPES.items():
    store.store(name=f"{_algorithm}_schema", node=_schema)
_nodes = {"env": EnvConfig, "model": ModelConfig, "network": NetworkConfig, "logger": LoggerConfig}
for _group, _node in {**_nodes, "curriculum": BodyRateSchedule}.items():
    store.store(group=_group, name="schema", node=_node)
