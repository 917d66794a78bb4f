"""A training run: launch or resume, collect, learn, log, evaluate, save, end."""

import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, cast

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from tqdm import tqdm

from composing.arena import Environment, Report, is_known, with_schema
from composing.checks import ReplayRatio, check_overrides
from composing.command_line import merge_overrides, override_key, plain_errors, start_logging
from composing.schema import RECIPES
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.finite_guard import NonFiniteLossError
from dreamer_racing.machine import (
    is_out_of_memory,
    keep_freed_memory,
    out_of_memory_advice,
)
from dreamer_racing.training.checkpoint import (
    BestCheckpoint,
    GracefulExit,
    RunCheckpoints,
    finished_env_steps,
    latest_checkpoint,
    mark_finished,
)
from dreamer_racing.training.clock import RunClock
from dreamer_racing.training.lock import RunLock
from dreamer_racing.training.metrics import EpisodeTracker, MetricsLog

TRAINED_ON = ("track", "task", "decoys", "env.control_rate")  # what a run that is resumed cannot change


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
            metrics = self.learner.update(batch, self.clock.timed)
            self.metrics.push(metrics)
            self.counters["updates"] += 1
            self.after_update(batch, metrics)

    def after_update(self, batch: TensorDictBase, metrics: dict[str, Tensor]) -> None:
        """Do what a recipe does with a batch that was learned from."""


def launch(
    config: DictConfig, resolve: Callable, build: Callable, tune: Callable[[DictConfig], str] | None = None
) -> None:
    """Compose the configuration of a recipe, build its run, train it to its end.

    Args:
        config: as hydra composed it.
        resolve: replaces what the configuration leaves open.
        build: makes the ``Run`` of a configuration and its overrides.
        tune: says which file of the group ``tuned`` is meant by ``tuned=auto``; None where there is no such group.
    """
    start_logging()
    sys.path.append(str(Path.cwd()))  # losses of the user's own, loss.world_model=module:Class
    torch.set_float32_matmul_precision("medium")  # fp32 in effect on CPU, TF32 on CUDA
    with plain_errors():
        overrides = list(HydraConfig.get().overrides.task)
        if config.resume:
            config, overrides = resumed_config(config.algorithm, config.resume, overrides)
        if tune and config.tuned == "auto":
            overrides = merge_overrides(overrides, [f"tuned={tune(config)}"])
            config = hydra.compose(config.algorithm, overrides)
        check_overrides(config, overrides)
        config = resolve(config)
        if config.resume and (changed := changed_settings(config)):
            print(f"resumed with other settings: {', '.join(changed)}")
        run = build(OmegaConf.to_object(config), overrides)
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
    """The configuration of the run to continue, with the overrides given now on top.

    Raises:
        ValueError: it is another algorithm's run, or an override would make another run of it.
    """
    run_dir = latest_checkpoint(resume).parent.parent
    known = saved_config(algorithm, run_dir)
    for override in overrides:
        name, value = override_key(override), override.partition("=")[2]
        trained = OmegaConf.select(known, name) if name in TRAINED_ON else None
        if name in TRAINED_ON and OmegaConf.from_dotlist([f"value={value}"]).value != trained:
            raise ValueError(
                f"{run_dir} was trained with {name}={trained}, and goes on with it: {override} would be "
                "another run. Leave it out, or begin anew."
            )
    merged = merge_overrides([*begun_with(algorithm, run_dir), f"run_dir={run_dir}"], overrides)
    return hydra.compose(algorithm, merged), merged


def begun_with(algorithm: str, run_dir: Path) -> list[str]:
    """Overrides that a run was begun with, as this version knows them; what it does not know is left out and named."""
    schema = OmegaConf.structured(RECIPES[algorithm])
    overrides = [str(override) for override in OmegaConf.load(run_dir / "overrides.yaml")]
    if "tuned" in schema and "tuned" not in OmegaConf.load(run_dir / "config.yaml"):
        overrides = merge_overrides(overrides, ["tuned=none"])  # begun before there was a choice
    known = [override for override in overrides if is_known(override_key(override), schema)]
    if unknown := [override for override in overrides if override not in known]:
        print(f"overrides of another version, left out: {', '.join(unknown)}")
    return [override for override in known if override_key(override) != "run_dir"]


def saved_config(algorithm: str, run_dir: Path) -> DictConfig:
    """What a run was last trained with, resolved; what older runs do not say is at its default.

    Raises:
        ValueError: it is another algorithm's run.
    """
    saved = cast(DictConfig, OmegaConf.load(run_dir / "config.yaml"))
    trained_by = saved.get("algorithm", algorithm)
    if trained_by != algorithm:
        raise ValueError(f"{run_dir} was trained by {trained_by}: continue it with recipes/{trained_by}.py.")
    return with_schema(saved, algorithm)


def changed_settings(config: DictConfig) -> list[str]:
    """Every setting in which a resumed run goes on differently: by an override, this machine, or another version."""
    before = flat_settings(saved_config(config.algorithm, Path(config.run_dir)))

    def word(value: Any) -> str:
        return "null" if value is None else str(value)

    return [
        f"{name}={word(value)} (was {word(before.get(name))})"
        for name, value in flat_settings(config).items()
        if value != before.get(name) and name not in ("resume", "run_dir")
    ]


def flat_settings(config: DictConfig) -> dict[str, Any]:
    """Values by dotted name."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = str(key)
        if isinstance(value, DictConfig):
            flat |= {f"{name}.{inner}": leaf for inner, leaf in flat_settings(value).items()}
        else:
            flat[name] = value
    return flat


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
