"""What the recipe refuses before anything is built: settings with which a run could not work.

Every message names the setting as the user writes it, its value, and what would be right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from composing.arena import imu_of, track_as_begun
from composing.command_line import override_key
from composing.schema import (
    LOSS_RAMPS,
    RECIPES,
    CollectorKind,
    DreamerV3RunConfig,
    ExperimentConfig,
    LatentPPORunConfig,
    PPORunConfig,
    ReplayRunConfig,
    RunConfig,
    SACRunConfig,
    Storage,
    WorkersConfig,
    WorldModelRunConfig,
    is_race,
)
from dreamer_racing import parallel
from dreamer_racing.envs.drone.parameters import at_control_rate, load_preset
from dreamer_racing.envs.imu import load_imu
from dreamer_racing.envs.race.gates import GateSweeper
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.simulator.scene import Camera, frame_interval
from dreamer_racing.envs.worlds import ACTION_SIZE, RaceWorlds
from dreamer_racing.experience.ray_rollouts import check_interval
from dreamer_racing.figures.loggers import check_loggers
from dreamer_racing.learners.ppo_update import KL_TOLERANCE
from dreamer_racing.losses import (
    Barlow,
    Image,
    PPOUpdateConfig,
    State,
    Target,
    find_objective,
    find_targets,
)
from dreamer_racing.modules import get_size
from dreamer_racing.modules.encoder import smallest_map
from dreamer_racing.settings import POSITIVE, allowed_values, check_settings
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.schedule import RampClock

RACE_ONLY = (
    "env.control_rate",
    "env.camera_rate",
    "env.imu",
    "env.reward",
    "env.vector",
    "env.start_beyond_gate",
    "env.start_at_gate",
    "env.start_on_line",
    "env.miss_radius",
    "env.action_change_weight",
    "env.preset",
    "env.camera_tilt",
    "env.renderer",
    "evaluation.start_noise",
)
"""Settings that other suites have no use for, and that must be left at their defaults."""


def check_overrides(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a task without `env=dmc`, and a track or decoys with it: one of them would be ignored.

    Raises:
        ValueError: the message says what to add or leave out.
    """
    given = {override_key(override) for override in overrides}
    race = config.env.suite == "race"
    if race and "task" in given:
        raise ValueError(f"task={config.task} is for the Control Suite: add env=dmc, or leave it out to race.")
    if not race and config.decoys:
        raise ValueError(f"decoys={config.decoys} are for races, and env.suite={config.env.suite}: leave them out.")
    if "track_description" in given:
        raise ValueError("track_description= is what a run notes of its track's file: give that, track=my_track.yaml.")
    if not race and "track" in given:
        raise ValueError(f"track={config.track} is for races, and env.suite={config.env.suite}: leave one of them out.")


