"""How long a run still takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta

SETTLING, MEASURED, REMEMBERED = 5.0, 30.0, 600.0
"""Seconds of learning that are left out, that are measured before there is an answer, and that count [choice].

The first updates are slower than all others; after a while a machine may be busier or less so.
"""


class TimeLeft:
    """Tells how long a run still takes, from half a minute in which it learned.

    Filling a replay is no learning, and an evaluation in that half minute would count for too much: both are left out.
    Once there is an answer, evaluations count, as they do in the rest of the run.

    Args:
        total: env_steps at the end.
        env_steps: those at the beginning.
        updates: those at the beginning.
        clock: in seconds.

    Example:
        >>> left = TimeLeft(1000, clock=iter([0.0, 1.0, 10.0, 20.0, 60.0]).__next__)
        >>> for env_steps, updates in ((100, 0), (200, 1), (300, 2)):
        ...     left.advance(env_steps, updates)
        >>> str(left)
        'measuring how long it takes'
        >>> left.advance(700, updates=10)
        >>> str(left)
        '0:00:30 to go'
    """

    def __init__(
        self, total: int, env_steps: int = 0, updates: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._total, self._clock = total, clock
        self._env_steps, self._updates, self._since = env_steps, updates, clock()
        self._learns, self._disturbed = False, False
        self._settled = 0.0  # seconds
        self._seconds, self._steps = 0.0, 0.0  # measured

    @property
    def measured(self) -> bool:
        """Whether there is an answer."""
        return self._seconds >= MEASURED

    def advance(self, env_steps: int, updates: int) -> None:
        """Take note of how far the run is, and how many updates it has made."""
        now = self._clock()
        seconds, steps = now - self._since, env_steps - self._env_steps
        if self._learns and (self.measured or not self._disturbed):
            if self._settled < SETTLING:
                self._settled += seconds
            else:
                self._seconds += seconds
                self._steps += steps
        self._learns = self._learns or updates > self._updates
        if self._seconds > REMEMBERED:
            self._seconds, self._steps = self._seconds / 2, self._steps / 2
        self._env_steps, self._since, self._disturbed = env_steps, now, False

    def disturb(self) -> None:
        """Take note of an evaluation."""
        self._disturbed = True

    def __str__(self) -> str:
        """Hours, minutes and seconds, or that they are being measured."""
        if not self.measured or not self._steps:
            return "measuring how long it takes"
        remaining = max(0, self._total - self._env_steps)  # the last rollout may go past the end
        return f"{timedelta(seconds=round(remaining * self._seconds / self._steps))} to go"
