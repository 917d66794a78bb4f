"""A watchdog thread that disarms the vehicle when the flight loop hangs.

A tick may hang in a graphics driver or an inference library, where Python runs no signal handler. Both are called with
the GIL released, so that other threads continue. If something hangs while it holds the GIL, or if the process is
stopped or killed, the watchdog cannot act: then the flight controller's failsafe is the only protection.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Lock, Thread

from dreamer_racing.hil.vehicle import Command, Link, at_rest

CHECKS = 10  # checks per timeout [choice]: the thread acts at most a tenth of the timeout late


class Watchdog:
    """Sends the loop's commands, and disarms the vehicle once the loop has sent none for too long.

    It then sends disarm frames until it is closed; if the loop recovers, its armed commands are replaced by disarm
    frames. A lock lets only one of loop and thread send at a time.

    Args:
        link: To the vehicle.
        longest: s allowed from an armed command to the next command.
        now: Returns the time of the loop's clock, s, which also runs while the loop sleeps.

    Attributes:
        acted: Whether it has taken over to disarm the vehicle.
        error: Error of its last disarm frame; None if that was sent.
    """

    def __init__(self, link: Link, longest: float, now: Callable[[], float]) -> None:
        self.acted = False
        self.error: Exception | None = None
        self._link, self._longest, self._now = link, longest, now
        self._armed_at: float | None = None  # when the last command was sent, if that was an armed one
        self._sending, self._closed = Lock(), Event()
        self._thread: Thread | None = None  # started with the first armed command: until then there is nothing to watch

    def send(self, command: Command) -> bytes:
        """Send a command as `Link.send` does; a disarmed one instead if the watchdog has acted."""
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
        """Return whether the loop has ever sent no command for too long (latched)."""
        if self._armed_at is not None and self._now() - self._armed_at > self._longest:
            self.acted = True
        return self.acted

    def _watch(self) -> None:
        """Send disarm frames if the loop is late, or ever was."""
        while not self._closed.wait(self._longest / CHECKS):
            with self._sending:
                if not self._is_late():
                    continue
                try:
                    sent = self._link.send(at_rest())
                    self.error = None if sent else OSError("the link did not send the disarm frame")
                except Exception as error:  # whatever failed, the next frame may get through
                    self.error = error
