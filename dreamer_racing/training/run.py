"""A training run: collect, learn, log, evaluate, save, end.

The configuration that a run reads is a recipe's: any object with the fields `total_env_steps`, `seed`, `logger.every`,
`logger.media`, `evaluation.every`, `evaluation.stochastic`, `checkpoint.every` and `checkpoint.minutes`.

Several processes may train together (`training.parallel`): they go through the loop in step, each with worlds and
replay of its own; counters and what is learnt from episodes are of all, and the first alone logs and evaluates.
"""

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from dreamer_racing.envs.race.curriculum import BodyRateCurriculum
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.training import parallel
from dreamer_racing.training.checkpoint import BestCheckpoint, RunCheckpointError, RunCheckpoints
from dreamer_racing.training.clock import RunClock
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import LockHeldByFirst, UnwrittenMetrics
from dreamer_racing.training.lock import RunLock
from dreamer_racing.training.loggers import log_evaluation
from dreamer_racing.training.metrics import MetricsLog
from dreamer_racing.training.progress import Progress
from dreamer_racing.training.replay_ratio import ReplayRatio
from dreamer_racing.training.signals import GracefulExit


class Report(Protocol):
    """Evaluates a learner's policy."""

    on_episode: Callable[[int, int], None] | None
    """Is told how many episodes have ended, and of how many."""

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Evaluate, write what there is to look at, return metrics."""
        ...

    def close(self) -> None:
        """Free simulators."""
        ...


@dataclass
class Run:
    """The parts of a run, in the order in which data flows through them; a recipe adds its own and its learning."""

    config: Any  # the recipe's RunConfig
    directory: RunDirectory
    env: EnvBase
    collector: Collector
    rollouts: Iterator[TensorDictBase]
    tracker: EpisodeTracker
    curriculum: BodyRateCurriculum | None
    learner: Any  # the recipe's Learner
    report: Report
    metrics: MetricsLog | UnwrittenMetrics
    checkpoints: RunCheckpoints
    best: BestCheckpoint
    counters: dict[str, int]  # env_steps, updates, episodes
    clock: RunClock
    lock: RunLock | LockHeldByFirst
    evaluated: int = field(default=-1, init=False)  # updates at the last evaluation
    unsaved: str = field(default="", init=False)  # since when checkpoints could not be written, for the progress

    remedy: ClassVar[str] = "learning rate"  # what to lower once a loss is not finite, e.g. "ppo.learning_rate"

    def __post_init__(self) -> None:
        if self.metrics.holds("evaluation/return_mean", self.counters["env_steps"]):
            self.evaluated = self.counters["updates"]  # a run killed behind its evaluation

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Make the updates that are due after a rollout; after none, those that an interrupted run still owes."""
        raise NotImplementedError

    def take_in(self, rollout: TensorDictBase) -> TensorDictBase:
        """Account for the episodes that ended in a rollout, and let the curriculum set the b₂ of what comes.

        Returns:
            Those episodes, of all processes, batch ``[E]`` of ``EpisodeTracker.update``.
        """
        self.counters["env_steps"] += rollout.numel() * parallel.count()
        episodes = parallel.gathered_rows(self.tracker.update(rollout))
        self.counters["episodes"] += len(episodes)
        self.metrics.push(self.tracker.summary(episodes))
        if self.curriculum:
            self.env.body_rate_weight = self.curriculum.update(episodes["return"])
            self.metrics.push({"curriculum/body_rate_weight": self.env.body_rate_weight})
        return episodes

    def measure(self) -> None:
        """Take the clock's readings."""
        self.metrics.push(self.clock.read())

    def save(self) -> Path:
        """Save everything, unless the networks have just been spoilt."""
        with self.clock.timed("save"):
            self.learner.check_finite()
            return self.checkpoints.save(self.counters["env_steps"], {"wall_clock": self.clock.total})

    def try_to_save(self) -> str:
        """Save on the way, where a full disk is no reason to stop: return a line on what went wrong, or nothing."""
        try:
            self.save()
        except RunCheckpointError as error:
            self.unsaved = self.unsaved or f"since {self.counters['env_steps']:,}"
            return f"NOT SAVED: {error} The run goes on, and tries again at the next checkpoint."
        self.unsaved = ""
        return ""

    def evaluate(self) -> str:
        """Evaluate, without a trace in the random numbers of training; return a line on what came of it."""
        self.learner.check_finite()
        devices = [self.learner.device] if self.learner.device.type == "cuda" else []
        with self.clock.timed("evaluate"), torch.random.fork_rng(devices=devices):
            torch.manual_seed(self.config.seed)
            metrics = self.report.make(self.counters["env_steps"], self.config.evaluation.stochastic)
            if self.config.logger.media:
                log_evaluation(self.metrics.loggers, self.directory, self.counters["env_steps"])
        self.metrics.push(metrics)
        self.evaluated = self.counters["updates"]
        # Gates first, return where the gates are the same: a return lies far below a million.
        score = 1e6 * metrics.get("evaluation/gates_per_episode", 0.0) + metrics["evaluation/return_mean"]
        try:
            best = " (the best so far)" if self.best.offer(score, self.counters["env_steps"]) else ""
        except RunCheckpointError as error:
            best = f" (the best so far, but NOT SAVED: {error})"
        names = {"gates": "gates_per_episode", "success": "success_rate", "return": "return_mean"}
        shown = {label: metrics.get(f"evaluation/{name}") for label, name in names.items()}
        numbers = ", ".join(f"{label} {value:.2f}" for label, value in shown.items() if value is not None)
        return f"evaluation at {self.counters['env_steps']:,} env_steps: {numbers}{best}"

    @property
    def last_good(self) -> str:
        """Which checkpoint is left when training breaks off."""
        try:
            return f"the last good checkpoint is {self.directory.latest_checkpoint()}"
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
    ratio: ReplayRatio

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        return max(0, self.ratio.updates(self.counters["env_steps"]) - self.counters["updates"])

    def take_in(self, rollout: TensorDictBase) -> TensorDictBase:
        """Store a rollout too."""
        self.replay.extend(rollout)
        return super().take_in(rollout)

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


