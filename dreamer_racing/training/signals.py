"""Graceful end of a run on a signal, also of one that another process started."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from dreamer_racing.terminal import leave_terminal, say

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class GracefulExit:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag that a loop polls; a second signal raises `KeyboardInterrupt`.

    A signal that is ignored, such as SIGHUP under `nohup` and SIGINT of a shell's background job, stays ignored. SIGHUP
    means that the terminal is gone; it may come several times, and does not count as a second signal. The previous
    handlers are restored at exit. Outside the main thread, where Python allows no handlers, the flag is never set.

    Args:
        answer: Text to print at the first signal, after its name; empty for none.

    Attributes:
        number: Number of the first signal; 0 before.
        write: Function that prints the answer from within the handler, which may have interrupted a write to a stream.

    Example:
        >>> with GracefulExit() as stop:
        ...     while not stop.requested:
        ...         break
    """

    def __init__(self, answer: str = "") -> None:
        self.number = 0
        self.write: Callable[[str], None] = say_at_once
        self._answer = answer
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether this process has received a signal."""
        return self.number != 0

    def __enter__(self) -> GracefulExit:
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            leave_terminal()
        if self.number:
            if signal.SIGHUP in (number, self.number):
                return
            raise KeyboardInterrupt(number)
        self.number = number
        if self._answer:
            self.write(f"{signal.Signals(number).name}: {self._answer}")


def run_passing_signals(command: list[str], log: Path) -> int:
    """Run a training in a process of its own, with its output at the end of a file; return its exit status.

    Signals are passed on as SIGTERM, so that it saves and ends. Then this process ends too, or calls the handler that
    the signal had before: that of a Slurm job queues the job again.
    """
    received: list[signal.Signals] = []
    passed_on = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
    here = threading.current_thread()  # only the main thread may set handlers
    before = {number: signal.getsignal(number) for number in passed_on} if here is threading.main_thread() else {}
    if before.get(signal.SIGHUP) is signal.SIG_IGN:  # nohup
        del before[signal.SIGHUP]
    for number in before.keys() & {signal.SIGUSR1, signal.SIGUSR2}:
        signal.signal(number, signal.SIG_IGN)  # inherited by the training, since Slurm signals every process
    with (
        log.open("a", encoding="utf-8") as file,
        subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True) as process,
    ):

        def pass_on(number: int, frame: object) -> None:
            received.append(signal.Signals(number))
            process.send_signal(signal.SIGTERM)

        for number in before:
            signal.signal(number, pass_on)
        status = process.wait()
    for number, handler in before.items():
        signal.signal(number, handler)
    if received:
        say(f"{log.parent}: interrupted by {received[0].name}")
        handler = before[received[0]]
        if received[0] in (signal.SIGUSR1, signal.SIGUSR2) and callable(handler):
            handler(received[0], None)
        raise SystemExit(128 + received[0])
    return status


def say_at_once(text: str) -> None:
    """Write text to stderr from within a signal handler, on a new line."""
    write_at_once(f"\n{text}\n")


def write_at_once(text: str) -> None:
    """Write to stderr without Python's streams, which cannot be used while a write to them is interrupted."""
    with contextlib.suppress(OSError, ValueError):  # stderr is closed
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, text.encode())
