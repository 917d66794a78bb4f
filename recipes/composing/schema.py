"""Typed configuration of the recipes: hydra refuses a value of the wrong type, naming the field."""

from dataclasses import dataclass, field, fields
from enum import Enum
from functools import cache

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from dreamer_racing.envs.drone.parameters import MIN_CONTROL_RATE
from dreamer_racing.envs.race.curriculum import BodyRateSchedule
from dreamer_racing.figures.plotting import PlotConfig
from dreamer_racing.learners import PPOConfig, SACConfig
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses, LossConfig
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Range, setting
from dreamer_racing.training.replay_ratio import ReplayRatio
from dreamer_racing.training.schedule import Ramp

SUITES = ("race", "dmc")


@dataclass
class EnvConfig:
    """Where the agent acts: the race, or a task of the DeepMind Control Suite to compare with published curves."""

    suite: str = "race"  # race | dmc
    preset: str = "easy"  # physics: easy | faithful | betaflight
    num_envs: int = setting(MISSING, COUNT)  # worlds flown side by side; missing: the recipe's own number
    control_rate: float = setting(50.0, Range(MIN_CONTROL_RATE))  # actions a second, Hz
    # frames a second, Hz, control_rate divided by a whole number; null: one at every control step
    camera_rate: float | None = setting(None, POSITIVE)
    # gyro and accelerometer, seen beside the images: none | exact | noisy
    imu: str = "none"
    # module:function of your own in place of Eq. 1 of the paper (docs/own_rewards.md); null: that
    reward: str | None = None
    # module:function of your own, whose numbers the agent sees, too (docs/own_rewards.md); null: none beside images
    vector: str | None = None
    # control steps of a training episode; null: those of 20 s, with env=dmc those of the task
    episode_steps: int | None = setting(None, COUNT)
    # share of training episodes, but for those on a line, that begin behind a gate, to practise turns
    start_beyond_gate: float = setting(0.0, SHARE)
    # share of those that begin neither there nor on a line, that begin in flight before a gate instead of at the start
    start_at_gate: float = setting(0.5, SHARE)
    # share of training episodes that begin in flight on a planned racing line
    start_on_line: float = setting(0.0, SHARE)
    # m; training episodes end where a gate is missed by less than this; 0: they go on
    miss_radius: float = setting(0.0, NOT_NEGATIVE)
    # b3, penalty in training for each unit of |a_t - a_t-1|^2; 0: none, as in the paper; 1e-4 in champion-level racing
    action_change_weight: float = setting(0.0, NOT_NEGATIVE)
    # of the worlds, to train and to be evaluated in: cpu | cuda | auto, which takes the learner's where it can
    device: str = "auto"
    renderer: str = "auto"  # auto | egl | osmesa | warp | warp_cuda; on cuda auto | warp
    looks: str = "nominal"  # in training: nominal | randomised (light, colours, camera tilt, lens, noise)
    from_pixels: bool = True  # false: the agent sees the numbers of `vector` instead of images
    image_size: int = 64  # pixels, side of the images: a multiple of 16, by which the networks divide it
    camera_tilt: float = 25.0  # degrees upwards


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


@dataclass
class CurriculumConfig(BodyRateSchedule):
    """Schedule of b₂, the weight of the body-rate penalty in paper Eq. 1."""

    relabel: bool = True  # recompute rewards of replayed steps with today's b₂


class Wandb(Enum):
    """Where what Weights & Biases gets goes."""

    none = "none"
    offline = "offline"
    online = "online"


@dataclass
class LoggerConfig:
    """Where metrics go besides metrics.csv."""

    tensorboard: bool = True
    wandb: Wandb = Wandb.none  # Weights & Biases; online alone sends anything
    project: str = "dreamer_racing"  # of W&B
    media: bool = True  # whether TensorBoard and W&B get plots and films of evaluations
    every: int = setting(2_000, NOT_NEGATIVE)  # env_steps between rows


class Storage(Enum):
    """Where replay records live."""

    tensor = "tensor"
    memmap = "memmap"


@dataclass
class ReplayConfig:
    """The replay buffer."""

    capacity: int = setting(250_000, COUNT)  # records, 12.3 KB each at image_size 64
    storage: Storage = Storage.tensor  # tensor (memory) | memmap (files)
    device: str = "auto"  # of storage=tensor: auto takes the learner's if it has room, else cpu


