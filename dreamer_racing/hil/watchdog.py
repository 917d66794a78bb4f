"""Who disarms the vehicle when the loop hangs: a thread that has only the link.

A tick may hang in a graphics driver or in an inference library, where Python runs no signal handler. Both are called
without Python's lock, so that other threads run on. Where something hangs with the lock held, or the process is stopped
or killed, nothing in it helps: then the flight controller's failsafe is the only guard.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Lock, Thread

from dreamer_racing.hil.vehicle import Command, Link, at_rest

CHECKS = 10
"""How often the thread looks within the time after which it acts [choice]: it acts a tenth later at most."""


class Watchdog:
    """Sends commands for the loop, and disarms the vehicle once the loop has sent none for too long.

    It sends disarm frames then until it is closed, and turns into one whatever the loop, should it come back, still
    wants to send. One command is sent at a time, by whichever of the two.

    Args:
        link: To the vehicle.
        longest: s from an armed command to the next one.
        now: The loop's clock, s; what passes on it while the loop sleeps or works counts.

    Attributes:
        acted: Whether it had to.
        error: What its last frame met, if it did not go out.
    """

    def __init__(self, link: Link, longest: float, now: Callable[[], float]) -> None:
        self.acted = False
        self.error: Exception | None = None
        self._link, self._longest, self._now = link, longest, now
        self._armed_at: float | None = None  # when the last command was sent, if that was an armed one
        self._sending, self._closed = Lock(), Event()
        self._thread: Thread | None = None  # begun with the first armed command: until then there is nothing to watch

    def send(self, command: Command) -> bytes:
        """Send a command now, as `Link.send` does; at rest if it has acted."""
        with self._sending:
            if command.armed and self._is_late():
                command = at_rest()
            self._armed_at = self._now() if command.armed else None
            sent = self._link.send(command)
        if command.armed and self._thread is None:
            self._thread = Thread(target=self._watch, daemon=True)
            self._thread.start()
        return sent

    def close(self) -> None:
        """End the thread; may be called twice."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join()

    def _is_late(self) -> bool:
        """Whether the loop has ever sent no command for too long; it is remembered."""
        if self._armed_at is not None and self._now() - self._armed_at > self._longest:
            self.acted = True
        return self.acted

    def _watch(self) -> None:
        while not self._closed.wait(self._longest / CHECKS):
            with self._sending:
                self._look()

    def _look(self) -> None:
        """Disarm the vehicle if the loop is late; again and again once it was."""
        if not self._is_late():
            return
        try:
            self.error = None if self._link.send(at_rest()) else OSError("the link did not take it")
        except Exception as error:  # whatever it is, the next one may get through
            self.error = error
