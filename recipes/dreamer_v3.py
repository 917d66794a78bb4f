"""DreamerV3 on the drone race: collect → replay → update → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dreamer_v3.py env=dmc task=cartpole_swingup
    torchrun --nproc-per-node=2 recipes/dreamer_v3.py track=kidney   # processes that share worlds, replay and batch

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, cast

from composing.building import (
    assemble,
    claimed,
    make_curriculum,
    make_sequence_replay,
    resolve_common,
    seed_generators,
)
from composing.checks import check_dreamer, steps_alone
from composing.command_line import CONFIG_DIR
from composing.devices import choose_device, choose_mixed_precision
from composing.entry import recipe
from composing.launching import launch
from composing.learners import begin_with, clock_times, make_agent, scheduled_numbers
from composing.schema import CollectorKind, DreamerConfig, register
from composing.sharing import imagines, share_of
from composing.tuned import changed_from_tuned
from composing.workers import make_own_env, make_rollouts, place_worlds, resolve_workers
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torch import device as Device

from dreamer_racing import parallel
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics, world_model_metrics
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.learners.dreamer_optimizer import make_optimizer
from dreamer_racing.learners.learner import seeded
from dreamer_racing.losses import make_losses
from dreamer_racing.modules import Interface
from dreamer_racing.training.model_lag import ModelLag
from dreamer_racing.training.pass_share import PassShare
from dreamer_racing.training.replay_ratio import UpdatesOwed
from dreamer_racing.training.run import ReplayRun
from dreamer_racing.training.schedule import RampClock
from dreamer_racing.training.signals import GracefulExit

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
LAG_ERRORS = ("privileged_error", "image_error", "loss_vector", "reward_error")  # what tells, best first
RACE_SPEED = 450  # env_steps/s of tuned=race on one core with bfloat16 and AMX, two runs side by side (entry 20)
FEW_WORLDS = 4  # of fewer a world that is held out is too much to do without
HELD_OUT_WINDOWS, HELD_OUT_RECORDS = 32, 2_000  # windows measured at a time, from the newest records of a world

register()


@dataclass(kw_only=True)
class DreamerRun(ReplayRun):
    """A run that also measures its world model, and may collect ahead of learning."""

    config: DreamerConfig
    learner: DreamerLearner
    lag: ModelLag
    passes: PassShare

    remedy: ClassVar[str] = (
        "model.learning_rate (of an improvement loss.ppo.learning_rate), or model.mixed_precision=false"
    )

    def take_in(self, rollout: TensorDictBase) -> TensorDictBase:
        """Take note of the gates passed, and of how they were flown, too."""
        episodes = super().take_in(rollout)
        self.learner.watch(rollout)
        if len(episodes) and "gates_passed" in episodes:
            share = self.passes.update(episodes, self.counters["env_steps"])
            self.metrics.push({"episode/pass_share": share, "episode/hardest_gate": float(self.passes.hardest_gate)})
        return episodes

    def measure(self) -> None:
        """Say what is scheduled, and measure the world model on records never trained on, too."""
        super().measure()
        numbers = scheduled_numbers(self.config, self.times())
        self.metrics.push({f"schedule/{name}": number for name, number in numbers.items() if number is not None})
        names = ("learning_rate/world_model", "learning_rate/behavior")
        rates = (group["lr"] for group in self.learner.optimizer.param_groups)
        self.metrics.push(dict(zip(names, rates, strict=True)))
        self.metrics.push(self.held_out())

    def held_out(self) -> dict[str, Tensor]:
        """What the world model makes of the newest records that it is never trained on; nothing, if there are none."""
        length = SEEN + self.config.model.imagination_horizon
        windows = self.replay.held_out(HELD_OUT_WINDOWS, length, HELD_OUT_RECORDS)
        if windows is None or not self.counters["updates"]:
            return {}
        self.wait()
        with self.clock.timed("measure"):
            return held_out_metrics(self.learner, windows)

    def look_at_lag(self) -> None:
        """Every so many env_steps, whatever is logged: see whether the model still knows where its policy flies."""
        periods = self.counters["env_steps"] // self.config.schedule.wait_every
        if self.lag.limit is None or periods == self.lag.periods:
            return
        self.lag.periods = periods
        length = self.config.model.batch_length
        if self.config.replay.context:  # begins warm: the newest rollout alone
            length = min(length, self.config.rollout_steps)
        windows = self.replay.newest(length)
        if windows is None or not self.counters["updates"]:
            return
        self.wait()
        with self.clock.timed("measure"):
            error = lag_error(parallel.averaged(world_model_metrics(self.learner, windows)))
        if error is not None:
            waited, ratio = self.lag.waits, self.lag.measured(error)
            if self.lag.waits is not waited:
                reason = f"the model errs {ratio:.2f} times as much on the newest records as in training"
                limit = f"schedule.wait_for_model={self.lag.limit:g}"
                self.say(f"the actor {'waits' if self.lag.waits else 'goes on'}: {reason} ({limit})")
            self.metrics.push({"lag/error": error, "lag/ratio": ratio, "lag/actor_waits": float(self.lag.waits)})

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Put what is scheduled where it belongs by now, and make the updates that are due."""
        self.look_at_lag()  # before the newest records are learned from
        self.keep_to_schedule()
        super().learn(rollout, stop)

    def times(self) -> dict[RampClock, float]:
        """What the clocks of schedules say by now."""
        return clock_times(self.config, self.counters["env_steps"], self.passes)

    def keep_to_schedule(self) -> None:
        """Set everything that is scheduled to its value at this share of the run."""
        self.learner.actor_waits = self.lag.waits
        times = self.times()
        self.learner.adjust(**scheduled_numbers(self.config, times))
        ramp = self.config.schedule.start_on_line
        if ramp.to is not None:
            share = ramp.at(self.config.env.start_on_line, times)
            cast(DroneRacingEnv, self.env).worlds.start_on_line = share

    def after_update(self, batch: TensorDictBase, metrics: dict[str, Tensor]) -> None:
        """Take note of the model's error; let later windows go on from what the model makes of these records now."""
        if self.lag.limit is not None and (error := lag_error(metrics)) is not None:
            self.lag.trained(error)
        if self.config.replay.context:
            latents = self.learner.latents
            assert latents is not None, "the update left them"
            self.replay.refresh(batch["index"], latents["belief"], latents["state"])

    def save(self) -> Path:
        """Save everything, if the processes' networks are still the same."""
        self.learner.check_finite()  # first: weights that are no numbers are never the same
        parallel.check_same(self.learner.weights)
        return super().save()


