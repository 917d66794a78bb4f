"""Where a run stands: its clocks, its progress, the time left, and the table that a terminal shows."""

from __future__ import annotations

import io
import logging
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from dreamer_racing.training import signals
from dreamer_racing.training.progress import (
    COLUMNS,
    MEASURED,
    REMEMBERED,
    SETTLING,
    LiveTable,
    Progress,
    RunClock,
    TimeLeft,
)
from dreamer_racing.training.signals import GracefulExit


def test_waiting_takes_wall_clock_alone_and_computing_both():
    clock = RunClock({})
    before = clock.read()
    time.sleep(0.2)
    waited, start = clock.read(), time.process_time()
    while time.process_time() - start < 0.05:
        pass
    computed = clock.read()
    assert waited["wall_clock"] - before["wall_clock"] >= 0.2
    assert 0.0 <= waited["cpu_clock"] - before["cpu_clock"] < 0.1
    assert computed["wall_clock"] - waited["wall_clock"] >= 0.049
    assert computed["cpu_clock"] - waited["cpu_clock"] >= 0.03  # read in 1/100 s


def test_a_continued_run_goes_on_where_it_was_and_has_no_rates_of_what_was_before():
    counters = {"updates": 0}
    clock = RunClock(counters)
    counters["updates"] = 1_000_000  # restored
    clock.total = {"wall_clock": 100.0, "cpu_clock": 60.0, "score": 1.0}
    assert clock.total.keys() == {"wall_clock", "cpu_clock"}
    found = clock.read()
    assert 100.0 <= found["wall_clock"] < 110.0 and 60.0 <= found["cpu_clock"] < 70.0 and found["rate/updates"] == 0.0


def test_what_an_older_run_did_not_record_stays_unknown():
    """From zero it would say that all before the start was free."""
    clock = RunClock({})
    clock.total = {"wall_clock": 100.0}
    assert clock.total.keys() == {"wall_clock"} and "cpu_clock" not in clock.read()
    clock.total = {"wall_clock": 100.0, "cpu_clock": 5.0}
    assert "cpu_clock" not in clock.read()


def test_one_of_several_processes_knows_the_wall_clock_alone():
    assert RunClock({}, alone=False).read().keys() == {"wall_clock"}


# What a run says of itself in a log; what it shows in a terminal is below.


TRAINING = {"episode/return": 12.345, "episode/gates_passed": 3.0, "rate/updates": 5.5, "loss": 1.25}
EVALUATION = {"evaluation/success_rate": 0.5, "evaluation/return_mean": 30.25, "evaluation/lap_time_mean": 4.5}


def test_a_log_gets_whole_lines_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=1_000_000, env_steps=500_000, seconds=0.0) as progress:
        progress.show({"evaluation/success_rate": 0.5, "evaluation/lap_time_mean": 4.5})
        progress.advance(512_000, updates=0)
        progress.show(TRAINING)
        progress.write_line("evaluation at 512,000 env_steps")
    said = capsys.readouterr()
    assert "\r" not in said.err + said.out
    first, second = said.err.splitlines()
    assert (
        "500,000 of 1,000,000 env_steps, 0/s, measuring how long it takes: evaluation: success 50%, lap (s) 4.50"
        in first
    )
    assert "512,000 of 1,000,000 env_steps" in second
    assert second.endswith(
        "it takes: return 12.35, gates 3.00, loss 1.25, updates/s 5.50; evaluation: success 50%, lap (s) 4.50"
    )
    assert said.out.endswith("evaluation at 512,000 env_steps\n")


def test_a_log_shows_what_a_terminal_does(capsys: pytest.CaptureFixture[str]) -> None:
    metrics = {name: 0.5 for shown in COLUMNS.values() for name in (shown.training, shown.evaluation) if name}
    Progress(total=10, seconds=0.0).show(metrics)
    trained, evaluated = capsys.readouterr().err.partition("it takes: ")[2].strip().split("; evaluation: ")
    assert [part.rpartition(" ")[0] for part in trained.split(", ")] == [w for w, s in COLUMNS.items() if s.training]
    assert [part.rpartition(" ")[0] for part in evaluated.split(", ")] == [
        w for w, s in COLUMNS.items() if s.evaluation
    ]


