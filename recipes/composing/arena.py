"""Where a run acts: the environment that its configuration names, and what comes with it."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from composing.schema import RECIPES, DreamerConfig, PPORunConfig, RunConfig, SACRunConfig, is_race
from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import with_decoys
from dreamer_racing.export.shipped_agent import AVERAGED, ShippedAgent, choose_weights, kept_weights
from dreamer_racing.figures.report import EvaluationReport, ReturnReport
from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.dreamer import DreamerLearner, make_dreamer
from dreamer_racing.learners.learner import Flyer, Learner
from dreamer_racing.losses import WORLD_MODEL_LOSSES, find_loss
from dreamer_racing.modules import Interface, get_size
from dreamer_racing.training.checkpoint import load_components, load_state
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.pass_share import PassShare
from dreamer_racing.training.run import Report
from dreamer_racing.training.schedule import Clock

Environment = DroneRacingEnv | ControlSuiteEnv


def scene_name(config: RunConfig) -> str:
    """The track or the task."""
    return config.track if is_race(config) else config.task


def camera_of(config: RunConfig) -> Camera:
    """The nose camera."""
    side = config.env.image_size
    return Camera(width=side, height=side, tilt=config.env.camera_tilt)


def worlds_of(config: RunConfig) -> dict[str, Any]:
    """Arguments of every `DroneRacingEnv` of the run."""
    env = config.env
    return {
        "track": with_decoys(config.track, config.decoys) if config.decoys else config.track,
        "preset": env.preset,
        "renderer": env.renderer,
        "camera": camera_of(config),
        "control_rate": env.control_rate,
    }


def make_env(config: RunConfig, num_envs: int | None = None) -> Environment:
    """Make the environment to train in, with `env.num_envs` worlds or another number."""
    env = config.env
    num_envs = num_envs or env.num_envs
    loss = config.loss.world_model if isinstance(config, DreamerConfig) else None
    reads_privileged = loss is not None and find_loss(WORLD_MODEL_LOSSES, loss).reads_privileged
    if is_race(config):
        return DroneRacingEnv(
            num_envs=num_envs,
            episode_steps=env.episode_steps,
            from_pixels=env.from_pixels,
            privileged=reads_privileged,
            start_beyond_gate=env.start_beyond_gate,
            start_on_line=env.start_on_line,
            start_before_crash=env.start_before_crash,
            miss_radius=env.miss_radius,
            device=env.device,
            looks=env.looks,
            seed=config.seed,
            **worlds_of(config),
        )
    if reads_privileged:
        raise ValueError(
            f"loss.world_model={loss} decodes the race's privileged state, which env=dmc does not "
            "have: choose another loss, e.g. loss=reconstruction."
        )
    return make_suite(config, num_envs, config.seed)


def make_suite(config: RunConfig, num_envs: int, seed: int) -> ControlSuiteEnv:
    """Make worlds of the Control Suite, to train in or to evaluate."""
    env = config.env
    return ControlSuiteEnv(config.task, num_envs, from_pixels=env.from_pixels, image_size=env.image_size, seed=seed)


def make_report(
    config: RunConfig,
    directory: Path,
    learner: Flyer,
    episodes: int,
    video_steps: int,
    start_noise: float = 0.0,
    **options: Any,
) -> Report:
    """Make the evaluation that fits the environment; options are those of `EvaluationReport`."""
    if is_race(config):
        worlds = {**worlds_of(config), "from_pixels": config.env.from_pixels, "start_noise": start_noise}
        if start_noise:  # a world's second start would depend on how its first went
            options["num_envs"] = episodes
            print(f"evaluation: {episodes} worlds, one for each episode, so that every agent meets the same starts")
        return EvaluationReport(directory, learner, worlds, episodes, video_steps, **options)
    env = make_suite(config, min(8, episodes), config.seed + 1)
    return ReturnReport(directory, learner, env, episodes, video_steps)


def crash_causes(config: RunConfig) -> type[CrashCause] | None:
    """How episodes may end badly, for the metrics."""
    return CrashCause if is_race(config) else None


def reward_terms(env: Environment) -> list[str]:
    """What a replay keeps of rewards: `reward`, and the terms of which the curriculum recomputes it."""
    present = env.observation_spec.keys()
    return ["reward", *(name for name in ("reward_base", "body_rate_norm") if name in present)]


def clock_times(config: DreamerConfig, env_steps: int, passes: PassShare) -> dict[Clock, float]:
    """What the clocks of schedules say after so many env_steps of a run."""
    return {Clock.run: env_steps / config.total_env_steps, Clock.passes: passes.best}


def scheduled(config: DreamerConfig, times: dict[Clock, float]) -> dict[str, float]:
    """Arguments of `DreamerLearner.adjust` at what the clocks say."""
    schedule, loss = config.schedule, config.loss
    now = {
        "rates": (schedule.learning_rates, 1.0),
        "discount": (schedule.discount, loss.discount),
        "entropy_scale": (schedule.entropy_scale, loss.entropy_scale),
        "min_std": (schedule.min_std, loss.min_std),
    }
    return {name: ramp.at(value, times[ramp.by]) for name, (ramp, value) in now.items()}


def make_learner(config: RunConfig, interface: Interface, device: torch.device | str) -> Learner:
    """Make the learner of a recipe's configuration."""
    if isinstance(config, DreamerConfig):
        shape = replace(get_size(config.model.size), sampled=config.model.sampled)
        horizon = config.model.imagination_horizon
        return make_dreamer(
            shape, interface, config.loss, config.model, horizon=horizon, device=device, seed=config.seed
        )
    assert isinstance(config, (PPORunConfig, SACRunConfig))
    size = NetworkSize(config.network.layers, config.network.units)
    if isinstance(config, SACRunConfig):
        return SACLearner(size, interface, config.sac, device, config.seed)
    return PPOLearner(size, interface, config.ppo, device, config.seed)


