"""The loop of a training run: what is collected ahead, evaluated, and saved, and in which order."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from dreamer_racing.training.journal import Schedule
from dreamer_racing.training.run import collect_and_learn


class FakeRun:
    """Collects one rollout ahead, as `collector=overlapped` does, and owes an update for each env_step."""

    def __init__(self, total: int, rollout: int, save_every: int, minutes: float = 0.0) -> None:
        self.config = SimpleNamespace(total_env_steps=total, checkpoint=SimpleNamespace(minutes=minutes))
        self.counters = {"env_steps": 0}
        self.schedule = Schedule(evaluate=10 * total, save=save_every)
        self.clock = SimpleNamespace(timed=lambda name: nullcontext())
        self.updates = 0
        self.events: list[tuple[str, int]] = []
        self.on_update: Callable[[int], None] = lambda updates: None
        self._rollout, self._ahead = rollout, 0
        self.rollouts = self._collect()

    def _collect(self) -> Iterator[int]:
        while True:
            collected, self._ahead = self._ahead or self._rollout, self._rollout
            yield collected

    @property
    def at_end(self) -> bool:
        return self.counters["env_steps"] >= self.config.total_env_steps

    def settle(self) -> None:
        ahead, self._ahead = self._ahead, 0
        if ahead:
            self.take_in(ahead)

    def take_in(self, rollout: int) -> None:
        self.counters["env_steps"] += rollout

    def learn(self, rollout: int | None, stop: SimpleNamespace) -> None:
        while self.updates < self.counters["env_steps"] and not stop.requested:
            self.updates += 1
            self.on_update(self.updates)

    def keep_up(self, progress: object) -> None:
        if self.schedule.due("evaluate", self.counters["env_steps"], self.at_end):
            self.events.append(("evaluated", self.updates))

    def attempt(self, what: str) -> nullcontext:
        return nullcontext()

    def save(self) -> None:
        self.settle()
        self.events.append(("saved", self.counters["env_steps"]))


def go_on(run: FakeRun, stop: SimpleNamespace | None = None) -> None:
    collect_and_learn(run, stop or SimpleNamespace(requested=False), SimpleNamespace(advance=lambda env_steps: None))


@pytest.mark.parametrize("total", [40, 41, 44, 48, 50, 55])
@pytest.mark.parametrize("rollout", [1, 4, 7, 33])
def test_a_run_ends_with_an_evaluation_of_all_that_it_made(total: int, rollout: int) -> None:
    run = FakeRun(total, rollout, save_every=10)
    go_on(run)
    assert run.at_end
    assert run.updates == run.counters["env_steps"]
    evaluated = [updates for event, updates in run.events if event == "evaluated"]
    assert evaluated == [run.updates]
    assert run.events.index(("evaluated", run.updates)) >= len(run.events) - 2  # and at most a save after it


def test_what_is_saved_has_the_rollout_under_way_and_its_updates() -> None:
    run = FakeRun(total=40, rollout=4, save_every=10)
    saved: list[tuple[int, int]] = []
    run.save = lambda: saved.append((run.counters["env_steps"], run.updates))
    go_on(run)
    assert saved[0] == (16, 16)  # due at 12, with the four that were under way
    assert all(env_steps == updates for env_steps, updates in saved)


def test_a_policy_that_owes_updates_is_not_evaluated_when_a_stop_is_requested() -> None:
    run, stop = FakeRun(total=40, rollout=4, save_every=0), SimpleNamespace(requested=False)

    def request(updates: int) -> None:
        stop.requested = updates == 42  # among the last ones, of the rollout that was under way at the end

    run.on_update = request
    go_on(run, stop)
    assert run.at_end and run.updates == 42 < run.counters["env_steps"]
    assert run.events == []
    stop.requested, run.on_update = False, lambda updates: None
    go_on(run, stop)
    assert run.events == [("evaluated", run.counters["env_steps"])]
