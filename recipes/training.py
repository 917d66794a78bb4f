"""What every training recipe does around its algorithm: build, resume, collect, log, evaluate, save, end."""

import random
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import hydra
import numpy as np
import torch
from arena import Environment, Report, crash_causes, is_race, make_report, reward_terms, scene_name
from checks import ReplayRatio, check_overrides, refuse_to_replace
from command_line import CONFIG_DIR, choose_device, merge_overrides, new_run_dir, plain_errors, start_logging
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from schema import DreamerConfig, RunConfig, SACRunConfig, Storage
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker
from tqdm import tqdm

from dreamer_racing.checkpoint import (
    BestCheckpoint,
    CollectorState,
    GracefulExit,
    RunCheckpoints,
    ensure_writable,
    finished_env_steps,
    latest_checkpoint,
    mark_finished,
)
from dreamer_racing.envs.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.partial_reset import TransformedPixelEnv
from dreamer_racing.finite_guard import NonFiniteLossError
from dreamer_racing.learner import Learner
from dreamer_racing.memory import (
    available_memory,
    check_fits,
    is_out_of_memory,
    keep_freed_memory,
    out_of_memory_advice,
)
from dreamer_racing.metrics import EpisodeTracker, MetricsLog
from dreamer_racing.modules import Interface
from dreamer_racing.replay import StreamReplay, make_replay, replay_bytes
from dreamer_racing.run_lock import RunLock
from dreamer_racing.timing import RunClock

R = TypeVar("R", bound="Run")
TRAINED_ON = ("track", "task", "decoys")  # what a run that is resumed cannot change


@dataclass
class Run:
    """The parts of a run, in the order in which data flows through them; a recipe adds its own and its learning."""

    config: Any  # the recipe's RunConfig
    directory: Path
    env: Environment
    collector: Collector
    rollouts: Iterator[TensorDictBase]
    tracker: EpisodeTracker
    curriculum: BodyRateCurriculum | None
    learner: Any  # the recipe's Learner
    report: Report
    metrics: MetricsLog
    checkpoints: RunCheckpoints
    best: BestCheckpoint
    counters: dict[str, int]  # env_steps, updates, episodes
    clock: RunClock
    lock: RunLock
    evaluated: int = field(default=-1, init=False)  # updates at the last evaluation

    remedy: ClassVar[str]  # the setting to lower once a loss is not finite

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Make the updates that are due after a rollout; after none, those that an interrupted run still owes."""
        raise NotImplementedError

    def take_in(self, rollout: TensorDictBase) -> None:
        """Account for the episodes that ended in a rollout, and let the curriculum set the b₂ of what comes."""
        self.counters["env_steps"] += rollout.numel()
        episodes = self.tracker.update(rollout)
        self.counters["episodes"] += len(episodes)
        self.metrics.push(self.tracker.summary(episodes))
        if self.curriculum:
            self.env.body_rate_weight = self.curriculum.update(episodes["return"])
            self.metrics.push({"curriculum/body_rate_weight": self.env.body_rate_weight})

    def measure(self) -> None:
        """Take the clock's readings."""
        self.metrics.push(self.clock.read())

    def save(self) -> Path:
        """Save everything, unless the networks have just been spoilt."""
        self.learner.check_finite()
        return self.checkpoints.save(self.counters["env_steps"], {"wall_clock": self.clock.total})

    def evaluate(self) -> str:
        """Evaluate, without a trace in the random numbers of training; return a line on what came of it."""
        devices = [self.learner.device] if self.learner.device.type == "cuda" else []
        with self.clock.timed("evaluate"), torch.random.fork_rng(devices=devices):
            torch.manual_seed(self.config.seed)
            metrics = self.report.make(self.counters["env_steps"], self.config.evaluation.stochastic)
        self.metrics.push(metrics)
        self.evaluated = self.counters["updates"]
        # Gates first, return where the gates are the same: a return lies far below a million.
        score = 1e6 * metrics.get("evaluation/gates_per_episode", 0.0) + metrics["evaluation/return_mean"]
        best = self.best.offer(score, self.counters["env_steps"])
        names = {"gates": "gates_per_episode", "success": "success_rate", "return": "return_mean"}
        shown = {label: metrics.get(f"evaluation/{name}") for label, name in names.items()}
        numbers = ", ".join(f"{label} {value:.2f}" for label, value in shown.items() if value is not None)
        return (
            f"evaluation at {self.counters['env_steps']:,} env_steps: {numbers}{' (the best so far)' if best else ''}"
        )

    @property
    def last_good(self) -> str:
        """Which checkpoint is left when training breaks off."""
        try:
            return f"the last good checkpoint is {latest_checkpoint(self.directory)}"
        except FileNotFoundError:
            return "there is no checkpoint yet"

    def close(self) -> None:
        """Free simulators and files."""
        self.collector.shutdown()
        self.report.close()
        self.metrics.close()
        self.lock.release()