@dataclass
class SequenceReplayConfig(ReplayConfig):
    """The replay buffer of a world model."""

    # worlds whose records are never trained on, to measure the model; null: one where four or more fly, else none
    held_out: int | None = setting(None, NOT_NEGATIVE)
    recent_share: float = setting(0.0, SHARE)  # of a batch's windows, drawn from the newest records
    recent_records: int = setting(20_000, COUNT)  # how many those are
    # windows go on from stored latents, refreshed at each update, instead of from none; null: where the recipe shortens
    # windows, as it does for model=auto on CUDA
    context: bool | None = None


@dataclass
class EvaluationConfig:
    """Evaluation during training."""

    every: int = setting(25_000, NOT_NEGATIVE)  # env_steps; 0 never
    first: int = setting(0, NOT_NEGATIVE)  # env_steps at which there is one before that, to look at; 0 none
    episodes: int = setting(8, COUNT)
    stochastic: bool = False  # also fly the sampling policy
    # of starts, as a multiple of the noise of training; 0: all begin at the start pose
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    video_steps: int = setting(500, COUNT)  # control steps in the video


@dataclass
class CheckpointConfig:
    """Checkpoints during training."""

    every: int = setting(50_000, NOT_NEGATIVE)  # env_steps
    # of wall clock between two, for machines that are taken away; 0: by env_steps alone
    minutes: float = setting(0.0, NOT_NEGATIVE)
    keep: int = setting(2, COUNT)


@dataclass
class ScheduleConfig:
    """Settings that move over a run, each from its own value `to` another, by its length or by the gates passed.

    A ramp that has the name of a number of `LossConfig` moves that one.
    """

    learning_rates: Ramp = field(default_factory=Ramp)  # `to`: share of all learning rates that is left
    world_model_rate: Ramp = field(default_factory=Ramp)  # `to`: share of that share, of the world model's alone
    discount: Ramp = field(default_factory=Ramp)  # loss.discount
    entropy_scale: Ramp = field(default_factory=Ramp)  # loss.entropy_scale
    min_std: Ramp = field(default_factory=Ramp)  # loss.min_std
    max_std: Ramp = field(default_factory=Ramp)  # loss.max_std
    start_on_line: Ramp = field(default_factory=Ramp)  # env.start_on_line


@dataclass
class DreamerV3ScheduleConfig(ScheduleConfig):
    """And of what is imagined."""

    imagination_horizon: Ramp = field(default_factory=Ramp)  # model.imagination_horizon, rounded


@dataclass
class LatentPPOScheduleConfig(ScheduleConfig):
    """And of an actor that learns from what was collected."""

    kl_target: Ramp = field(default_factory=Ramp)  # loss.ppo.kl_target
    # the actor waits while the model's error on the newest records is so many times that in training
    wait_for_model: float | None = None
    wait_every: int = setting(5_000, COUNT)  # env_steps between two measurements of those errors


LOSS_RAMPS = tuple(sorted({ramp.name for ramp in fields(ScheduleConfig)} & {loss.name for loss in fields(LossConfig)}))
"""What of `ScheduleConfig` moves a number of the losses."""


class CollectorKind(Enum):
    """Who flies to learn, and when."""

    local = "local"
    overlapped = "overlapped"
    ray = "ray"


@dataclass
class WorkersConfig:
    """Workers on a Ray cluster, with `collector=ray`."""

    # local: a cluster started on this machine, for this run | auto: one that runs here | host:port of one
    address: str = "local"
    cpus: float = setting(1.0, POSITIVE)  # cores of each, may be a part of one; as many threads draw and step worlds
    gpus: float = setting(0.0, NOT_NEGATIVE)  # of each, a part of one or whole ones; its policy and worlds live there
    # env_steps that weights are old at most when what was flown with them is learned from; null: two rounds, the least
    weight_interval: int | None = setting(None, COUNT)
    patience: float = setting(600.0, POSITIVE)  # s to wait for a round, before the run is saved and ends


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
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
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
    # local: fly in turns with updates; overlapped: in a thread during them, with the weights before them; ray: workers
    # on a Ray cluster fly, also during updates
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


@dataclass
class ExperimentConfig(RunConfig):
    """`recipes/experiment.py`: one run of an experiment; hydra's multirun makes all of them.

    What all recipes have in common is set as with them: `track=`, `seed=`, `budget=`, `env.from_pixels=` ...
    """

    name: str = MISSING  # of the experiment
    algorithm: str = "dreamer_v3"  # of a training recipe: its file's name
    variant: str = "default"  # one of the following
    variants: dict[str, list[str]] = field(default_factory=dict)  # overrides of the algorithm's recipe by name
    overrides: list[str] = field(default_factory=list)  # of every run, e.g. "overrides=['loss.entropy_scale=1e-4']"
    directory: str = "runs"