def train(run: Run) -> None:
    """Collect and learn until `total_env_steps`; log, evaluate and save on the way.

    Raises:
        SystemExit: a signal came; everything is saved, and the status is the shell's for that signal.
        KeyboardInterrupt: another came meanwhile, which is its argument; what is since the last checkpoint is lost.
        RunCheckpointError: at its end the run could not be saved.
    """
    config, counters, leads = run.config, run.counters, parallel.is_first()
    schedule = Schedule(
        counters["env_steps"], log=config.logger.every, evaluate=config.evaluation.every, save=config.checkpoint.every
    )
    minutes = Interval(config.checkpoint.minutes)
    with (
        graceful_exit() as stop,
        Progress(config.total_env_steps, counters["env_steps"], shown=leads) as progress,
    ):
        run.report.on_episode = progress.evaluating
        if run.directory.finished_env_steps() >= config.total_env_steps:
            progress.say(
                f"complete already, at {counters['env_steps']:,} env_steps: give a larger total_env_steps to go on"
            )
        run.learn(None, stop)  # what an interrupted run still owes
        while counters["env_steps"] < config.total_env_steps and not stop.requested:
            with run.clock.timed("collect"):
                rollout = next(run.rollouts)
                run.take_in(rollout)
            progress.advance(counters["env_steps"])
            run.learn(rollout, stop)
            if stop.signal_name:
                break
            due = schedule.due("log", counters["env_steps"])
            if schedule.due("evaluate", counters["env_steps"]) and leads:
                progress.say(run.evaluate())
                due = True  # so that its numbers stand where they were measured
            if due and leads:
                run.measure()
                progress.show(run.metrics.write(counters["env_steps"]), run.unsaved)
            by_steps, by_minutes = schedule.due("save", counters["env_steps"]), parallel.agreed(minutes.due())
            if (by_steps or by_minutes) and (problem := run.try_to_save()):
                progress.say(problem)
        saved = run.save()
        if stop.requested:
            at = f"at {counters['env_steps']:,} of {config.total_env_steps:,} env_steps"
            progress.say(f"{stop.signal_name} {at}: saved; continue with resume={run.directory.path}")
        if not stop.requested and leads and config.evaluation.every and run.evaluated != counters["updates"]:
            progress.say(run.evaluate())
        run.metrics.write(counters["env_steps"])
        if not stop.requested and leads:
            run.directory.mark_finished(counters["env_steps"])
        progress.say(f"checkpoint: {saved}")
    if stop.signal_name:
        raise SystemExit(128 + signal.Signals[stop.signal_name])


def graceful_exit() -> GracefulExit:
    """Make the flag that a signal raises, in all processes together; one of them answers."""
    answer = "saving; again: abandons what is since the last checkpoint" if parallel.is_first() else ""
    return GracefulExit(answer, parallel.largest if parallel.count() > 1 else None)


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


class Interval:
    """Says when something that happens every so many minutes of wall clock is due; never if they are 0."""

    def __init__(self, minutes: float) -> None:
        self._seconds = 60.0 * minutes
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether the interval has passed; if so it begins anew."""
        if not self._seconds or time.monotonic() - self._last < self._seconds:
            return False
        self._last = time.monotonic()
        return True
