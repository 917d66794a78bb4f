"""What the recipe refuses before anything is built: settings with which a run could not work.

Each of these functions raises a ValueError, whose message names the setting as the user writes it, its value, and what
would be right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from composing.building import track_as_begun
from composing.entry import override_key
from composing.schema import (
    CollectorKind,
    DreamerV3RunConfig,
    PPORunConfig,
    ReplayRunConfig,
    RunConfig,
    SACRunConfig,
    WorldModelRunConfig,
    is_race,
)
from dreamer_racing import parallel
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.experience.ray_cluster import WorkersConfig
from dreamer_racing.experience.ray_rollouts import check_interval
from dreamer_racing.experience.replay import Storage
from dreamer_racing.losses import Barlow, Image, State, Target, find_objective, find_targets
from dreamer_racing.modules import get_size
from dreamer_racing.modules.encoder import smallest_map
from dreamer_racing.settings import check_settings


def check_overrides(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a task without `env=dmc`, and a track or decoys with it: one of them would be ignored."""
    given, suite = {override_key(override) for override in overrides}, config.env.suite
    if suite == "race" and "task" in given:
        raise ValueError(f"task={config.task} is for the Control Suite: add env=dmc, or leave it out to race.")
    if suite != "race" and config.decoys:
        raise ValueError(f"decoys={config.decoys} are for races, and env.suite={suite}: leave them out.")
    if "track_description" in given:
        raise ValueError("track_description= is what a run notes of its track's file: give that, track=my_track.yaml.")
    if suite != "race" and "track" in given:
        raise ValueError(f"track={config.track} is for races, and env.suite={suite}: leave one of them out.")