def test_what_is_not_saved_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    Progress(total=10, seconds=0.0).show(TRAINING, unsaved={"checkpoint": 5, "metrics": 1000})
    assert "NOT SAVED checkpoint since 5; metrics since 1,000" in capsys.readouterr().err


def test_a_log_that_takes_no_more_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full").open("w")  # noqa: SIM115 -- its end fails, as everything does
    monkeypatch.setattr(sys, "stdout", full)
    with Progress(total=100) as progress:
        progress.write_line("evaluation")
    with pytest.raises(OSError, match="No space left"):
        full.close()


def test_what_a_log_is_spared(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=10, seconds=0.0, shown=False) as progress:  # of several processes one alone speaks
        progress.show(TRAINING)
        progress.evaluating(12, 60)
        progress.write_line("evaluation")
    with Progress(total=10, seconds=3600.0) as progress:  # lines keep their distance, and evaluations have none
        for step in range(10):
            progress.advance(step, updates=0)
            progress.show(TRAINING)
            progress.evaluating(12, 60)
    assert capsys.readouterr() == ("", "")


# How long a run still takes, by clocks that are made up.


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


class Terminal(io.StringIO):
    """A terminal that knows what is written: new lines, carriage returns, one line up, and all below cleared."""

    def isatty(self) -> bool:
        return True

    @property
    def screen(self) -> list[str]:
        lines, row, column = [""], 0, 0
        for part in re.findall(r"\x1b\[[AJ]|[\r\n]|[^\r\n\x1b]+", self.getvalue()):
            if part == "\x1b[A":
                row -= 1
            elif part == "\x1b[J":
                lines[row:] = [lines[row][:column]]
            elif part == "\r":
                column = 0
            elif part == "\n":
                row, column = row + 1, 0
                lines += [""] * (row + 1 - len(lines))
            else:
                lines[row] = lines[row][:column].ljust(column) + part + lines[row][column + len(part) :]
                column += len(part)
        return [line.rstrip() for line in lines]


