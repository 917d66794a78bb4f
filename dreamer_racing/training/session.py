"""Training session: everything around the loop of a recipe, which collects and learns.

Several processes may train together (`parallel`): they run the loop in lockstep, each with its own environments and
replay; counters and statistics of episodes cover all processes, and only rank 0 logs and evaluates.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from signal import Signals
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.record.loggers import Logger

from dreamer_racing import parallel
from dreamer_racing.experience.rollouts import CollectorState, Rollouts, WorkerError
from dreamer_racing.machine import KeptMemory
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, setting
from dreamer_racing.training.checkpoint import BestCheckpoint, RunCheckpointError, RunCheckpoints
from dreamer_racing.training.directory import RunDirectory, RunLock, latest_checkpoint
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.metrics import CPU_CLOCK, Journal, MetricsLog
from dreamer_racing.training.progress import Interval, Periods, Progress, RunClock
from dreamer_racing.training.signals import GracefulExit

logger = logging.getLogger(__name__)

OF_EACH_PROCESS = ("env", "tracker", "collector", "replay", "storage")
"""Parts that differ between processes; `storage` holds collected steps of the process's environments."""
ENVIRONMENT_PARTS = ("env", "collector")
"""Parts that a run with workers does not have; if a checkpoint lacks them, the environments are reset on resume."""
FIRST_CHECKPOINT = 1.5
"""Minutes until the first checkpoint of a run that saves during training: within two of its start [choice]."""


@dataclass
class EvaluationConfig:
    """Evaluation during training."""

    every: int = setting(25_000, NOT_NEGATIVE)  # env_steps between evaluations; 0 turns them off
    first: int = setting(0, NOT_NEGATIVE)  # env_steps of an additional early evaluation; 0 for none
    episodes: int = setting(8, COUNT)
    stochastic: bool = False  # also evaluate the stochastic policy
    # randomisation of starts, as a multiple of that in training; 0: all episodes begin at the start pose
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    video_steps: int = setting(500, COUNT)  # control steps in the video