def check_read(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse settings that nothing reads as losses and replay are chosen; one's own losses may read all.

    Args:
        config: composed.
        overrides: as they were written; what files of a group set goes with other choices of theirs.

    Raises:
        ValueError: the message names the setting, and what it is for.
    """
    targets = find_targets(config.loss.world_model)
    images = _have(targets, Image) and config.env.from_pixels
    waits = config.algorithm != "latent_ppo" or config.schedule.wait_for_model is not None
    imagines = config.algorithm == "dreamer_v3"
    drift = config.loss.drift_scale == 0 or (config.replay.context and not config.model.sampled)
    names = [name for override in overrides if "." in (name := override_key(override))]  # no choice of a group
    given = [leaf for name in names for leaf in _leaves(config, name)]
    for name, reads, reader in (
        ("loss.image_scale", images, "loss=reconstruction or informed, from images"),
        ("loss.image_share", images, "loss=reconstruction or informed, from images"),
        ("loss.privileged_scale", _have(targets, State), "loss=privileged or informed"),
        ("loss.barlow_scale", _have(targets, Barlow), "loss=decoder_free"),
        ("model.imagination_starts", imagines, "recipes/dreamer_v3.py, which imagines"),
        ("loss.drift_scale", drift, "records that keep latents, replay.context=true, as they are, model.sampled=false"),
        ("replay.recent_records", config.replay.recent_share > 0, "replay.recent_share above 0"),
        ("replay.device", config.replay.storage is Storage.tensor, "replay.storage=tensor"),
        ("schedule.wait_every", waits, "schedule.wait_for_model"),
    ):
        for leaf in given:
            if not reads and (leaf == name or leaf.startswith(f"{name}.")):
                raise ValueError(
                    f"{leaf}={OmegaConf.select(config, leaf)} is for {reader}, which is not chosen: choose that, or "
                    f"leave {leaf}= out."
                )


def _have(targets: Sequence[type[Target]], reading: type[Target]) -> bool:
    """Whether a target is among those that read a setting, or may be, as one of a user's own."""
    return any(issubclass(kind, reading) or not kind.__module__.startswith("dreamer_racing.") for kind in targets)


def _leaves(config: DictConfig, name: str) -> list[str]:
    """Return the dotted names of the settings below a name that are given anything."""
    if (value := OmegaConf.select(config, name)) is None:
        return []
    if not isinstance(value, DictConfig):
        return [name]
    return [leaf for key in value for leaf in _leaves(config, name + "." + str(key))]


def refuse_to_replace(config: RunConfig) -> None:
    """Refuse to begin a run where another has left checkpoints.

    Raises:
        ValueError: the message names the newest of them.
    """
    if config.resume:
        return
    assert config.run_dir is not None
    try:
        newest = latest_checkpoint(RunDirectory(Path(config.run_dir)).checkpoints)
    except FileNotFoundError:
        return
    raise ValueError(
        f"run_dir={config.run_dir} holds a run already, with {newest.name}: continue it with resume={config.run_dir}, "
        "or choose another run_dir."
    )


def check(config: RunConfig) -> None:
    """Refuse settings that no recipe could run with.

    Raises:
        ValueError: the message gives the numbers and the setting to change.
    """
    check_settings(config)
    check_loggers(config.logger.wandb.value)
    if parallel.asked_for() > 1 and not isinstance(config, WorldModelRunConfig):
        raise ValueError(
            f"WORLD_SIZE={parallel.asked_for()}: algorithm={config.algorithm} trains in one process, and of those that "
            "torchrun starts only recipes/dreamer_v3.py and latent_ppo.py makes use: start it without torchrun."
        )
    on_cuda = config.env.device.partition(":")[0] == "cuda"
    if not on_cuda and config.env.device != "cpu":
        raise ValueError(f"env.device={config.env.device}: worlds live on cpu, cuda or cuda:1 ..., or auto.")
    if on_cuda and not is_race(config):
        raise ValueError(f"env.device={config.env.device} is for races: env.suite={config.env.suite} runs on cpu.")
    if config.env.looks != "nominal" and not (is_race(config) and config.env.from_pixels):
        raise ValueError(f"env.looks={config.env.looks} is for races seen in images: leave it at nominal.")
    if config.env.camera_rate is not None and is_race(config) and not config.env.from_pixels:
        raise ValueError(
            f"env.camera_rate={config.env.camera_rate:g} is of images: leave it out of a run from numbers."
        )
    if is_race(config):
        check_race(config)
        return
    values, defaults = OmegaConf.structured(config), OmegaConf.structured(RunConfig)
    for name in RACE_ONLY:
        if (value := OmegaConf.select(values, name)) != (default := OmegaConf.select(defaults, name)):
            raise ValueError(f"{name}={value} is for races, and env.suite={config.env.suite}: leave it at {default}.")


def check_race(config: RunConfig) -> None:
    """Refuse a control rate that the physics cannot step, and starts and misses that cannot be.

    Raises:
        ValueError: the message names the setting.
    """
    track = track_as_begun(config)
    for group, check_it in (
        ("env", lambda: at_control_rate(load_preset(config.env.preset), config.env.control_rate)),
        ("env", lambda: frame_interval(Camera(rate=config.env.camera_rate), config.env.control_rate)),
        ("env", lambda: load_imu(imu_of(config), config.env.from_pixels)),
        ("env", lambda: try_own(config)),
        ("env", lambda: GateSweeper(track, miss_radius=config.env.miss_radius)),
        ("evaluation", lambda: StartSampler(track, start_noise=config.evaluation.start_noise)),
    ):
        try:
            check_it()
        except ValueError as error:
            raise ValueError(f"{group}.{error}") from error
    moves = isinstance(config, WorldModelRunConfig) and config.schedule.start_on_line.to is not None
    if config.env.start_on_line == 1 and config.env.start_beyond_gate and not moves:
        raise ValueError(
            f"env.start_beyond_gate={config.env.start_beyond_gate:g} is a share of the episodes that do not begin on a "
            "line, and env.start_on_line=1 leaves none of them: lower that, or leave the other out."
        )


def try_own(config: RunConfig) -> None:
    """Refuse a reward or numbers of a user's own that cannot be had, or are not as they should be: fly a step by them.

    Raises:
        ValueError: the message names the setting, and what is wrong.
    """
    env = config.env
    if env.reward is None and env.vector is None:
        return
    if env.vector is not None and imu_of(config) is not None:
        raise ValueError("vector and env.imu: agents see one set of numbers, leave one of them out.")
    worlds = RaceWorlds(
        track_as_begun(config),
        2,
        env.preset,
        from_pixels=False,
        control_rate=env.control_rate,
        device=env.device,
        reward=env.reward,
        vector=env.vector,
    )
    worlds.reset()
    worlds.step(torch.zeros(2, ACTION_SIZE, device=env.device))
    worlds.observed_vector()
    worlds.close()


def check_replay(config: ReplayRunConfig) -> None:
    """Refuse settings with which there would be no update.

    Raises:
        ValueError: the message gives the numbers and the setting to change.
    """
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


def check_ppo(config: PPORunConfig) -> None:
    """Refuse more minibatches than a rollout has records.

    Raises:
        ValueError: the message gives the numbers and the settings to change.
    """
    check(config)
    records, minibatches = config.env.num_envs * config.rollout_steps, config.ppo.minibatches
    if minibatches > records:
        raise ValueError(
            f"ppo.minibatches={minibatches} are more than the {records} records of a rollout, env.num_envs="
            f"{config.env.num_envs} times rollout_steps={config.rollout_steps}: lower the one, or raise the others."
        )


def check_sac(config: SACRunConfig) -> None:
    """Refuse settings with which there would be no update.

    Raises:
        ValueError: the message gives the numbers and the setting to change.
    """
    check(config)
    check_replay(config)


def check_world_model_run(config: WorldModelRunConfig) -> None:
    """Refuse settings with which a world model could not learn.

    Raises:
        ValueError: the message gives the numbers and the setting to change.
    """
    check(config)
    check_replay(config)
    check_schedule(config)
    check_actor(config)
    check_image_size(config.env.image_size, config.model.size)
    if config.tuned == "images" and not config.env.from_pixels:
        raise ValueError(
            "tuned=images is for agents that see images, and env.from_pixels=false shows them the state: leave one out."
        )
    model = config.model
    prefilled = config.prefill // config.env.num_envs
    if prefilled < model.batch_length:
        raise ValueError(
            f"prefill={config.prefill} gives each of env.num_envs={config.env.num_envs} worlds {prefilled} records, "
            f"and the first update needs windows of model.batch_length={model.batch_length}: prefill must be at least "
            f"{config.env.num_envs * model.batch_length}."
        )
    check_workers(config)
    if config.collector is CollectorKind.overlapped and not is_race(config):
        raise ValueError(
            f"collector=overlapped is for the race: the OpenGL contexts of env.suite={config.env.suite} belong to the "
            "thread that made them. Use collector=local."
        )
    if config.collector is CollectorKind.overlapped and config.env.device != "cpu":
        raise ValueError(
            "collector=overlapped steps worlds in a thread, and evaluation steps others meanwhile, which warp can do "
            "on a CPU only: use env.device=cpu, or collector=local."
        )
    if config.collector is CollectorKind.overlapped and model.cuda_graph:
        raise ValueError(
            "collector=overlapped acts on the device while model.cuda_graph=true captures updates there, which CUDA "
            "refuses: choose one of them."
        )


def check_workers(config: WorldModelRunConfig) -> None:
    """Refuse workers beside other ways to collect, and worlds or weights that cannot be shared out among them.

    Raises:
        ValueError: the message names the settings.
    """
    workers, num_envs, asked = config.num_workers, config.env.num_envs, config.workers
    if config.collector is not CollectorKind.ray:
        default, settings = vars(WorkersConfig()), vars(asked).items()
        given = [f"workers.{name}={value}" for name, value in settings if value != default[name]]
        if given or workers is not None:
            first = given[0] if workers is None else f"num_workers={workers}"
            raise ValueError(f"{first} is for collector=ray: add that, or leave it out.")
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


ACTORS_OF_BEFORE = {"latent_ppo": "latent", "asymmetric_ppo": "state"}
"""What the critic sees of actors that were losses of DreamerV3 before they were an algorithm."""
OF_COLLECTED = ("clipped",)
"""Objectives of collected steps; the others are of imagined ones."""


def check_actor(config: WorldModelRunConfig) -> None:
    """Refuse an objective that there is not, or of steps that the algorithm does not take.

    Raises:
        ValueError: the message names those that there are, or the recipe of the algorithm that takes it.
    """
    actor = config.loss.actor  # type: ignore[attr-defined]
    if actor in ACTORS_OF_BEFORE:
        raise ValueError(
            f"loss.actor={actor} is an algorithm of its own now: recipes/latent_ppo.py "
            f"loss.critic={ACTORS_OF_BEFORE[actor]}."
        )
    find_objective(actor)
    takes = "latent_ppo" if actor in OF_COLLECTED else "dreamer_v3"
    if ":" not in actor and config.algorithm != takes:
        steps = "collected" if actor in OF_COLLECTED else "imagined"
        raise ValueError(f"loss.actor={actor} learns from {steps} steps: recipes/{takes}.py takes it.")


def check_schedule(config: WorldModelRunConfig) -> None:
    """Refuse ramps that end before they begin, or lead where the setting itself could not be.

    Raises:
        ValueError: the message names the ramp.
    """
    targets = {
        "learning_rates": POSITIVE,
        "world_model_rate": POSITIVE,
        **{name: allowed_values(config.loss, name) for name in LOSS_RAMPS},
        "start_on_line": allowed_values(config.env, "start_on_line"),
    }
    if isinstance(config, LatentPPORunConfig):
        targets["kl_target"] = allowed_values(config.loss.ppo, "kl_target")
    if isinstance(config, DreamerV3RunConfig):
        targets["imagination_horizon"] = allowed_values(config.model, "imagination_horizon")
    for name, allowed in targets.items():
        ramp = getattr(config.schedule, name)
        ramp.check(f"schedule.{name}")
        if ramp.to is not None and ramp.by is not RampClock.run and not is_race(config):
            raise ValueError(
                f"schedule.{name}.by={ramp.by.value} goes by gates, and env.suite={config.env.suite} has none: by=run."
            )
        if ramp.to is not None and allowed is not None and ramp.to not in allowed:
            raise ValueError(f"schedule.{name}.to={ramp.to}: must be {allowed}.")
    check_deviations(config)
    if isinstance(config, LatentPPORunConfig):
        limit = config.schedule.wait_for_model
        if limit is not None and limit <= 1:
            raise ValueError(f"schedule.wait_for_model={limit}: a ratio of errors, must be above 1.")
        check_kl(config.loss.ppo, config.schedule.kl_target.to)
    to = config.schedule.start_on_line.to
    if to is not None and not is_race(config):
        raise ValueError(f"schedule.start_on_line is for races, and env.suite={config.env.suite}: leave it out.")
    if to is not None and not config.env.start_on_line:
        raise ValueError("schedule.start_on_line begins at env.start_on_line=0: give that a share above 0.")


def check_deviations(config: WorldModelRunConfig) -> None:
    """Refuse a smallest deviation of actions above the largest, also where a ramp leads.

    Bounds that move on one clock are compared at its begin and at its end, others at every pair of those.

    Raises:
        ValueError: the message names both settings.
    """
    ramps = {name: getattr(config.schedule, name) for name in ("min_std", "max_std")}
    ends = {
        name: [
            (f"loss.{name}", getattr(config.loss, name)),
            *([(f"schedule.{name}.to", ramp.to)] if ramp.to is not None else []),
        ]
        for name, ramp in ramps.items()
    }
    lowest, highest = ends["min_std"], ends["max_std"]
    one_clock = len({(ramp.begin, ramp.end, ramp.by) for ramp in ramps.values()}) == 1
    pairs = zip(lowest, highest, strict=True) if one_clock and len(lowest) == len(highest) else product(lowest, highest)
    for (low, least), (high, most) in pairs:
        if least >= most:
            raise ValueError(f"{low}={least} must be below {high}={most}: the bounds of the actions' deviation.")


def check_kl(ppo: PPOUpdateConfig, to: float | None) -> None:
    """Refuse a target for the divergence that a stop below it would keep from ever being reached, also where it leads.

    Raises:
        ValueError: the message names both settings.
    """
    if ppo.kl_target is None:
        if to is not None:
            raise ValueError(
                f"schedule.kl_target.to={to} begins at loss.ppo.kl_target=null: give that a number, or leave the ramp "
                "out with schedule.kl_target.to=null."
            )
        return
    for name, target in (("loss.ppo.kl_target", ppo.kl_target), ("schedule.kl_target.to", to)):
        if target is not None and ppo.kl_stop < KL_TOLERANCE * target:
            raise ValueError(
                f"loss.ppo.kl_stop={ppo.kl_stop} ends updates before {name}={target} is seen to be exceeded: the "
                f"stop must be at least {KL_TOLERANCE} times the target."
            )


def check_image_size(image_size: int, size: str) -> None:
    """Refuse images that networks of that size cannot halve.

    Raises:
        ValueError: the message says which they can.
    """
    shape = get_size(size)
    try:
        smallest_map(image_size, shape.cnn_patch, len(shape.cnn_multipliers))
    except ValueError as error:
        raise ValueError(f"env.{error}") from error


def check_variant(config: ExperimentConfig) -> None:
    """Refuse a run of an experiment that names nothing.

    Raises:
        ValueError: the message lists what there is.
    """
    for name, value, allowed in (
        ("algorithm", config.algorithm, tuple(RECIPES)),
        ("variant", config.variant, tuple(config.variants)),
    ):
        if value not in allowed:
            raise ValueError(f"{name}={value}: there are {', '.join(allowed)}.")