@dataclass(kw_only=True)
class ReplayRun(Run):
    """A run whose learner makes updates by the replay ratio, from a replay of what was collected."""

    replay: StreamReplay

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        return max(0, ReplayRatio.of(self.config).updates(self.counters["env_steps"]) - self.counters["updates"])

    def take_in(self, rollout: TensorDictBase) -> None:
        """Store a rollout too."""
        self.replay.extend(rollout)
        super().take_in(rollout)

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Make the updates that are due."""
        for _ in range(self.updates_due):
            if stop.requested:
                return
            with self.clock.timed("sample"):
                batch = self.replay.sample()
            self.metrics.push(self.learner.update(batch, self.clock.timed))
            self.counters["updates"] += 1


def launch(config: DictConfig, resolve: Callable, build: Callable) -> None:
    """Compose the configuration of a recipe, build its run, train it to its end.

    Args:
        config: as hydra composed it.
        resolve: replaces what the configuration leaves open.
        build: makes the ``Run`` of a configuration and its overrides.
    """
    start_logging()
    sys.path.append(str(Path.cwd()))  # losses of the user's own, loss.world_model=module:Class
    torch.set_float32_matmul_precision("medium")  # fp32 in effect on CPU, TF32 on CUDA
    with plain_errors():
        overrides = list(HydraConfig.get().overrides.task)
        if config.resume:
            config, overrides = resumed_config(config.algorithm, config.resume, overrides)
        check_overrides(config, overrides)
        run = build(OmegaConf.to_object(resolve(config)), overrides)
    if run.learner.device.type == "cpu" and not keep_freed_memory():
        print("memory: freed blocks go back to the system, for this C library cannot keep them; updates are slower")
    try:
        train(run)
    except NonFiniteLossError as error:
        torch.save(error.batch.to("cpu").to_dict(), run.directory / "nonfinite_batch.pt")
        raise SystemExit(
            f"error: {error} Update {run.counters['updates']:,}, {run.counters['env_steps']:,} env_steps. The batch is "
            f"kept in {run.directory / 'nonfinite_batch.pt'}; {run.last_good}. Continue from there with a lower "
            f"{run.remedy}."
        ) from error
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise SystemExit(f"error: {out_of_memory_advice(error)} {run.last_good}.") from error
    finally:
        run.close()


def resumed_config(algorithm: str, resume: str, overrides: list[str]) -> tuple[DictConfig, list[str]]:
    """The configuration of the run to continue, with the overrides given now on top."""
    run_dir = latest_checkpoint(resume).parent.parent
    saved = cast(DictConfig, OmegaConf.load(run_dir / "config.yaml"))
    trained_by = saved.get("algorithm", algorithm)
    if trained_by != algorithm:
        raise ValueError(f"{run_dir} was trained by {trained_by}: continue it with recipes/{trained_by}.py.")
    for override in overrides:
        name, _, value = override.partition("=")
        if name in TRAINED_ON and value != str(saved.get(name)):
            raise ValueError(
                f"{run_dir} was trained with {name}={saved.get(name)}, and goes on with it: {override} would be "
                "another run. Leave it out, or begin anew."
            )
    merged = merge_overrides([*OmegaConf.load(run_dir / "overrides.yaml"), f"run_dir={run_dir}"], overrides)
    return hydra.compose(algorithm, merged), merged


def resolve_common(config: DictConfig, num_envs: int) -> torch.device:
    """Fill in what every recipe leaves open, and say what was chosen; return the learner's device."""
    device = choose_device(config.device)
    if config.device == "auto":
        print(f"device: {device} (device=auto)")
    config.device = str(device)
    if OmegaConf.is_missing(config.env, "num_envs"):
        config.env.num_envs = num_envs
    if config.env.device == "auto":
        config.env.device = worlds_device(config)
        print(f"worlds: {config.env.device} (env.device=auto)")
    if config.run_dir is None:
        config.run_dir = str(new_run_dir(config.algorithm, scene_name(cast(RunConfig, config))))
    return device


