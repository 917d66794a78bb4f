"""Typed configuration of the recipes: hydra refuses a value of the wrong type, naming the field."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from dreamer_racing.envs.config import EnvConfig
from dreamer_racing.envs.race.curriculum import BodyRateSchedule
from dreamer_racing.experience.ray_cluster import WorkersConfig
from dreamer_racing.experience.replay import ReplayConfig, SequenceReplayConfig
from dreamer_racing.figures.loggers import LoggerConfig
from dreamer_racing.learners import PPOConfig, SACConfig
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses, LossConfig
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SEED, Range, setting
from dreamer_racing.training.journal import CheckpointConfig, EvaluationConfig
from dreamer_racing.training.replay_ratio import ReplayRatio
from dreamer_racing.training.schedule import DreamerV3ScheduleConfig, LatentPPOScheduleConfig, ScheduleConfig


@dataclass
class ModelConfig(LearnerConfig):
    """Size of the networks and the numbers that go with it: `auto` chooses by device, what is missing by size."""

    size: str = MISSING
    sampled: bool = True  # states are samples of their categoricals, as in DreamerV3; false: the probabilities
    state_std: bool = True  # the actions' deviation depends on the state, as in DreamerV3; false: one number each
    batch_size: int = setting(MISSING, COUNT)  # windows in a batch
    batch_length: int = setting(MISSING, Range(2))  # records in a window
    replay_ratio: float = setting(MISSING, POSITIVE)  # records trained on per environment step
    imagination_horizon: int = setting(MISSING, COUNT)
    # Those of an update that the size decides:
    imagination_starts: int | None = setting(MISSING, COUNT)
    learning_rate: float = setting(MISSING, POSITIVE)
    warmup_updates: int = setting(MISSING, NOT_NEGATIVE)


class CollectorKind(Enum):
    """Who flies to learn, and when."""

    local = "local"
    ray = "ray"


@dataclass
class RunConfig:
    """What all training recipes have in common."""

    algorithm: str = MISSING  # the recipe
    track: str = "kidney"  # name of a built-in track, or path to a YAML file
    # not to be given: what a track's file said when the run was begun, as JSON; the run and what comes of it fly that
    track_description: str | None = None
    decoys: str | None = None  # +decoys=paper: gates that are only drawn, on tracks that have a place for them
    task: str = "walker_walk"  # with env=dmc: domain_task of the Control Suite
    budget: str = "none"  # none | smoke | cpu | paper: how long a run is, and what goes with it
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


@dataclass
class ReplayRunConfig(RunConfig):
    """What training recipes with a replay have in common besides."""

    prefill: int = setting(MISSING, NOT_NEGATIVE)  # env_steps collected before the first update
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    def make_replay_ratio(self) -> ReplayRatio:
        """Make what says how much the run trains."""
        raise NotImplementedError(f"{type(self).__name__} must say how much its run trains.")


@dataclass
class WorldModelRunConfig(ReplayRunConfig):
    """What the recipes with a world model have in common."""

    # run, checkpoint or agent (docs/agents.md) whose weights a new run begins with, on whatever track and physics
    init_from: str | None = None
    # none: the algorithm as published; race: what races on a CPU; images: the same, but no network sees the simulator's
    # state in training; gpu: race for a GPU, unmeasured; suite: what learns the Control Suite on a CPU; auto: race or
    # suite from images on a CPU by cpu_small, else none
    tuned: str = "auto"
    prefill: int = setting(4_000, NOT_NEGATIVE)
    rollout_steps: int = setting(8, COUNT)
    # local: fly in turns with updates; ray: workers on a Ray cluster fly, also during updates
    collector: CollectorKind = CollectorKind.local
    num_workers: int | None = setting(None, COUNT)  # with collector=ray; null: 2
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    replay: SequenceReplayConfig = field(default_factory=SequenceReplayConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def make_replay_ratio(self) -> ReplayRatio:
        """Make what says how much the run trains."""
        model = self.model
        return ReplayRatio(model.replay_ratio, model.batch_size * model.batch_length, self.prefill)

    @property
    def scheduled(self) -> dict[str, Any]:
        """Whose settings the schedule moves, by their names."""
        return {"loss": self.loss, "env": self.env, "model": self.model}

    @property
    def weight_interval(self) -> int:
        """How many env_steps old the weights of workers are at most."""
        return self.workers.weight_interval or 2 * self.env.num_envs * self.rollout_steps


@dataclass
class DreamerV3RunConfig(WorldModelRunConfig):
    """`recipes/dreamer_v3.py`."""

    algorithm: str = "dreamer_v3"
    loss: DreamerV3Losses = field(default_factory=DreamerV3Losses)
    schedule: DreamerV3ScheduleConfig = field(default_factory=DreamerV3ScheduleConfig)


@dataclass
class LatentPPORunConfig(WorldModelRunConfig):
    """`recipes/latent_ppo.py`."""

    algorithm: str = "latent_ppo"
    loss: LatentPPOLosses = field(default_factory=LatentPPOLosses)
    schedule: LatentPPOScheduleConfig = field(default_factory=LatentPPOScheduleConfig)

    @property
    def scheduled(self) -> dict[str, Any]:
        """Whose settings the schedule moves, by their names."""
        return super().scheduled | {"loss.ppo": self.loss.ppo}


@dataclass
class NetworkConfig:
    """Hidden layers of the baselines' actor and critic: `auto` chooses by what they see."""

    size: str = MISSING  # auto | paper | small
    layers: int = setting(MISSING, NOT_NEGATIVE)
    units: int = setting(MISSING, COUNT)


@dataclass
class PPORunConfig(RunConfig):
    """`recipes/ppo.py`."""

    algorithm: str = "ppo"
    rollout_steps: int = setting(32, COUNT)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)


@dataclass
class SACRunConfig(ReplayRunConfig):
    """`recipes/sac.py`."""

    algorithm: str = "sac"
    prefill: int = setting(10_000, NOT_NEGATIVE)
    rollout_steps: int = setting(1, COUNT)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sac: SACConfig = field(default_factory=SACConfig)

    def make_replay_ratio(self) -> ReplayRatio:
        """Make what says how much the run trains."""
        return ReplayRatio(self.sac.replay_ratio, self.sac.batch_size, self.prefill)


RECIPES: dict[str, type[RunConfig]] = {
    schema.algorithm: schema for schema in (DreamerV3RunConfig, LatentPPORunConfig, PPORunConfig, SACRunConfig)
}
"""The training recipes by algorithm, which is the name of its file in recipes/ and in recipes/config/."""


def is_race(config: RunConfig) -> bool:
    """Return whether the run races drones, rather than being tested on the Control Suite."""
    return config.env.suite == "race"


store = ConfigStore.instance()
for _algorithm, _schema in RECIPES.items():
    store.store(name=f"{_algorithm}_schema", node=_schema)
for _group, _node in {
    "env": EnvConfig,
    "model": ModelConfig,
    "network": NetworkConfig,
    "curriculum": BodyRateSchedule,
    "logger": LoggerConfig,
}.items():
    store.store(group=_group, name="schema", node=_node)
