"""A session of a run, and the signals that end it."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from dreamer_racing.experience.rollouts import Rollouts, WorkerError
from dreamer_racing.training.directory import RunDirectory, env_steps_of
from dreamer_racing.training.episodes import EpisodeTracker
from dreamer_racing.training.session import Session
from dreamer_racing.training.signals import GracefulExit


class OneAhead(Rollouts):
    """Collects one rollout ahead, as workers on Ray do, of worlds that are not saved."""

    has_worlds = False

    def __init__(self, steps: int, fails_after: int | None = None) -> None:
        self.collector = SimpleNamespace(shutdown=lambda: None)
        self._steps, self._under_way, self._left = steps, False, fails_after

    def __next__(self) -> TensorDictBase:
        if self._left is not None:
            self._left -= 1
            if self._left < 0:
                raise WorkerError("lost")
        self._under_way = True
        reward, done = torch.zeros(1, self._steps, 1), torch.zeros(1, self._steps, 1, dtype=torch.bool)
        return TensorDict({"next": {"reward": reward, "done": done}}, [1, self._steps])

    def drain(self) -> TensorDictBase | None:
        if not self._under_way:
            return None
        rollout, self._under_way = next(self), False
        return rollout


class Learner:
    """Counts updates."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        self.updates = 0

    def check_finite(self) -> None:
        pass

    def state_dict(self) -> dict[str, int]:
        return {"updates": self.updates}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.updates = state["updates"]


class Run:
    """A loop as a recipe has it, with an update for each env_step.

    Attributes:
        events: what was evaluated after how many updates, and saved after how many env_steps.
    """

    def __init__(
        self, path: Path, total: int, rollout: int, resume: bool = False, fails_after: Any = None, **saves: Any
    ):
        self.config = SimpleNamespace(
            total_env_steps=total,
            seed=0,
            resume=str(path) if resume else None,
            logger=SimpleNamespace(every=0, media=False),
            evaluation=SimpleNamespace(every=10 * total, first=0, stochastic=False),
            checkpoint=SimpleNamespace(**{"every": 0, "minutes": 0.0, "keep": 99} | saves),
        )
        self.events: list[tuple[str, int]] = []
        self.learner, self.on_update = Learner(), lambda updates: None
        self.on_update: Callable[[int], None]
        directory = RunDirectory(path)
        self.session = session = Session(self.config, directory, directory.claim(), lambda env_steps: None)
        report = SimpleNamespace(make=self._evaluate, close=lambda: None)
        env = SimpleNamespace(close=lambda: None)
        rollouts, tracker = OneAhead(rollout, fails_after), EpisodeTracker(1)
        session.track(learner=self.learner, env=env, rollouts=rollouts, evaluator=report, tracker=tracker)
        save = session.checkpoints.save

        def saved(env_steps: int, *rest: Any) -> Path:
            self.events.append(("saved", env_steps))
            assert self.learner.updates == env_steps or session.stopping, "nothing is left to learn"
            return save(env_steps, *rest)

        session.checkpoints.save = saved

    def _evaluate(self, env_steps: int, stochastic: bool) -> dict[str, float]:
        self.events.append(("evaluated", self.learner.updates))
        return {"evaluation/return_mean": 0.0}

    def go(self) -> list[tuple[str, int]]:
        session = self.session
        try:
            for rollout in session.rollouts():
                if rollout is not None:
                    session.log_episodes(rollout)
                for _ in session.updates(session.env_steps - self.learner.updates):
                    self.learner.updates += 1
                    self.on_update(self.learner.updates)
                if session.due("evaluate"):
                    session.evaluate()
                if session.due("log"):
                    session.write_row()
                session.save_if_due()
        finally:
            session.close()
        return self.events


