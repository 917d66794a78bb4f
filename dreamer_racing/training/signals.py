"""A graceful end on a signal."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from dreamer_racing.terminal import leave_terminal

HANG_UP = getattr(signal, "SIGHUP", None)  # not on Windows
ENDING = [number for number in (signal.SIGINT, signal.SIGTERM, HANG_UP) if number is not None]


class GracefulExit:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag that a loop polls; a second signal raises `KeyboardInterrupt`.

    A signal that is ignored, as SIGHUP under `nohup` and SIGINT in a shell's background, stays ignored. SIGHUP says
    that the terminal is gone, perhaps several times, and is no second signal. The handlers from before are put back at
    exit. Outside the main thread, where Python allows no handlers, the flag is never set.

    Args:
        answer: Said at once at the first signal, after its name; nothing if empty.
        agree: Where several processes train together, what makes of each one's signal number (0: none yet) the one that
            all go by. Then `requested` is an exchange, for which all must ask equally often.

    Attributes:
        say: Says the answer, from within the handler: it may have interrupted a write to one of Python's streams.

    Example:
        >>> with GracefulExit() as stop:
        ...     while not stop.requested:
        ...         break
    """

    def __init__(self, answer: str = "", agree: Callable[[int], int] | None = None) -> None:
        self.say: Callable[[str], None] = say_at_once
        self._answer = answer
        self._agree = agree
        self._arrived = 0  # number of the signal that came to this process
        self.signal_name: str | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has arrived, at any process."""
        if self._agree and self.signal_name is None and (number := self._agree(self._arrived)):
            self.signal_name = signal.Signals(number).name
        return self.signal_name is not None

    def __enter__(self) -> GracefulExit:
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number).name
        if number == HANG_UP:
            leave_terminal()
        if self._arrived:
            if HANG_UP in (number, self._arrived):
                return
            raise KeyboardInterrupt(number)
        self._arrived = number
        if not self._agree:
            self.signal_name = name
        if self._answer:
            self.say(f"{name}: {self._answer}")


def say_at_once(text: str) -> None:
    """Say something on stderr from within a signal's handler, in a line below what stands there."""
    write_at_once(f"\n{text}\n")


def write_at_once(text: str) -> None:
    """Write to stderr past Python's streams, which take nothing while a write to them is interrupted."""
    with contextlib.suppress(OSError, ValueError):  # nobody listens any more
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, text.encode())