class Evaluator(Protocol):
    """Evaluates a learner's policy."""

    on_episode: Callable[[int, int], None] | None
    """Called with the number of finished episodes and the total."""
    attempt: Callable[[str], AbstractContextManager]
    """Makes the context manager of writes that may fail without failing the evaluation; see `Session.attempt`."""

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Evaluate the policy, write plots and videos, and return metrics."""
        ...

    def close(self) -> None:
        """Close the simulators."""
        ...


class Session:
    """Training run without its algorithm: saves and restores, counts, logs, evaluates, and ends the loop.

    Args:
        config: Config of the recipe: any object with the fields `total_env_steps`, `seed`, `resume`, `logger` (`every`,
            `media`), `evaluation` (`every`, `first`, `stochastic`) and `checkpoint` (`every`, `minutes`, `keep`).
        directory: Run directory.
        lock: Its lock, in rank 0.
        note_start: Function of env_steps that records the start and its configuration in the run directory.
        make_loggers: Makes the loggers besides ``metrics.csv``; its argument is the env_steps of the last row that a
            resumed run keeps, or None for a new run.

    Attributes:
        counters: Numbers of `env_steps`, `updates` and `episodes` so far.
        timed: Function from the name of an activity to a context manager that adds up the time spent inside.
        began: Whether the loop has started; errors before that are mistakes of the user's configuration.
        parts: Parts that are saved, by name; see `track`.
        metrics: Log of metrics, once `track` was called; None in ranks other than 0.

    Example:
        >>> # session.track(learner=learner, env=env, rollouts=rollouts, evaluator=evaluator, tracker=tracker)
        >>> # for rollout in session.rollouts():
        >>> #     if rollout is not None:
        >>> #         session.log_episodes(rollout)
        >>> #         session.log(learner.update(rollout))
        >>> #     if session.due("evaluate"):
        >>> #         session.evaluate()
        >>> #     if session.due("log"):
        >>> #         session.write_row()
        >>> #     session.save_if_due()
    """

    def __init__(
        self,
        config: Any,
        directory: RunDirectory,
        lock: RunLock | None,
        note_start: Callable[[int], None],
        make_loggers: Callable[[int | None], Sequence[Logger]] = lambda resumed: (),
    ) -> None:
        self.config, self.directory = config, directory
        self.counters = {"env_steps": 0, "updates": 0, "episodes": 0}
        self._clock = RunClock(self.counters, alone=parallel.num_processes() == 1)
        self.timed = self._clock.timed
        self.began = False
        self.parts: dict[str, Any] = {}
        self.metrics: MetricsLog | None = None
        self.write_line: Callable[[str], None] = logger.info
        self._lock, self._note_start, self._make_loggers = lock, note_start, make_loggers
        every = {"log": config.logger.every, "evaluate": config.evaluation.every, "save": config.checkpoint.every}
        self._periods = Periods({"evaluate": config.evaluation.first}, **every)
        self._minutes = Interval(config.checkpoint.minutes, FIRST_CHECKPOINT if config.checkpoint.every else 0.0)
        self._memory = KeptMemory()
        self._unsaved: dict[str, int] = {}  # by name of what cannot be written: env_steps since when
        self._stack = ExitStack()  # signals and progress
        self._stop = GracefulExit()
        self._progress = Progress(0, shown=False)
        self._signal = 0  # number of the signal that some process has received
        self._due: dict[str, bool] = {}  # what is due after this rollout, once asked
        self._saves = False  # whether to save after this rollout
        self._another_follows = False  # whether another rollout is delivered before evaluating or saving
        self._complete = False  # whether only the last evaluation and the last save are left

    @property
    def env_steps(self) -> int:
        """Control steps so far, summed over environments."""
        return self.counters["env_steps"]

    @property
    def at_end(self) -> bool:
        """Whether the run has reached its total env_steps."""
        return self.env_steps >= self.config.total_env_steps

    @property
    def stopping(self) -> bool:
        """Whether any process has received a signal; all processes must read it equally often."""
        self._signal = self._signal or parallel.all_reduce_max(self._stop.number)
        return self._signal != 0

    def track(
        self,
        *,
        learner: Any,
        env: EnvBase,
        rollouts: Rollouts,
        evaluator: Evaluator | None,
        tracker: EpisodeTracker,
        best: Sequence[str] = (),
        **parts: Any,
    ) -> None:
        """Register the parts of the run, which checkpoints hold; restore them if the run is resumed.

        Ranks other than 0 have no evaluator. Besides the learner, the best checkpoint holds the parts that ``best``
        names. Further ``parts`` are those of `RunCheckpoints`.
        """
        self.learner, self.env, self.collected = learner, env, rollouts
        self.evaluator, self.tracker = evaluator, tracker
        worlds = {"env": env, "collector": CollectorState(rollouts.collector)} if rollouts.has_worlds else {}
        journal = Journal(self._periods.latest)
        self.parts = {"learner": learner, "counters": self.counters, **worlds, "tracker": tracker, **parts}
        self.parts["journal"] = journal
        path, resume = self.directory.path, self.config.resume
        self.checkpoints = RunCheckpoints(path, self.parts, self.config.checkpoint.keep, OF_EACH_PROCESS)
        if resume:
            self._clock.total = self.checkpoints.load(resume, may_lack=ENVIRONMENT_PARTS)
            updates = self.counters["updates"]
            logger.info("resumed %s at %s env_steps, %s updates", resume, f"{self.env_steps:,}", f"{updates:,}")
            rollouts.begin_at(self.env_steps)
        if not rollouts.has_worlds:  # the CPU time of workers on Ray is not known here
            self._clock.total = {name: seconds for name, seconds in self._clock.total.items() if name != CPU_CLOCK}
        kept = ("learner", "counters", *best)
        self.best = BestCheckpoint(path, {name: self.parts[name] for name in kept}, self.env_steps)
        parallel.run_in_all(lambda: None)  # a barrier: all have read the files that are now rewritten
        if parallel.is_first():
            self.directory.set_aside_after(self.env_steps)
            self._note_start(self.env_steps)
            resumed = journal.written if resume else None
            self.metrics = MetricsLog(path, self._make_loggers(resumed), resumed, journal)
        logger.info("run directory: %s", path)

    def rollouts(self) -> Iterator[TensorDictBase | None]:
        """Yield rollouts ``[N, T]`` until the total env_steps are reached or a signal came; then save everything.

        A resumed run first yields None, so that updates, evaluations or metric rows which were still due come before
        new rollouts. If a rollout is in progress when the run is saved or ends, it is delivered first.

        Raises:
            SystemExit: A signal came; everything is saved, and the status is the shell's for that signal.
            KeyboardInterrupt: A second signal came, which is the argument; the run since the last checkpoint is lost.
            WorkerError: Workers failed; everything that was delivered is saved.
            RunCheckpointError: The run could not be saved at its end.
            OSError: Metrics could not be written at its end.
        """
        self._begin()
        if self.env_steps:
            self._count(None)
            yield None
        try:
            while not (self.at_end or self.stopping):
                with self.timed("collect"):
                    rollout = next(self.collected, None)
                if rollout is None:  # only on a stop, if the next rollout would take too long
                    break
                yield from self._deliver(rollout)
            if (rollout := self.collected.drain()) is not None:
                self._count(rollout)
                yield rollout
        except WorkerError:
            self.save()
            raise
        self._end()

    def _deliver(self, rollout: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield a rollout, and also the one in progress if the run is to be saved or ends."""
        self._count(rollout)
        under_way, failure = None, None
        if self._saves or self.at_end:
            try:
                under_way = self.collected.drain()
            except WorkerError as error:  # raised once this rollout, which is counted, has been learned from
                failure = error
        self._another_follows = under_way is not None
        yield rollout
        if failure is not None:
            if not self.at_end:
                raise failure
            self.write_line(f"workers were lost after the last rollout that was needed: {failure}")
        if under_way is not None:
            self._count(under_way, saves=self._saves)
            yield under_way

    def _count(self, rollout: TensorDictBase | None, saves: bool = False) -> None:
        """Count a rollout that is about to be delivered, and decide whether to save after it."""
        if rollout is not None:
            self.counters["env_steps"] += rollout.numel() * parallel.num_processes()
            self._progress.advance(self.env_steps, self.counters["updates"])
        by_steps = self._periods.due("save", self.env_steps)
        by_minutes = parallel.broadcast(self._minutes.due())  # not short-circuited: both must be updated
        self._saves = saves or by_steps or by_minutes
        self._due = {}
        self._another_follows = False

    def log_episodes(self, rollout: TensorDictBase) -> TensorDictBase:
        """Log and return the episodes that ended in a rollout, of all processes: ``[E]`` of `EpisodeTracker.update`."""
        episodes = parallel.all_gather_rows(self.tracker.update(rollout))
        self.counters["episodes"] += len(episodes)
        self.log(self.tracker.summary(episodes), len(episodes))
        self.log(self.collected.metrics())
        return episodes

    def log(self, metrics: Mapping[str, Tensor | float], count: int = 1) -> None:
        """Add metrics, each the mean of ``count`` values, to the averages of the next row."""
        if self.metrics is not None:
            self.metrics.push(metrics, count)

    def updates(self, due: int) -> Iterator[int]:
        """Yield the numbers of ``due`` updates, and count them; stop after a signal (a resumed run makes the rest)."""
        for number in range(due):
            if self.stopping:
                self._complete = False  # even if the loop asks what is due before its updates
                return
            yield number
            self.counters["updates"] += 1

    def due(self, name: str) -> bool:
        """Return whether to ``evaluate`` or to ``log`` now; always False in ranks other than 0.

        After an evaluation, metrics are also logged, so that its numbers get the env_steps at which they were measured.
        Nothing is due after a signal, because the resumed run has updates to make first.
        """
        if not self._due:
            ready = not self.stopping and not self._another_follows
            self._complete = ready and self.at_end
            self._due = {
                each: ready and self._periods.due(each, self.env_steps, self.at_end) for each in ("log", "evaluate")
            }
            if self._saves or any(self._due.values()):
                self._memory.trim()
        return parallel.is_first() and (self._due[name] or (name == "log" and self._due["evaluate"]))

    def evaluate(self) -> None:
        """Evaluate without changing training's random state, and save the best checkpoint if the score is higher."""
        assert self.evaluator is not None, "only rank 0 has an evaluator"
        assert self.metrics is not None, "track() makes them"
        self.learner.check_finite()
        devices = [self.learner.device] if self.learner.device.type == "cuda" else []
        with self.timed("evaluate"), torch.random.fork_rng(devices=devices):
            torch.manual_seed(self.config.seed)
            metrics = self.evaluator.make(self.env_steps, self.config.evaluation.stochastic)
            if self.config.logger.media:
                with self.attempt("pictures for loggers"):
                    self.metrics.log_evaluation(self.env_steps)
        self.log(metrics)
        # Rank by gates, then by return, which is far below a million.
        score = 1e6 * metrics.get("evaluation/gates_per_episode", 0.0) + metrics["evaluation/return_mean"]
        best = ""
        with self.attempt("the best checkpoint"):
            best = " (the best so far)" if self.best.offer(score, self.env_steps) else ""
        names = {"gates": "gates_per_episode", "success": "success_rate", "return": "return_mean"}
        shown = {label: metrics.get(f"evaluation/{name}") for label, name in names.items()}
        numbers = ", ".join(f"{label} {value:.2f}" for label, value in shown.items() if value is not None)
        self.write_line(f"evaluation at {self.env_steps:,} env_steps: {numbers}{best}")

    def write_row(self, metrics: Mapping[str, Tensor | float] | None = None) -> None:
        """Write and show a row: the averages of the metrics logged since the latest row, and of these metrics."""
        assert self.metrics is not None, "only rank 0 writes rows"
        self.log(self._clock.read() | dict(metrics or {}))
        values = self.metrics.close_row(self.env_steps)
        with self.attempt("metrics"):
            self.metrics.flush()
        self._progress.show(values, self._unsaved)

    def save_if_due(self) -> None:
        """Save everything if it is due by env_steps or by time."""
        if self._saves and not self._another_follows and not self.stopping:
            with self.attempt("checkpoint"):
                self.save()

    def save(self) -> Path:
        """Save everything, unless an update was not finite or the networks differ between processes."""
        with self.timed("save"):
            self.learner.check_finite()  # first, because NaN weights never compare equal
            parallel.check_same(getattr(self.learner, "weights", []))
            return self.checkpoints.save(self.env_steps, self._clock.total)

    @contextmanager
    def attempt(self, what: str) -> Iterator[None]:
        """Context of a named write that may fail, as on a full disk; the failure is shown until one succeeds."""
        try:
            yield
        except (OSError, RunCheckpointError) as error:
            self._unsaved.setdefault(what, self.env_steps)
            reason = str(error).rstrip(".")
            self.write_line(f"NOT SAVED: {what}: {reason}. The run continues, and tries again at the next save.")
        else:
            self._unsaved.pop(what, None)

    @property
    def last_good(self) -> str:
        """Description of the latest checkpoint, for the message when training fails."""
        try:
            return f"the last good checkpoint is {latest_checkpoint(self.directory.path)}"
        except FileNotFoundError:
            return "there is no checkpoint yet"

    def close(self) -> None:
        """End collection, close simulators and files, and delete the files of a memory-mapped replay."""
        self._stack.close()
        if self.parts:
            self.collected.close()
            if not self.collected.has_worlds:
                self.env.close()  # else the collector closes it
            self.collected.collector.shutdown()
            shutil.rmtree(self.directory.replay, ignore_errors=True)
            if self.evaluator is not None:
                self.evaluator.close()
            if self.metrics is not None:
                self.metrics.close()
        if self._lock is not None and self.parts:
            self._lock.release()
        elif self._lock is not None:
            self._lock.abandon()

    def _begin(self) -> None:
        """Start to handle signals and to show progress."""
        self.began = True
        first = parallel.is_first()
        answer = "saving; a second signal discards all since the last checkpoint" if first else ""
        self._stop = self._stack.enter_context(GracefulExit(answer))
        begun = self.env_steps, self.counters["updates"]
        self._progress = self._stack.enter_context(Progress(self.config.total_env_steps, *begun, shown=first))
        self._stop.write, self.write_line = self._progress.write_from_handler, self._progress.write_line
        if self.evaluator is not None:
            self.evaluator.on_episode, self.evaluator.attempt = self._progress.evaluating, self.attempt
        self.collected.stopping = lambda: self._stop.requested
        if first and self.directory.finished_env_steps() > self.env_steps:
            self.directory.finished.unlink()  # the run resumes from before its end

    def _end(self) -> None:
        """Save everything, and report how the run ended.

        A signal that comes during the last evaluation or the last save changes nothing: no update is left to make.
        """
        stopped = self.stopping and not self._complete
        saved = self.save()
        if stopped:
            at = f"{Signals(self._signal).name} at {self.env_steps:,} of {self.config.total_env_steps:,} env_steps"
            self.write_line(f"{at}: saved; continue with resume={self.directory.path}")
        elif self.metrics is not None:
            self.metrics.flush()
            self.directory.mark_finished(self.env_steps)
        self.write_line(f"checkpoint: {saved}")
        self._stack.close()
        if stopped:
            raise SystemExit(128 + self._signal)
