"""DreamerV3 on the drone race: collect → replay → update → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dreamer_v3.py env=dmc task=cartpole_swingup
    torchrun --nproc-per-node=2 recipes/dreamer_v3.py track=kidney   # processes that share worlds, replay and batch

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

from typing import Any, cast

from composing.building import (
    adapt_rewards,
    make_curriculum,
    make_run_evaluator,
    make_sequence_replay,
    make_tracker,
    resolve_common,
    seed_generators,
)
from composing.checks import check_dreamer
from composing.entry import recipe
from composing.launching import launch
from composing.learners import begin_with, make_dreamer, make_schedule
from composing.options import CONFIG_DIR
from composing.schema import CollectorKind, DreamerConfig, imagines, learns_from_collected, register
from composing.sharing import share_of
from composing.tuned import changed_from_tuned
from composing.workers import make_own_env, make_rollouts, place_worlds, resolve_workers
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torch import device as Device

from dreamer_racing import parallel
from dreamer_racing.devices import choose_device, choose_mixed_precision
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics, world_model_metrics
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.modules import Interface
from dreamer_racing.training.model_lag import ModelLag
from dreamer_racing.training.session import Session

NUM_ENVS = 32
SHORT_WINDOW = 16  # records, on a CUDA device
MODEL_OF_BUDGET = {"smoke": "debug", "paper": "paper_large"}
RACE_SETTINGS = """settings: tuned=race, which race from images on a CPU (tuned=none: DreamerV3 as published):
  the world model decodes the simulator's state in training; whoever flies sees images only
  70 % of training episodes begin in flight on a planned racing line, until the hardest gate is passed; then all come
  to begin at the start, as a race does; a missed gate ends one
  25 actions a second; the actor learns by PPO from what it flew, in the model's latents; in training a critic that
  sees the simulator's state judges it, and nothing is imagined; where the model errs twice as much on new records as in
  training the actor waits for it, and what the model learns leaves the policy where it was; averaged weights fly
  evaluations and exports
  recipes/config/tuned/race.yaml has every number, docs/experiments.md what each is good for"""
IMAGES_SETTINGS = """settings: tuned=images, which race Circle from images alone, on a CPU:
  the world model reconstructs images, at a small weight; no network sees the simulator's state, not even in training
  half of the training episodes begin at rest, half before a gate; a missed gate ends one
  the actor learns by PPO from what it flew, in the model's latents, and so does its critic; nothing is imagined
  recipes/config/tuned/images.yaml has what is not as in race.yaml, docs/experiments.md, entry 42, how far it comes"""
SUITE_SETTINGS = """settings: tuned=suite, which learn a task from images on a CPU (tuned=none: as model=cpu_small):
  a small DreamerV3 that trains on 128 records for each action, and averaged weights fly evaluations
  recipes/config/tuned/suite.yaml has every number"""
REMEDY = "model.learning_rate (of an improvement loss.ppo.learning_rate), or model.mixed_precision=false"
RACE_SPEED = 450  # env_steps/s of tuned=race on one core with bfloat16 and AMX, two runs side by side (entry 20)
FEW_WORLDS = 4  # of fewer a world that is held out is too much to do without
HELD_OUT_WINDOWS, HELD_OUT_RECORDS = 32, 2_000  # windows measured at a time, from the newest records of a world

register()


@recipe("dreamer_v3")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    launch(config, resolve, train, tune, remedy=REMEDY)


def tune(config: DictConfig) -> str:
    """Choose the file of the group `tuned` for what is to be trained, and say what it means."""
    device, size, budget = choose_device(config.device).type, config.model.size, config.budget
    others = {
        f"device={device}": device != "cpu",
        "env.from_pixels=false": not config.env.from_pixels,
        f"model={size}": size not in ("auto", "cpu_small"),
        f"budget={budget}": budget in ("smoke", "paper"),
    }
    if reasons := [setting for setting, other in others.items() if other]:
        print(f"settings: tuned=none, DreamerV3 as published: none are chosen for {', '.join(reasons)}")
        return "none"
    name, settings = ("race", RACE_SETTINGS) if config.env.suite == "race" else ("suite", SUITE_SETTINGS)
    print(settings)
    return name


def resolve(config: DictConfig) -> DictConfig:
    """Replace every `auto` and missing number by what it stands for on this machine, and say what was chosen."""
    place_worlds(config)
    device = resolve_common(config, NUM_ENVS)
    size = config.model.size
    if size == "auto":
        by_device = "size12m" if device.type == "cuda" else "cpu_small"
        size = MODEL_OF_BUDGET.get(config.budget, by_device)
        print(f"model: {size} (model=auto on {device.type}, budget={config.budget})")
    config.model.size = size
    shorten_windows(config, device)
    let_drift(config)
    resolve_workers(config)
    numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{size}.yaml")
    for name in config.model:
        if OmegaConf.is_missing(config.model, name):
            config.model[name] = numbers[name]
    if config.model.mixed_precision is None:
        config.model.mixed_precision, reason = parallel.agreed(choose_mixed_precision(device))
        print(f"mixed precision: {'on' if config.model.mixed_precision else 'off'}, {reason}")
    if config.model.cuda_graph is None:
        config.model.cuda_graph = captures(config, device)
        if config.model.cuda_graph:
            print("updates: replayed as one CUDA graph (model.cuda_graph=null)")
    if config.tuned == "images":
        print(IMAGES_SETTINGS)
    if config.tuned in ("race", "images"):
        if changed := changed_from_tuned(config):
            print(f"settings of tuned={config.tuned}, but as asked for: {', '.join(changed)}")
        minutes = config.total_env_steps / RACE_SPEED / 60
        time = f"{minutes / 60:.1f} hours" if minutes >= 60 else f"{minutes:.0f} minutes"
        print(f"length: {config.total_env_steps:,} env_steps, {time} at one core's {RACE_SPEED} a second")
    if config.replay.held_out is None:
        worlds = config.env.num_envs // parallel.asked_for()  # of the first process, which holds them out
        config.replay.held_out = int(worlds >= FEW_WORLDS)
        if not config.replay.held_out:
            print(f"held out: nothing, because there are only {worlds} worlds (replay.held_out=null)")
    return config


def shorten_windows(config: DictConfig, device: Device) -> None:
    """On a CUDA device, take the records of a batch in more and shorter windows where their number is left open.

    A record of a window waits for the one before it, and every wait is a kernel's launch; windows begin warm then, or
    the first records of short ones would teach forgetting.
    """
    open_numbers = all(OmegaConf.is_missing(config.model, name) for name in ("batch_size", "batch_length"))
    shortened = device.type == "cuda" and open_numbers and config.replay.context is not False
    if shortened:
        numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{config.model.size}.yaml")
        shortened = numbers.batch_length > SHORT_WINDOW
    if shortened:
        config.model.batch_length = SHORT_WINDOW
        config.model.batch_size = numbers.batch_size * numbers.batch_length // SHORT_WINDOW
        print(f"batch: {config.model.batch_size} windows of {SHORT_WINDOW} records that begin warm, on a CUDA device")
    if config.replay.context is None:
        config.replay.context = shortened


def let_drift(config: DictConfig) -> None:
    """Hold the policy nowhere where no latents are kept to hold it at, or where they differ by their draw already."""
    reasons = {
        "records keep no latents (replay.context=false)": not config.replay.context,
        "latents are drawn (model.sampled=true)": config.model.sampled,
    }
    if config.loss.drift_scale and any(reasons.values()):
        config.loss.drift_scale = 0.0
        print(f"policy's drift: not held, because {' and '.join(name for name, holds in reasons.items() if holds)}")


def captures(config: DictConfig, device: Device) -> bool:
    """Whether updates can be captured as a CUDA graph: not beside what acts meanwhile, or exchanges on the way."""
    alone = parallel.asked_for() == 1 or not imagines(config)
    return device.type == "cuda" and config.collector is not CollectorKind.overlapped and alone


def train(config: DreamerConfig, session: Session) -> None:
    """Collect, replay, update, evaluate, save."""
    check_dreamer(config)
    own = share_of(config)  # of several processes
    env = make_own_env(own)
    learner = make_dreamer(own, Interface.of(env), own.device, config.seed)
    if config.init_from and not config.resume:
        print(begin_with(learner, config, env))
    seed_generators(own.seed)
    curriculum = make_curriculum(config)
    rollouts = make_rollouts(own, env, learner)
    replay = make_sequence_replay(own, env, curriculum, learner.latent_format if config.replay.context else None)
    ratio = config.make_replay_ratio()
    schedule = make_schedule(config, env.track.num_gates if isinstance(env, DroneRacingEnv) else 0)
    limit = config.schedule.wait_for_model if learns_from_collected(config) else None
    lag = ModelLag(limit, config.schedule.wait_every)
    session.track(
        learner=learner,
        env=env,
        rollouts=rollouts,
        evaluator=make_run_evaluator(config, session.directory.path, learner),
        tracker=make_tracker(config),
        replay=replay,
        ratio=ratio,
        schedule=schedule,
        lag=lag,
        **parts_of(curriculum, learner),
        best=("schedule",),
    )
    if config.resume and curriculum:
        env.body_rate_weight = curriculum.body_rate_weight  # workers' worlds begin anew

    for rollout in session.rollouts():
        # Replay what was collected; a resumed run first makes the updates that are due, from what it has.
        if rollout is not None:
            replay.extend(rollout)
            learner.collect(rollout)
            episodes = session.log_episodes(rollout)
            session.log(adapt_rewards(env, curriculum, episodes))
            session.log(schedule.observe(episodes, session.env_steps))

        # Move what is scheduled; the actor waits while the model does not know the newest records.
        if lag.due(session.env_steps) and session.counters["updates"]:
            session.log(measure_lag(session, lag, learner, replay, config))
        numbers = schedule.at(session.env_steps)
        if (share := numbers.pop("start_on_line", None)) is not None:
            cast(DroneRacingEnv, env).worlds.start_on_line = share
        learner.adjust(**numbers)
        if isinstance(learner, LatentPPO):
            learner.actor_waits = lag.waits

        # Update world model, actor and critic on the replay.
        for _ in session.updates(ratio.updates_due(session.env_steps, learner.updates)):
            with session.timed("sample"):
                batch = replay.sample()
            metrics = learner.update(batch, session.timed)
            session.log(metrics)
            lag.trained(metrics)
            if config.replay.context and learner.latents is not None:  # later windows go on from the latents of now
                replay.refresh(batch["index"], learner.latents["belief"], learner.latents["state"])

        # Evaluate, log and save.
        if session.due("evaluate"):
            session.evaluate()
        if session.due("log"):
            session.write_row(
                {f"schedule/{name}": value for name, value in numbers.items()}
                | {
                    f"learning_rate/{name}": group["lr"]
                    for name, group in zip(("world_model", "behavior"), learner.optimizer.param_groups, strict=True)
                }
                | measure_held_out(session, learner, replay, config)
            )
        session.save_if_due()


def parts_of(curriculum: BodyRateCurriculum | None, learner: WorldModelLearner) -> dict[str, Any]:
    """Return the parts of a checkpoint that not every run has."""
    parts: dict[str, Any] = {} if curriculum is None else {"curriculum": curriculum}
    if isinstance(learner, LatentPPO) and not parallel.is_first():  # that of the first is the learner's
        parts["storage"] = learner.storage
    return parts


def measure_lag(
    session: Session, lag: ModelLag, learner: WorldModelLearner, replay: StreamReplay, config: DreamerConfig
) -> dict[str, Tensor | float]:
    """Measure whether the model knows the records of the newest flights, before they are learned from."""
    length = config.model.batch_length
    if config.replay.context:  # begins warm: the newest rollout alone
        length = min(length, config.rollout_steps)
    if (windows := replay.newest(length)) is None:
        return {}
    with session.undisturbed():
        return lag.measured(parallel.averaged(world_model_metrics(learner, windows)))


def measure_held_out(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, config: DreamerConfig
) -> dict[str, Tensor]:
    """Measure the world model on the newest records that it is never trained on; nothing, if there are none."""
    length = SEEN + config.model.imagination_horizon
    windows = replay.held_out(HELD_OUT_WINDOWS, length, HELD_OUT_RECORDS)
    if windows is None or not session.counters["updates"]:
        return {}
    with session.undisturbed():
        return held_out_metrics(learner, windows)


if __name__ == "__main__":
    main()