class Interrupted(Terminal):
    """A terminal where Ctrl-C is pressed just before a write, the number-th that comes, if there is one."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.left = number

    def write(self, text: str) -> int:
        self.left -= 1
        if self.left == 0:
            super().write("^C")
            os.kill(os.getpid(), signal.SIGINT)
        return super().write(text)


def open_terminal(monkeypatch: pytest.MonkeyPatch, columns: int = 100, terminal: Terminal | None = None) -> Terminal:
    """In a test, not in a fixture: between the two pytest puts streams of its own in place."""
    terminal = terminal or Terminal()
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, terminal)
    monkeypatch.setattr(shutil, "get_terminal_size", lambda *_, **__: os.terminal_size((columns, 40)))
    return terminal


def test_training_and_evaluation_have_a_row_each(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with Progress(total=1_000_000) as progress:
        progress.advance(100_000, updates=0)
        progress.show(TRAINING | EVALUATION)
        progress.advance(200_000, updates=0)
        progress.show(TRAINING | {"loss": 0.75})
        bar, head, training, evaluation = terminal.screen[:4]
    assert bar.startswith(" 20%|") and "200000/1000000" in bar and bar.endswith(", measuring how long it takes]")
    assert head.split() == ["env_steps", "return", "gates", "success", "lap", "(s)", "loss", "updates/s"]
    assert training.split() == ["training", "200,000", "12.35", "3.00", "–", "–", "0.75", "5.50"]
    assert evaluation.split() == ["evaluation", "100,000", "30.25", "–", "50%", "4.50", "–", "–"]


def test_the_bar_is_full_at_the_end_where_that_was_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with Progress(total=100) as progress:
        progress.advance(112, updates=0)
    assert terminal.screen[0].startswith("100%|") and "112/112" in terminal.screen[0]


def test_an_evaluation_shows_how_far_it_is_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with Progress(total=100) as progress:
        progress.evaluating(12, 60)
        assert terminal.screen[4].startswith("  evaluating") and terminal.screen[4].endswith("12 of 60 episodes")
        progress.evaluating(60, 60)
        progress.evaluating(1, 10)  # the next one, of the policy that samples
        assert terminal.screen[4].endswith("1 of 10 episodes")
        progress.show(EVALUATION)
    assert not any("evaluating" in line for line in terminal.screen)


def test_what_is_said_or_logged_stands_above_and_the_table_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, said = open_terminal(monkeypatch), "evaluation at 50 env_steps: gates 3.00 (the best so far)"
    monkeypatch.setattr(logging.root, "handlers", [handler := logging.StreamHandler(terminal)])
    with Progress(total=100) as progress:
        progress.show(TRAINING)
        progress.write_line(said)
        assert terminal.screen[0] == said and terminal.screen[1].startswith("  0%|")
        assert terminal.screen[3].split()[:3] == ["training", "0", "12.35"]
        logging.getLogger("dreamer_racing.test").warning("the disk is slow\nfor 5 s")
        progress.show(TRAINING | {"loss": 0.75})
        assert terminal.screen[:3] == [said, "the disk is slow", "for 5 s"] and len(terminal.screen) == 7
        assert terminal.screen[3].startswith("  0%|") and terminal.screen[5].split()[:3] == ["training", "0", "12.35"]
    assert terminal.screen[7:] == [""]  # what a shell prints next begins below
    assert logging.root.handlers == [handler]


@pytest.mark.parametrize("number", range(1, 42))
def test_ctrl_c_is_answered_above_whatever_is_being_drawn(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch, terminal=(interrupted := Interrupted(10**9)))
    monkeypatch.setattr(signals, "write_at_once", terminal.write)
    monkeypatch.setattr("dreamer_racing.training.progress.write_at_once", terminal.write)
    monkeypatch.setattr(logging.root, "handlers", [logging.StreamHandler(terminal)])
    with GracefulExit("saving") as stop, Progress(total=100) as progress:
        stop.write = progress.write_from_handler
        interrupted.left = number
        progress.evaluating(3, 5)
        logging.getLogger("dreamer_racing.test").warning("the disk is slow")
        progress.show(TRAINING)
        if interrupted.left > 0:  # by now between two drawings
            terminal.write("^C")
            os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested and terminal.screen.count("SIGINT: saving") == 1
        progress.advance(50, updates=0)
        progress.show(EVALUATION)
        progress.write_line("saved")
    screen = [line.replace("^C", "").rstrip() for line in terminal.screen]  # its echo stands where the cursor was
    assert sorted(screen[:3]) == ["SIGINT: saving", "saved", "the disk is slow"] and screen[2] == "saved"
    assert screen[3].startswith(" 50%|") and screen[4].split()[0] == "env_steps"
    assert screen[5].split()[:3] == ["training", "0", "12.35"] and screen[6].split()[:2] == ["evaluation", "50"]
    assert screen[7:] == [""]


def test_what_is_not_saved_is_said_until_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with Progress(total=10) as progress:
        progress.show(TRAINING, unsaved={"checkpoint": 5})
        assert "NOT SAVED: checkpoint since 5" in terminal.screen[0]
        progress.show(TRAINING)
        assert "NOT SAVED" not in terminal.screen[0]


def test_lines_end_where_a_narrow_terminal_does(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch, columns=50)
    table = LiveTable(total=100)
    table.show(TRAINING)
    table.close()
    assert terminal.screen[2].split() == ["training", "0", "12.35", "3.00"]
    assert max(len(line) for line in terminal.screen[1:]) < 50