def trained_config(run_dir: Path) -> RunConfig:
    """Read back the configuration that a run was trained with.

    Raises:
        ValueError: by an unknown algorithm.
    """
    saved = cast(DictConfig, OmegaConf.load(RunDirectory(run_dir).config))
    algorithm = saved.get("algorithm", DreamerConfig.algorithm)
    if algorithm not in RECIPES:
        raise ValueError(f"{RunDirectory(run_dir).config}: algorithm={algorithm}; there are {', '.join(RECIPES)}.")
    return cast(RunConfig, OmegaConf.to_object(with_schema(saved, algorithm)))


def with_schema(saved: DictConfig, algorithm: str) -> DictConfig:
    """Type a saved configuration: what it does not say is at its default, what is unknown here is left out."""
    schema = OmegaConf.structured(RECIPES[algorithm])
    if unknown := drop_unknown(saved, schema):
        print(f"settings of another version, left out: {', '.join(unknown)}")
    return cast(DictConfig, OmegaConf.merge(schema, saved))


def is_known(name: str, schema: DictConfig) -> bool:
    """Whether a schema has a setting or a group of this dotted name."""
    first, _, rest = name.partition(".")
    if first not in set(schema.keys()):
        return False
    inner = schema._get_node(first)
    return not rest or (isinstance(inner, DictConfig) and is_known(rest, inner))


def drop_unknown(saved: DictConfig, schema: DictConfig, prefix: str = "") -> list[str]:
    """Remove from a saved configuration what a schema does not have; return `name=value` of each."""
    unknown = [name for name in map(str, saved) if name not in set(schema.keys())]  # `in` overlooks what is missing
    dropped = [f"{prefix}{name}={saved.pop(name)}" for name in unknown]
    for name in map(str, saved):
        inner, known = saved[name], schema._get_node(name)
        if isinstance(inner, DictConfig) and isinstance(known, DictConfig):
            dropped += drop_unknown(inner, known, f"{prefix}{name}.")
    return dropped


def restore_learner(
    config: RunConfig, checkpoint: Path, device: torch.device, weights: str = "auto"
) -> tuple[Learner, dict[str, int]]:
    """Bring back the learner of a checkpoint of a run, and the run's counters.

    Raises:
        ValueError: the checkpoint does not have the weights asked for.
    """
    config.env.device = "cpu"  # wherever it was trained
    chosen = choose_weights(weights, kept_weights(load_state(checkpoint, "learner")[0]), checkpoint)
    if isinstance(config, DreamerConfig):
        config.model.compile = config.model.cuda_graph = False
        config.model.average_rate = (config.model.average_rate or 1.0) if chosen == AVERAGED else None
    env = _probe(config)
    interface = Interface.of(env)
    env.close()
    learner = make_learner(config, interface, device)
    counters: dict[str, int] = {}
    passes = PassShare()
    parts = {"learner": learner, "counters": counters, "passes": passes}
    load_components(checkpoint, parts, map_location=device, may_lack=("passes",))
    if isinstance(learner, DreamerLearner):
        config = cast(DreamerConfig, config)
        learner.adjust(**scheduled(config, clock_times(config, counters["env_steps"], passes)))
    return learner, counters


def restore_shipped(config: RunConfig, folder: Path, device: torch.device) -> ShippedAgent:
    """Bring back an agent that ships, for the environment of its configuration.

    Raises:
        FileNotFoundError: a file of it is missing.
        ValueError: it was trained in an environment of another camera or control rate.
    """
    config.env.device = "cpu"
    env = _probe(config)
    try:
        return ShippedAgent.load(folder, cast(DroneRacingEnv, env), device)
    finally:
        env.close()


def _probe(config: RunConfig) -> Environment:
    """Make a single world, to look at what an agent sees in it."""
    return make_env(replace(config, env=replace(config.env, start_on_line=0.0)), num_envs=1)  # a line takes seconds