def check_read(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse settings that nothing reads as losses and replay are chosen; one's own losses may read all.

    Args:
        config: composed.
        overrides: as they were written; what files of a group set goes with other choices of theirs.
    """
    targets = find_targets(config.loss.world_model)

    def have(reader: type[Target]) -> bool:
        return any(issubclass(kind, reader) or not kind.__module__.startswith("dreamer_racing.") for kind in targets)

    images = have(Image) and config.env.from_pixels
    waits = config.algorithm != "latent_ppo" or config.schedule.wait_for_model is not None
    drift = config.loss.drift_scale == 0 or (config.replay.context and not config.model.sampled)
    given = {override_key(override) for override in overrides}
    for name, read, reader in (
        ("loss.image_scale", images, "loss=reconstruction or informed, from images"),
        ("loss.image_share", images, "loss=reconstruction or informed, from images"),
        ("loss.privileged_scale", have(State), "loss=privileged or informed"),
        ("loss.barlow_scale", have(Barlow), "loss=decoder_free"),
        ("model.imagination_starts", config.algorithm == "dreamer_v3", "recipes/dreamer_v3.py, which imagines"),
        ("loss.drift_scale", drift, "records that keep latents, replay.context=true, as they are, model.sampled=false"),
        ("replay.recent_records", config.replay.recent_share > 0, "replay.recent_share above 0"),
        ("replay.device", config.replay.storage is Storage.tensor, "replay.storage=tensor"),
        ("schedule.wait_every", waits, "schedule.wait_for_model"),
    ):
        if name in given and not read and (value := OmegaConf.select(config, name)) is not None:
            raise ValueError(f"{name}={value} is for {reader}, which is not chosen: choose that, or leave {name}= out.")


def check(config: RunConfig) -> None:
    """Refuse settings with which a run of a recipe could not work.

    Args:
        config: resolved.
    """
    check_settings(config)
    config.logger.check()
    if parallel.asked_for() > 1 and not isinstance(config, WorldModelRunConfig):
        raise ValueError(
            f"WORLD_SIZE={parallel.asked_for()}: algorithm={config.algorithm} trains in one process, and of those that "
            "torchrun starts only recipes/dreamer_v3.py and latent_ppo.py makes use: start it without torchrun."
        )
    check_worlds(config)
    if isinstance(config, ReplayRunConfig):
        check_replay(config)
    if isinstance(config, WorldModelRunConfig):
        config.schedule.check(config.scheduled, config.env.suite)
        actor = config.loss.actor  # type: ignore[attr-defined]  # of both algorithms, with another default
        find_objective(actor, collected=config.algorithm == "latent_ppo")
        check_world_model(config)
        check_collector(config)
    records = config.env.num_envs * config.rollout_steps
    if isinstance(config, PPORunConfig) and config.ppo.minibatches > records:
        raise ValueError(
            f"ppo.minibatches={config.ppo.minibatches} are more than the {records} records of a rollout, env.num_envs="
            f"{config.env.num_envs} times rollout_steps={config.rollout_steps}: lower the one, or raise the others."
        )


def check_worlds(config: RunConfig) -> None:
    """Refuse worlds that cannot be, races that leave each other no room to start, and noise of starts elsewhere."""
    env, noise, track = config.env, config.evaluation.start_noise, track_as_begun(config) if is_race(config) else None
    env.check()
    if track is None:
        if noise:
            raise ValueError(f"evaluation.start_noise={noise} is for races, and env.suite={env.suite}: leave it at 0.")
        return
    env.check_race(track)
    try:
        StartSampler(track, start_noise=noise)
    except ValueError as error:
        raise ValueError(f"evaluation.{error}") from error
    moves = isinstance(config, WorldModelRunConfig) and config.schedule.start_on_line.to is not None
    if env.start_on_line == 1 and env.start_beyond_gate and not moves:
        raise ValueError(
            f"env.start_beyond_gate={env.start_beyond_gate:g} is a share of the episodes that do not begin on a "
            "line, and env.start_on_line=1 leaves none of them: lower that, or leave the other out."
        )


def check_replay(config: ReplayRunConfig) -> None:
    """Refuse settings with which there would be no update."""
    if config.total_env_steps <= config.prefill:
        raise ValueError(
            f"total_env_steps={config.total_env_steps} must be above prefill={config.prefill}, the steps before the "
            "first update: raise the one, or lower the other."
        )
    replay, group = config.make_replay_ratio(), "sac" if isinstance(config, SACRunConfig) else "model"
    if not replay.updates(config.total_env_steps):
        raise ValueError(
            f"{group}.replay_ratio={replay.ratio} cannot be met: total_env_steps={config.total_env_steps:,} less "
            f"prefill={config.prefill:,} asks for no whole update of {replay.records} records. "
            "Raise total_env_steps or the ratio, or lower the prefill."
        )


def check_world_model(config: WorldModelRunConfig) -> None:
    """Refuse images that networks of that size cannot halve, and windows longer than what is collected before them."""
    env, size = config.env, get_size(config.model.size)
    try:
        smallest_map(env.image_size, size.cnn_patch, len(size.cnn_multipliers))
    except ValueError as error:
        raise ValueError(f"env.{error}") from error
    if config.tuned == "images" and not env.from_pixels:
        raise ValueError(
            "tuned=images is for agents that see images, and env.from_pixels=false shows them the state: leave one out."
        )
    prefilled, length = config.prefill // env.num_envs, config.model.batch_length
    if prefilled < length:
        raise ValueError(
            f"prefill={config.prefill} gives each of env.num_envs={env.num_envs} worlds {prefilled} records, "
            f"and the first update needs windows of model.batch_length={length}: prefill must be at least "
            f"{env.num_envs * length}."
        )
    if isinstance(config, DreamerV3RunConfig) and (steps := config.loss.open_loop_steps) >= length:
        raise ValueError(
            f"loss.open_loop_steps={steps} must be less than the records of a window, model.batch_length={length}."
        )


def check_collector(config: WorldModelRunConfig) -> None:
    """Refuse workers beside other ways to collect, and worlds or weights that cannot be shared out among them."""
    workers, num_envs, asked = config.num_workers, config.env.num_envs, config.workers
    if config.collector is not CollectorKind.ray:
        default = vars(WorkersConfig())
        given = [] if workers is None else [f"num_workers={workers}"]
        given += [f"workers.{name}={value}" for name, value in vars(asked).items() if value != default[name]]
        if given:
            raise ValueError(f"{given[0]} is for collector=ray: add that, or leave it out.")
        return
    assert workers is not None, "resolve_workers() says how many"
    if parallel.asked_for() > 1:
        raise ValueError(
            f"WORLD_SIZE={parallel.asked_for()} with collector=ray: workers fly for a single learner. Start it without "
            "torchrun, or set collector=local."
        )
    if num_envs % workers:
        raise ValueError(
            f"env.num_envs={num_envs} worlds cannot be shared equally by num_workers={workers}: make it a multiple, "
            f"e.g. env.num_envs={-(-num_envs // workers) * workers}, or choose another number of workers."
        )
    if asked.gpus > 1 and asked.gpus % 1:
        raise ValueError(
            f"workers.gpus={asked.gpus:g}: Ray gives a worker a part of one GPU or whole ones, e.g. "
            f"workers.gpus={math.floor(asked.gpus)}."
        )
    check_interval(config.weight_interval, num_envs * config.rollout_steps)