def resolve_network(config: DictConfig) -> None:
    """Choose the size of a baseline's networks by what they see."""
    if config.network.size == "auto":
        sees = "images" if config.env.from_pixels else "numbers"
        config.network.size = "paper" if config.env.from_pixels and config.budget != "smoke" else "small"
        print(f"network: {config.network.size} (network=auto, seeing {sees}, budget={config.budget})")
    numbers = cast(DictConfig, OmegaConf.load(CONFIG_DIR / "network" / f"{config.network.size}.yaml"))
    for name in ("layers", "units"):
        if OmegaConf.is_missing(config.network, name):
            config.network[name] = numbers[name]


def worlds_device(config: DictConfig) -> str:
    """The device for the worlds to train in: the learner's, where they have a simulator and the renderer asked for."""
    on_cuda = torch.device(config.device).type == "cuda"
    fits = config.env.suite == "race" and config.env.renderer in ("auto", "warp")
    return str(config.device) if on_cuda and fits else "cpu"


def seed_generators(seed: int) -> None:
    """Seed all global generators, of which torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what libraries draw from
    torch.manual_seed(seed)


def make_curriculum(config: RunConfig) -> BodyRateCurriculum | None:
    """Make the schedule of the race's body-rate penalty; other suites have none."""
    if not is_race(config):
        return None
    settings = asdict(config.curriculum)
    del settings["relabel"]
    return BodyRateCurriculum(**settings)


def make_collector(config: RunConfig, env: Environment, policy: TensorDictModuleBase) -> Collector:
    """Make the collector of rollouts [num_envs, rollout_steps], on the worlds' device."""
    return Collector(
        TransformedPixelEnv(env, Compose(InitTracker(), policy.make_primer())),
        policy,
        frames_per_batch=config.env.num_envs * config.rollout_steps,
        total_frames=-1,
        env_device=env.device,
        policy_device=config.device,
        storing_device=env.device,
        track_traj_ids=False,
        no_cuda_sync=False,
    )


def make_run_replay(
    config: DreamerConfig | SACRunConfig,
    env: Environment,
    curriculum: BodyRateCurriculum | None,
    batch_size: int,
    batch_length: int,
    **windows: Any,
) -> StreamReplay:
    """Make the replay, on the learner's device if it has room there; say where and how large.

    Args:
        config: resolved.
        env: whose records it is to hold.
        curriculum: by which old rewards are relabelled, if they are.
        batch_size: windows in a batch.
        batch_length: records in a window.
        windows: further arguments of `make_replay` on which windows are drawn.
    """
    settings, interface = config.replay, Interface.of(env)
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers)
    storage_device = settings.device
    if storage_device == "auto":
        on_learner = config.device != "cpu" and size < 0.5 * available_memory(config.device)
        storage_device = config.device if on_learner else "cpu"
    where = storage_device if settings.storage is Storage.tensor else "files"
    if settings.storage is Storage.tensor:
        check_fits(size, storage_device, f"replay.capacity={settings.capacity:,}")
    print(f"replay: {settings.capacity:,} records, {size / 1e9:.1f} GB when full, in memory of {where}")
    return make_replay(
        settings.capacity,
        config.env.num_envs,
        batch_size,
        batch_length,
        config.device,
        storage=settings.storage.value,
        storage_device=storage_device,
        seed=config.seed,
        transform=RelabelReward(curriculum) if curriculum and config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
        reward_keys=reward_terms(env),
        prefetch=2 if config.device != "cpu" and storage_device == "cpu" else None,
        **windows,
    )


def claim(config: RunConfig) -> RunLock:
    """Take a run directory before anything large is made.

    Raises:
        ValueError: it holds another run, or is in use by a live one.
    """
    assert config.run_dir is not None, "resolve_common() names it"
    lock = RunLock(ensure_writable(config.run_dir))
    refuse_to_replace(config)
    return lock


