"""Signals that end a run: what counts, what does not, and what becomes of a terminal that is gone."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from dreamer_racing.training.signals import GracefulExit


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_is_a_request(number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_DFL)
    with GracefulExit() as stop:
        os.kill(os.getpid(), number)
        assert stop.requested and stop.signal_name == number.name
    assert signal.getsignal(number) is signal.SIG_DFL


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
        assert stop.signal_name == numbers[0].name


PROGRAM = """
import sys, time
from dreamer_racing.training.progress import Progress
from dreamer_racing.training.signals import GracefulExit
with GracefulExit("saving") as stop, Progress(total=1000) as progress:
    stop.say = progress.answer
    open(sys.argv[1], "w").close()
    while not stop.requested:
        time.sleep(0.01)
    for number in range(20):
        progress.advance(number, updates=0)
        progress.show({"episode/return": 1.0})
        progress.say("saved")
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
