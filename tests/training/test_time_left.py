"""How long a run still takes, by clocks that are made up."""

from __future__ import annotations

import pytest

from dreamer_racing.training.time_left import MEASURED, REMEMBERED, SETTLING, TimeLeft

MEASURING = "measuring how long it takes"
TOTAL = 1_000_000


class Run:
    """A run by a clock of its own."""

    def __init__(self, env_steps: int = 0, updates: int = 0) -> None:
        self.now, self.env_steps, self.updates = 0.0, env_steps, updates
        self.left = TimeLeft(TOTAL, env_steps, updates, clock=lambda: self.now)

    def go(self, seconds: float, speed: float, learns: bool = True) -> list[str]:
        """Collect rollouts of a second each; return the different answers on the way."""
        said = []
        for _ in range(round(seconds)):
            self.now += 1.0
            self.env_steps += round(speed)
            self.updates += learns
            self.left.advance(self.env_steps, self.updates)
            said.append(str(self.left))
        return list(dict.fromkeys(said))

    def seconds_left(self) -> float:
        hours, minutes, seconds = str(self.left).removesuffix(" to go").split(":")
        return 3600 * int(hours) + 60 * int(minutes) + int(seconds)


@pytest.mark.parametrize("resumed", [False, True])
def test_the_first_answer_is_of_half_a_minute_of_learning(resumed: bool) -> None:
    run = Run(5000, 700) if resumed else Run()
    assert run.go(60, speed=2000, learns=False) == [MEASURING]  # fills the replay, ten times as fast
    run.now += 40.0  # the first update compiles
    assert run.go(1 + SETTLING + MEASURED - 1, speed=200) == [MEASURING]
    run.go(1, speed=200)
    assert run.seconds_left() == (TOTAL - run.env_steps) / 200
    first = run.seconds_left() + run.now
    run.go(120, speed=200)
    assert run.seconds_left() + run.now == first  # one answer


def test_rollouts_without_an_update_count_once_it_learns() -> None:
    """As where the replay ratio is low, or a rollout is short."""
    run = Run()
    run.go(2 + SETTLING, speed=100)
    for number in range(60):
        run.go(1, speed=100, learns=number % 4 == 0)
    assert run.seconds_left() == (TOTAL - run.env_steps) / 100


def test_an_evaluation_does_not_count_before_there_is_an_answer_and_does_after() -> None:
    run = Run()
    run.go(20, speed=100)
    run.left.disturb()
    run.now += 60.0
    run.go(1 + SETTLING + MEASURED, speed=100)
    assert run.seconds_left() == (TOTAL - run.env_steps) / 100
    run = Run()
    run.go(1 + SETTLING + MEASURED, speed=100)
    run.left.disturb()
    run.now += MEASURED  # half of all that was measured
    run.go(1, speed=100)
    assert run.seconds_left() == pytest.approx((TOTAL - run.env_steps) / 100 * 2, rel=0.05)


def test_a_machine_that_becomes_busy_is_noticed_after_a_while() -> None:
    run = Run()
    run.go(REMEMBERED, speed=100)
    run.go(3 * REMEMBERED, speed=50)
    assert run.seconds_left() == pytest.approx((TOTAL - run.env_steps) / 50, rel=0.1)


def test_a_run_that_went_past_its_end_has_nothing_left() -> None:
    run = Run(TOTAL - 200)
    run.go(2 + SETTLING + MEASURED, speed=10)
    assert run.env_steps > TOTAL and str(run.left) == "0:00:00 to go"


def test_a_run_that_does_not_advance_has_no_answer() -> None:
    run = Run()
    assert run.go(100, speed=0) == [MEASURING]