@pytest.mark.parametrize("total", [40, 41, 48, 55])
@pytest.mark.parametrize("rollout", [1, 7, 33])
def test_a_run_ends_with_an_evaluation_of_all_that_it_made(total: int, rollout: int, tmp_path: Path) -> None:
    run = Run(tmp_path, total, rollout, every=10)
    events = run.go()
    assert run.session.at_end and run.learner.updates == run.session.env_steps == run.session.counters["updates"]
    assert [updates for event, updates in events if event == "evaluated"] == [run.learner.updates]
    assert events.index(("evaluated", run.learner.updates)) >= len(events) - 3  # and the best, and a save, after it
    assert RunDirectory(tmp_path).finished_env_steps() == run.session.env_steps


def test_what_is_saved_has_the_rollout_under_way_and_its_updates(tmp_path: Path) -> None:
    saved = [env_steps for event, env_steps in Run(tmp_path, total=40, rollout=4, every=10).go() if event == "saved"]
    assert saved[0] == 16  # due at 12, with the four that were under way


def test_a_policy_with_updates_left_to_make_is_evaluated_once_a_resumed_run_has_made_them(tmp_path: Path) -> None:
    run = Run(tmp_path, total=40, rollout=4)

    def stop(updates: int) -> None:
        if updates == 42:  # among the last ones, of the rollout that was under way at the end
            os.kill(os.getpid(), signal.SIGTERM)

    run.on_update = stop
    with pytest.raises(SystemExit) as ended:
        run.go()
    assert ended.value.code == 128 + signal.SIGTERM
    assert run.session.at_end and run.learner.updates == 42 < run.session.env_steps == 44
    assert run.events == [("saved", 44)] and not RunDirectory(tmp_path).finished.exists()
    resumed = Run(tmp_path, total=40, rollout=4, resume=True)
    assert (resumed.session.env_steps, resumed.learner.updates) == (44, 42)
    assert resumed.go()[0] == ("evaluated", 44) and RunDirectory(tmp_path).finished.exists()


