"""What is on the screen of a terminal while a run goes, read off a small terminal of our own."""

from __future__ import annotations

import io
import logging
import os
import re
import shutil
import signal
import sys

import pytest

from dreamer_racing.training import live_table, signals
from dreamer_racing.training.live_table import LiveTable
from dreamer_racing.training.progress import Progress
from dreamer_racing.training.signals import GracefulExit

TRAINING = {"episode/return": 12.345, "episode/gates_passed": 3.0, "rate/updates": 5.5, "loss": 1.25}
EVALUATION = {"evaluation/success_rate": 0.5, "evaluation/return_mean": 30.25, "evaluation/lap_time_mean": 4.5}


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


def test_what_is_said_stands_above_and_the_table_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with Progress(total=100) as progress:
        progress.show(TRAINING)
        progress.say("evaluation at 50 env_steps: gates 3.00 (the best so far)")
    assert terminal.screen[0] == "evaluation at 50 env_steps: gates 3.00 (the best so far)"
    assert terminal.screen[1].startswith("  0%|") and terminal.screen[3].split()[:3] == ["training", "0", "12.35"]
    assert terminal.screen[5:] == [""]  # what a shell prints next begins below


def test_what_is_logged_stands_above_and_the_table_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    monkeypatch.setattr(logging.root, "handlers", [handler := logging.StreamHandler(terminal)])
    with Progress(total=100) as progress:
        progress.show(TRAINING)
        logging.getLogger("dreamer_racing.test").warning("the disk is slow\nfor 5 s")
        progress.show(TRAINING | {"loss": 0.75})
        assert terminal.screen[:2] == ["the disk is slow", "for 5 s"] and len(terminal.screen) == 6
        assert terminal.screen[2].startswith("  0%|") and terminal.screen[4].split()[:3] == ["training", "0", "12.35"]
    assert logging.root.handlers == [handler]


@pytest.mark.parametrize("number", range(1, 42))
def test_ctrl_c_is_answered_above_whatever_is_being_drawn(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch, terminal=(interrupted := Interrupted(10**9)))
    monkeypatch.setattr(signals, "write_at_once", terminal.write)
    monkeypatch.setattr(live_table, "write_at_once", terminal.write)
    monkeypatch.setattr(logging.root, "handlers", [logging.StreamHandler(terminal)])
    with GracefulExit("saving") as stop, Progress(total=100) as progress:
        stop.say = progress.answer
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
        progress.say("saved")
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
