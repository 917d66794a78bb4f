"""A training run: collect, learn, log, evaluate, save, end.

The configuration that a run reads is a recipe's: any object with the fields `total_env_steps`, `seed`, `logger.media`,
`evaluation.stochastic` and `checkpoint.minutes`; when it logs, evaluates and saves is its journal's `Schedule`.

Several processes may train together (`parallel`): they go through the loop in step, each with worlds and
replay of its own; counters and what is learnt from episodes are of all, and the first alone logs and evaluates.
"""

import logging
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from dreamer_racing import parallel
from dreamer_racing.envs.race.curriculum import BodyRateCurriculum
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.experience.rollouts import Rollouts, WorkerError
from dreamer_racing.machine import KeptMemory
from dreamer_racing.training.checkpoint import BestCheckpoint, RunCheckpointError, RunCheckpoints
from dreamer_racing.training.clock import RunClock
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.following import LockHeldByFirst, UnwrittenMetrics
from dreamer_racing.training.journal import Interval, Schedule
from dreamer_racing.training.lock import RunLock
from dreamer_racing.training.media import log_evaluation
from dreamer_racing.training.metrics import MetricsLog
from dreamer_racing.training.progress import Progress
from dreamer_racing.training.replay_ratio import UpdatesOwed
from dreamer_racing.training.signals import GracefulExit

logger = logging.getLogger(__name__)


class Report(Protocol):
    """Evaluates a learner's policy."""

    on_episode: Callable[[int, int], None] | None
    """Is told how many episodes have ended, and of how many."""
    attempt: Callable[[str], AbstractContextManager]
    """Stands around writes without which an evaluation counts all the same, by what they are of."""

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
    rollouts: Rollouts
    tracker: EpisodeTracker
    curriculum: BodyRateCurriculum | None
    learner: Any  # the recipe's Learner
    report: Report
    metrics: MetricsLog | UnwrittenMetrics
    schedule: Schedule  # log, evaluate, save
    checkpoints: RunCheckpoints
    best: BestCheckpoint
    counters: dict[str, int]  # env_steps, updates, episodes
    clock: RunClock
    lock: RunLock | LockHeldByFirst
    memory: KeptMemory = field(default_factory=KeptMemory, init=False)
    unsaved: dict[str, int] = field(default_factory=dict, init=False)  # since which env_steps what cannot be written
    say: Callable[[str], None] = field(default=logger.info, init=False)  # says a line of its own

    remedy: ClassVar[str] = "learning rate"  # what to lower once a loss is not finite, e.g. "ppo.learning_rate"

    @property
    def at_end(self) -> bool:
        """Whether all env_steps are made."""
        return self.counters["env_steps"] >= self.config.total_env_steps

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
        self.metrics.push(self.tracker.summary(episodes), len(episodes))
        self.metrics.push(self.rollouts.metrics())
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
            self.settle()
            return self.checkpoints.save(self.counters["env_steps"], self.clock.total)

    @contextmanager
    def attempt(self, what: str) -> Iterator[None]:
        """Stand around a write that may fail, as on a full disk, without ending the run: it is said, at once and on.

        Args:
            what: is written.
        """
        try:
            yield
        except (OSError, RunCheckpointError) as error:
            self.unsaved.setdefault(what, self.counters["env_steps"])
            said = str(error).rstrip(".")
            self.say(f"NOT SAVED: {what}: {said}. The run goes on, and tries again when the next is due.")
        else:
            self.unsaved.pop(what, None)

    def settle(self) -> None:
        """Take in the rollout that is under way, if there is one."""
        if (rollout := self.rollouts.drain()) is not None:
            self.take_in(rollout)

    def wait(self) -> None:
        """Wait until nothing else draws from the random numbers of this process, to set them back after a look."""
        self.rollouts.wait()

    def keep_up(self, progress: Progress) -> None:
        """Evaluate and log if it is due by now; of several processes the first does, and all take note."""
        env_steps = self.counters["env_steps"]
        due = self.schedule.due("log", env_steps, self.at_end)
        evaluates = self.schedule.due("evaluate", env_steps, self.at_end)
        if due:
            self.memory.trim()
        if not parallel.is_first():
            return
        if evaluates:
            self.say(self.evaluate())
        if due or evaluates:  # so that an evaluation's numbers stand where they were measured
            self.measure()
            progress.show(self.write_row(), self.unsaved)

    def write_row(self) -> dict[str, float]:
        """Write what was measured since the latest row; return its averages."""
        values = self.metrics.close_row(self.counters["env_steps"])
        with self.attempt("metrics"):
            self.metrics.flush()
        return values

    def evaluate(self) -> str:
        """Evaluate, without a trace in the random numbers of training; return a line on what came of it."""
        self.learner.check_finite()
        self.wait()
        devices = [self.learner.device] if self.learner.device.type == "cuda" else []
        with self.clock.timed("evaluate"), torch.random.fork_rng(devices=devices):
            torch.manual_seed(self.config.seed)
            metrics = self.report.make(self.counters["env_steps"], self.config.evaluation.stochastic)
            if self.config.logger.media:
                with self.attempt("pictures for loggers"):
                    log_evaluation(self.metrics.loggers, self.directory, self.counters["env_steps"])
        self.metrics.push(metrics)
        # Gates first, return where the gates are the same: a return lies far below a million.
        score = 1e6 * metrics.get("evaluation/gates_per_episode", 0.0) + metrics["evaluation/return_mean"]
        best = ""
        with self.attempt("the best checkpoint"):
            best = " (the best so far)" if self.best.offer(score, self.counters["env_steps"]) else ""
        names = {"gates": "gates_per_episode", "success": "success_rate", "return": "return_mean"}
        shown = {label: metrics.get(f"evaluation/{name}") for label, name in names.items()}
        numbers = ", ".join(f"{label} {value:.2f}" for label, value in shown.items() if value is not None)
        return f"evaluation at {self.counters['env_steps']:,} env_steps: {numbers}{best}"

    @property
    def last_good(self) -> str:
        """Which checkpoint is left when training breaks off."""
        try:
            return f"the last good checkpoint is {latest_checkpoint(self.directory.path)}"
        except FileNotFoundError:
            return "there is no checkpoint yet"

    def close(self) -> None:
        """End collection; free simulators and files."""
        self.rollouts.close()
        if not self.rollouts.has_worlds:
            self.env.close()  # which else belongs to the collector
        self.collector.shutdown()
        self.report.close()
        self.metrics.close()
        self.lock.release()