@dataclass
class EvaluateConfig:
    """`recipes/evaluate.py`."""

    checkpoint: str = MISSING  # run directory, checkpoint, or agent (docs/agents.md)
    weights: str = "auto"  # auto | averaged | trained: which to fly; auto takes the averaged where they are kept
    protocol: str = "nominal"  # nominal | full: every condition of docs/evaluation.md, with both presets
    # with protocol=nominal: of starts, as a multiple of the noise of training
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    episodes: int = setting(100, COUNT)  # of each condition
    # flown side by side; null: every episode has a world of its own, so that every policy meets the same races
    num_envs: int | None = setting(None, COUNT)
    track: str | None = None  # null: the track it was trained on
    decoys: str | None = None  # +decoys=paper | none; null: as it was trained
    preset: str | None = None  # null: the physics it was trained on
    run_dir: str | None = None  # null: <run of the checkpoint>/evaluation
    video_steps: int = setting(500, COUNT)
    device: str = "auto"
    renderer: str = "auto"
    seed: int = setting(1, SEED)  # of starts and drones: others than those of evaluations in training, whose seed is 0


@dataclass
class PerceptionConfig:
    """`recipes/perception.py`."""

    checkpoint: str = MISSING  # run directory, checkpoint, or agent (docs/agents.md)
    weights: str = "auto"  # auto | averaged | trained: which to fly; auto takes the averaged where they are kept
    episodes: int = setting(100, COUNT)  # of each kind of flight
    num_envs: int | None = setting(None, COUNT)  # as of `recipes/evaluate.py`; the first flight in each is looked at
    track: str | None = None  # null: the track it was trained on
    decoys: str | None = None  # +decoys=paper; null: those that the track has a place for, if any
    preset: str | None = None  # null: the physics it was trained on
    run_dir: str | None = None  # null: <run of the checkpoint>/perception
    device: str = "auto"
    renderer: str = "auto"
    seed: int = setting(0, SEED)


@dataclass
class ExportConfig:
    """`recipes/export.py`."""

    checkpoint: str = MISSING  # run directory, checkpoint, or agent (docs/agents.md)
    weights: str = "auto"  # auto | averaged | trained: which to export; auto takes the averaged where they are kept
    output: str | None = None  # .onnx file, in a folder of its own; null: <run of the checkpoint>/export/actor.onnx
    agent: str | None = None  # folder of an agent that is to ship, instead of output, e.g. agents/kidney
    evaluation: str | None = None  # with agent=: its numbers; null: the run's latest of these weights
    commit: str | None = None  # with agent=: that it was trained at; null: the one that the run noted
    latent: str = "mode"  # mode (argmax of the posterior) | sample (takes noise)
    parts: bool = (
        False  # write the step in two parts, too: what needs no image can then be done before it (docs/export.md)
    )
    steps: int = setting(200, COUNT)  # of a recorded flight, over which the export must fly as the original does
    renderer: str = "auto"
    seed: int = setting(0, SEED)


def is_race(config: RunConfig) -> bool:
    """Whether the run races drones, rather than being tested on the Control Suite.

    Raises:
        ValueError: unknown suite.
    """
    if config.env.suite not in SUITES:
        raise ValueError(f"env.suite={config.env.suite}: there are {', '.join(SUITES)}.")
    return config.env.suite == "race"


@cache
def register() -> None:
    """Make the schemas known to hydra, which keeps them."""
    store = ConfigStore.instance()
    for algorithm, schema in RECIPES.items():
        store.store(name=f"{algorithm}_schema", node=schema)
    store.store(name="experiment_schema", node=ExperimentConfig)
    store.store(name="evaluate_schema", node=EvaluateConfig)
    store.store(name="perception_schema", node=PerceptionConfig)
    store.store(name="export_schema", node=ExportConfig)
    store.store(name="plot_schema", node=PlotConfig)
    for group, node in (
        ("env", EnvConfig),
        ("model", ModelConfig),
        ("network", NetworkConfig),
        ("curriculum", CurriculumConfig),
        ("logger", LoggerConfig),
    ):
        store.store(group=group, name="schema", node=node)