@pytest.mark.parametrize("last", ["evaluation", "save"])
def test_a_run_with_nothing_left_to_learn_has_finished_whatever_signal_comes(tmp_path: Path, last: str) -> None:
    run = Run(tmp_path, total=40, rollout=4)
    owner, name = (run.session.evaluator, "make") if last == "evaluation" else (run.session.checkpoints, "save")
    make = getattr(owner, name)

    def interrupted(*rest: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return make(*rest)

    setattr(owner, name, interrupted)
    assert run.go()[0] == ("evaluated", 44) and run.events[-1] == ("saved", 44)
    assert RunDirectory(tmp_path).finished.exists()


def test_a_loop_may_ask_what_is_due_before_its_last_updates_and_is_still_stopped(tmp_path: Path) -> None:
    run = Run(tmp_path, total=40, rollout=4)

    def ask_and_stop(updates: int) -> None:
        if updates == 42:  # of 44
            run.session.due("log")
            os.kill(os.getpid(), signal.SIGTERM)

    run.on_update = ask_and_stop
    with pytest.raises(SystemExit):
        run.go()
    assert run.learner.updates == 42 and not RunDirectory(tmp_path).finished.exists()


@pytest.mark.parametrize("every", [0, 10])  # at 12 env_steps the rollout under way is awaited before a save
def test_what_was_delivered_before_workers_were_lost_is_saved(tmp_path: Path, every: int) -> None:
    run = Run(tmp_path, total=40, rollout=4, fails_after=3, every=every)
    with pytest.raises(WorkerError):
        run.go()
    assert run.learner.updates == 12, "of all that was delivered"
    assert [env_steps_of(path) for path in (tmp_path / "checkpoints").glob("checkpoint-*")] == [12]
    assert run.session._clock.total.keys() == {"wall_clock"}, "the CPU time of the workers is not known"


def test_what_was_delivered_is_saved_if_workers_are_lost_at_a_stop(tmp_path: Path) -> None:
    run = Run(tmp_path, total=40, rollout=4, fails_after=3)
    run.on_update = lambda updates: os.kill(os.getpid(), signal.SIGTERM) if updates == 12 else None
    with pytest.raises(WorkerError):
        run.go()
    assert run.events == [("saved", 12)]


@pytest.mark.parametrize(
    ("every", "minutes", "saved"), [(10**6, 0.0, [112, 204]), (0, 1.0, [76, 144, 204]), (0, 0.0, [204])]
)
def test_a_run_that_saves_on_the_way_does_so_within_two_minutes_and_then_by_the_clock(
    every: int, minutes: float, saved: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("dreamer_racing.training.progress.time.monotonic", lambda: now[0])
    run = Run(tmp_path, total=200, rollout=4, every=every, minutes=minutes)

    def pass_time(updates: int) -> None:
        now[0] = 60.0 * 0.015 * updates

    run.on_update = pass_time
    assert [env_steps for event, env_steps in run.go() if event == "saved"] == saved


# Signals that end a run: what counts, what does not, and what becomes of a terminal that is gone.


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_is_a_request_which_the_handler_answers_and_the_second_an_interrupt(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal.signal(number, signal.SIG_DFL)
    reader, writer = os.pipe()
    monkeypatch.setattr(sys, "__stderr__", os.fdopen(writer, "w"))
    with GracefulExit("saving") as stop:
        assert not stop.requested
        os.kill(os.getpid(), number)
        assert os.read(reader, 100) == f"\n{number.name}: saving\n".encode(), "before the loop asks"
        assert stop.requested and stop.number == number
        if number != signal.SIGHUP:
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - the signal may arrive a little later
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1)
    assert signal.getsignal(number) is signal.SIG_DFL
    os.close(reader)


def test_one_is_taken_where_nobody_reads_what_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)  # as after `| tee` has died of the same Ctrl-C
    monkeypatch.setattr(sys, "__stderr__", os.fdopen(writer, "w"))
    with GracefulExit("saving") as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_that_is_ignored_stays_ignored(number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_IGN)
    with GracefulExit() as stop:
        os.kill(os.getpid(), number)
        assert not stop.requested
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize(
    "numbers", [(signal.SIGHUP, signal.SIGHUP), (signal.SIGTERM, signal.SIGHUP), (signal.SIGHUP, signal.SIGTERM)]
)
def test_a_terminal_that_goes_is_no_second_signal(numbers: tuple[signal.Signals, ...]) -> None:
    with GracefulExit() as stop:
        for number in numbers:
            os.kill(os.getpid(), number)  # a KeyboardInterrupt would abandon the run
        assert stop.number == numbers[0]


PROGRAM = """
import sys, time
from dreamer_racing.training.progress import Progress
from dreamer_racing.training.signals import GracefulExit
with GracefulExit("saving") as stop, Progress(total=1000) as progress:
    stop.write = progress.write_from_handler
    open(sys.argv[1], "w").close()
    while not stop.requested:
        time.sleep(0.01)
    for number in range(20):
        progress.advance(number, updates=0)
        progress.show({"episode/return": 1.0})
        progress.write_line("saved")
        print("saved", flush=True)
open(sys.argv[1], "a").write("ended well")
"""


def test_a_program_whose_terminal_closes_goes_on_to_its_end(tmp_path: os.PathLike[str]) -> None:
    """The terminal's other end is closed: the kernel sends SIGHUP, and every write to it fails from then on."""
    note = os.path.join(tmp_path, "note")
    ours, theirs = pty.openpty()
    program = f"import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n{PROGRAM}"
    with subprocess.Popen(
        [sys.executable, "-c", program, note], stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
    ) as running:
        os.close(theirs)
        while not os.path.exists(note):
            assert running.poll() is None, os.read(ours, 10000).decode()
            os.set_blocking(ours, False)
        os.close(ours)
        assert running.wait(60) == 0
    with open(note, encoding="utf-8") as file:
        assert file.read() == "ended well"