@dataclass(kw_only=True)
class ReplayRun(Run):
    """A run whose learner makes updates by the replay ratio, from a replay of what was collected."""

    replay: StreamReplay
    owed: UpdatesOwed

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        return max(0, self.owed.until(self.counters["env_steps"]) - self.counters["updates"])

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
            self.counters["updates"] = self.learner.updates
            self.after_update(batch, metrics)

    def close(self) -> None:
        """Remove files that held the replay, too."""
        shutil.rmtree(self.directory.replay, ignore_errors=True)
        super().close()

    def after_update(self, batch: TensorDictBase, metrics: dict[str, Tensor]) -> None:
        """Do what a recipe does with a batch that was learned from."""


def train(run: Run) -> None:
    """Collect and learn until `total_env_steps`; log, evaluate and save on the way.

    Raises:
        SystemExit: a signal came; everything is saved, and the status is the shell's for that signal.
        KeyboardInterrupt: another came meanwhile, which is its argument; what is since the last checkpoint is lost.
        WorkerError: what is collected elsewhere cannot be had; all that was delivered is saved.
        RunCheckpointError: at its end the run could not be saved.
        OSError: at its end metrics could not be written.
    """
    config, counters, leads = run.config, run.counters, parallel.is_first()
    with (
        graceful_exit() as stop,
        Progress(config.total_env_steps, counters["env_steps"], shown=leads) as progress,
    ):
        stop.say = progress.answer
        run.say, run.report.on_episode, run.report.attempt = progress.say, progress.evaluating, run.attempt
        run.rollouts.stopping = lambda: stop.signal_name is not None
        if leads and run.directory.finished_env_steps() > counters["env_steps"]:
            run.directory.finished.unlink()  # it goes on from before its end, which is to be reached again
        try:
            collect_and_learn(run, stop, progress)
        except WorkerError:
            run.save()
            raise
        saved = run.save()
        if stop.requested:
            at = f"at {counters['env_steps']:,} of {config.total_env_steps:,} env_steps"
            progress.say(f"{stop.signal_name} {at}: saved; continue with resume={run.directory.path}")
        elif leads:
            run.metrics.flush()
            run.directory.mark_finished(counters["env_steps"])
        progress.say(f"checkpoint: {saved}")
    if stop.signal_name:
        raise SystemExit(128 + signal.Signals[stop.signal_name])


def collect_and_learn(run: Run, stop: GracefulExit, progress: Progress) -> None:
    """Go on until all env_steps are made and learned from, or a stop is requested; `train` without its ends."""
    config, counters = run.config, run.counters
    minutes = Interval(config.checkpoint.minutes)
    run.learn(None, stop)  # what an interrupted run still owes
    while not stop.requested:
        by_steps = run.schedule.due("save", counters["env_steps"])
        by_minutes = parallel.agreed(minutes.due())  # both take note
        saves = by_steps or by_minutes
        if saves or run.at_end:  # what is under way may end the run, and what is evaluated last is what is saved
            run.settle()
            run.learn(None, stop)
        if not stop.requested:  # else a resumed run owes updates first
            run.keep_up(progress)
            if saves:
                with run.attempt("checkpoint"):
                    run.save()
        if run.at_end or stop.requested:
            break
        with run.clock.timed("collect"):
            rollout = next(run.rollouts, None)
            if rollout is None:  # only a stop ends them, if the next would not be there soon
                break
            run.take_in(rollout)
        progress.advance(counters["env_steps"])
        run.learn(rollout, stop)


def graceful_exit() -> GracefulExit:
    """Make the flag that a signal raises, in all processes together; one of them answers."""
    answer = "saving; again: abandons what is since the last checkpoint" if parallel.is_first() else ""
    return GracefulExit(answer, parallel.largest if parallel.count() > 1 else None)