def lag_error(metrics: dict[str, Tensor]) -> Tensor | None:
    """The error by which a model is seen to lag; None if none of them was measured."""
    return next((metrics[name] for name in LAG_ERRORS if name in metrics), None)


@recipe("dreamer_v3")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    launch(config, resolve, build, tune)


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


def build(config: DreamerConfig, overrides: list[str]) -> DreamerRun:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    check_dreamer(config)
    own = share_of(config)
    with claimed(config) as lock:
        env = make_own_env(own)
        with seeded(config.seed):
            agent = make_agent(own, Interface.of(env))
            losses = make_losses(agent, own.loss, own.model.imagination_horizon)
        learner = DreamerLearner(agent, losses, make_optimizer(agent, losses, own.model), own.model)
        if config.init_from and not config.resume:
            print(begin_with(learner, config, env))
        seed_generators(own.seed)
        curriculum = make_curriculum(config)
        collector, rollouts = make_rollouts(own, env, learner)
        latents = learner.latent_format if config.replay.context else None
        parts = {
            "replay": make_sequence_replay(own, env, curriculum, latents),
            "owed": UpdatesOwed(config.replay_ratio),
            "lag": ModelLag(config.schedule.wait_for_model if steps_alone(config.loss.actor) else None),
            "passes": PassShare(env.track.num_gates if isinstance(env, DroneRacingEnv) else 0),
        }
        return assemble(DreamerRun, config, overrides, lock, env, learner, collector, curriculum, rollouts, **parts)


if __name__ == "__main__":
    main()
