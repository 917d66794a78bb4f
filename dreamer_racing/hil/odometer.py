"""Whether the velocities that a source of poses claims are those of its own positions."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from dreamer_racing.hil.safety_limits import Vector
from dreamer_racing.hil.velocity import GAP


class _Mark(NamedTuple):
    """A pose, and how far the claimed velocities have led up to it."""

    time: float
    position: Vector
    velocity: Vector
    led: Vector


class Odometer:
    """Compares, over a window of time, where claimed velocities lead, by trapezoids, with where positions went.

    Args:
        window: s, that is looked back, at least; up to a pose more.

    Example:
        >>> odometer = Odometer(window=0.0625)
        >>> odometer.mismatch(0.0, (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)) is None
        True
        >>> odometer.mismatch(0.0625, (0.25, 0.0, 0.0), (5.0, 0.0, 0.0))  # it went at 4 m/s
        1.0
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._marks: deque[_Mark] = deque()

    def mismatch(self, time: float, position: Vector, velocity: Vector) -> float | None:
        """Take in a pose that is newer than the last; return by how much the mean velocities differ, m/s.

        Returns:
            None as long as poses do not span the window, be it since the first one or since a gap.
        """
        marks = self._marks
        last = marks[-1] if marks else None
        if last is None or time - last.time > GAP:
            marks.clear()
            led: Vector = (0.0, 0.0, 0.0)
        else:
            half = 0.5 * (time - last.time)
            led = tuple(
                so_far + half * (old + new) for so_far, old, new in zip(last.led, last.velocity, velocity, strict=True)
            )
        marks.append(_Mark(time, position, velocity, led))
        while len(marks) > 2 and time - marks[1].time >= self._window:
            marks.popleft()
        first, elapsed = marks[0], time - marks[0].time
        if elapsed < self._window or elapsed <= 0.0:
            return None
        went = (here - there for here, there in zip(position, first.position, strict=True))
        meant = (here - there for here, there in zip(led, first.led, strict=True))
        return math.dist(tuple(went), tuple(meant)) / elapsed