def assemble(
    kind: type[R],
    config: RunConfig,
    overrides: list[str],
    lock: RunLock,
    env: Environment,
    learner: Learner,
    collector: Collector,
    curriculum: BodyRateCurriculum | None,
    rollouts: Iterator[TensorDictBase] | None = None,
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
        collector: of its rollouts.
        curriculum: of rewards, if there is one.
        rollouts: an iterator over the collector; None for its own.
        own: further fields of ``kind``; a ``replay`` is saved with the run.
    """
    directory = lock.directory
    tracker = EpisodeTracker(config.env.num_envs, crash_causes(config))
    counters = {"env_steps": 0, "updates": 0, "episodes": 0}
    parts = {"learner": learner, "counters": counters, "env": env, "tracker": tracker}
    parts |= {"collector": CollectorState(collector)} | ({"curriculum": curriculum} if curriculum else {})
    parts |= {"replay": own["replay"]} if "replay" in own else {}
    checkpoints = RunCheckpoints(directory, parts, config.checkpoint.keep)
    clock = RunClock(counters)
    if config.resume:
        clock.total = checkpoints.load(config.resume).get("wall_clock", 0.0)
        print(f"resumed {config.resume} at {counters['env_steps']:,} env_steps, {counters['updates']:,} updates")
    best = BestCheckpoint(directory, {"learner": learner, "counters": counters})
    for folder in (directory, best.directory):
        OmegaConf.save(OmegaConf.structured(config), folder / "config.yaml")
    kept = [override for override in overrides if not override.startswith("resume=")]
    OmegaConf.save(OmegaConf.create(kept), directory / "overrides.yaml")
    metrics = MetricsLog(
        directory,
        tensorboard=config.logger.tensorboard,
        resume_env_steps=counters["env_steps"] if config.resume else None,
    )
    print(f"run directory: {directory}")
    return kind(
        config=config,
        directory=directory,
        env=env,
        collector=collector,
        rollouts=rollouts or iter(collector),
        tracker=tracker,
        curriculum=curriculum,
        learner=learner,
        report=make_report(config, directory, learner, config.evaluation.episodes, config.evaluation.video_steps),
        metrics=metrics,
        checkpoints=checkpoints,
        best=best,
        counters=counters,
        clock=clock,
        lock=lock,
        **own,
    )


def train(run: Run) -> None:
    """Collect and learn until `total_env_steps`; log, evaluate and save on the way.

    Raises:
        SystemExit: a signal came; everything is saved, and the status is the shell's for that signal.
    """
    config, counters = run.config, run.counters
    schedule = Schedule(
        counters["env_steps"], log=config.logger.every, evaluate=config.evaluation.every, save=config.checkpoint.every
    )
    with (
        GracefulExit() as stop,
        tqdm(total=config.total_env_steps, initial=counters["env_steps"], unit="step", dynamic_ncols=True) as bar,
    ):
        if finished_env_steps(run.directory) >= config.total_env_steps:
            bar.write(
                f"complete already, at {counters['env_steps']:,} env_steps: give a larger total_env_steps to go on"
            )
        run.learn(None, stop)  # what an interrupted run still owes
        while counters["env_steps"] < config.total_env_steps and not stop.requested:
            with run.clock.timed("collect"):
                rollout = next(run.rollouts)
                run.take_in(rollout)
            bar.update(counters["env_steps"] - bar.n)
            run.learn(rollout, stop)
            if stop.signal_name:
                break
            due = schedule.due("log", counters["env_steps"])
            if schedule.due("evaluate", counters["env_steps"]):
                bar.write(run.evaluate())
                due = True  # so that its numbers stand where they were measured
            if due:
                run.measure()
                show(bar, run.metrics.write(counters["env_steps"]))
            if schedule.due("save", counters["env_steps"]):
                run.save()
        if stop.requested:
            at = f"at {counters['env_steps']:,} of {config.total_env_steps:,} env_steps"
            bar.write(f"{stop.signal_name} {at}: saving; continue with resume={run.directory}")
        saved = run.save()
        if not stop.requested and config.evaluation.every and run.evaluated != counters["updates"]:
            bar.write(run.evaluate())
        run.metrics.write(counters["env_steps"])
        if not stop.requested:
            mark_finished(run.directory, counters["env_steps"])
        bar.write(f"checkpoint: {saved}")
    if stop.signal_name:
        raise SystemExit(128 + signal.Signals[stop.signal_name])


def show(bar: tqdm, row: dict[str, float]) -> None:
    """Put the latest numbers behind the progress bar."""
    shown = {"return": "episode/return", "gates": "episode/gates_passed", "updates/s": "rate/updates"}
    bar.set_postfix({label: f"{row[key]:.2f}" for label, key in shown.items() if key in row})


class Schedule:
    """Says when something that happens every so many env_steps is due."""

    def __init__(self, env_steps: int, **every: int) -> None:
        self._every = every
        self._done = {name: env_steps // period if period else 0 for name, period in every.items()}

    def due(self, name: str, env_steps: int) -> bool:
        """Whether another period has passed; asking takes note of it."""
        period = self._every[name]
        if not period or env_steps // period <= self._done[name]:
            return False
        self._done[name] = env_steps // period
        return True
