"""Checks whether the velocities and body rates of a pose source agree with its own positions and attitudes."""

from __future__ import annotations

import math
from collections import deque
from typing import ClassVar, NamedTuple

from dreamer_racing.hil import attitude
from dreamer_racing.hil.safety_limits import Vector


class _Mark(NamedTuple):
    """A pose's position or attitude, its reported velocity or body rates, and the integral of those so far."""

    time: float
    place: Vector
    rate: Vector
    integral: Vector


class Odometer:
    """Compares reported velocities, integrated by trapezoids over a time window, with the change of position.

    Args:
        window: Least length of the window, s; it is up to one pose interval longer.
        gap: s between two poses beyond which the comparison starts anew.

    Example:
        >>> odometer = Odometer(window=0.0625)
        >>> odometer.mismatch(0.0, (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)) is None
        True
        >>> odometer.mismatch(0.0625, (0.25, 0.0, 0.0), (5.0, 0.0, 0.0))  # it went at 4 m/s
        1.0
    """

    _start: ClassVar[Vector] = (0.0, 0.0, 0.0)

    def __init__(self, window: float, gap: float = math.inf) -> None:
        self._window, self._gap = window, gap
        self._marks: deque[_Mark] = deque()

    def mismatch(self, time: float, place: Vector, rate: Vector) -> float | None:
        """Add a pose newer than the last: its time, s, position, m, and reported velocity, m/s.

        Returns:
            The difference of the mean velocities over the window, m/s; None until the poses since the first one, or
            since a gap, span it.
        """
        marks = self._marks
        last = marks[-1] if marks else None
        if last is None or time - last.time > self._gap:
            marks.clear()
            integral = self._start
        else:
            half = 0.5 * (time - last.time)
            step = tuple(half * (old + new) for old, new in zip(last.rate, rate, strict=True))
            integral = self._integrate(last.integral, step)
        marks.append(_Mark(time, place, rate, integral))
        while len(marks) > 2 and time - marks[1].time >= self._window:
            marks.popleft()
        first, elapsed = marks[0], time - marks[0].time
        if elapsed < self._window or elapsed <= 0.0:
            return None
        return self._distance(self._change(first.place, place), self._change(first.integral, integral)) / elapsed

    @staticmethod
    def _integrate(integral: Vector, step: Vector) -> Vector:
        """Return the integral after one more step."""
        return tuple(here + more for here, more in zip(integral, step, strict=True))

    @staticmethod
    def _change(first: Vector, last: Vector) -> Vector:
        """Return the displacement from one place to another."""
        return tuple(there - here for here, there in zip(first, last, strict=True))

    @staticmethod
    def _distance(travelled: Vector, integrated: Vector) -> float:
        """Return the distance between two displacements."""
        return math.dist(travelled, integrated)


class TurnOdometer(Odometer):
    """An `Odometer` for body rates, rad/s in the body frame, and attitudes, wxyz of unit length.

    Rates about changing axes do not add up, so rotations are composed; the mismatch is the angle between the two
    resulting rotations, per time.

    Example:
        >>> odometer = TurnOdometer(window=0.0625)
        >>> odometer.mismatch(0.0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 8.0)) is None
        True
        >>> round(odometer.mismatch(0.0625, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 8.0)), 6)  # it did not turn
        8.0
    """

    _start: ClassVar[Vector] = (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def _integrate(integral: Vector, step: Vector) -> Vector:
        angle = math.hypot(*step)
        if not math.isfinite(angle):
            return 4 * (math.nan,)
        scale = math.sin(0.5 * angle) / angle if angle else 0.0
        return attitude.product(integral, (math.cos(0.5 * angle), *(scale * part for part in step)))

    @staticmethod
    def _change(first: Vector, last: Vector) -> Vector:
        turned = attitude.product(attitude.conjugate(first), last)
        return turned if turned[0] >= 0.0 else tuple(-part for part in turned)  # both are the same rotation

    @staticmethod
    def _distance(travelled: Vector, integrated: Vector) -> float:
        distance = math.dist(travelled, integrated)
        return 4.0 * math.asin(min(1.0, 0.5 * distance)) if math.isfinite(distance) else math.inf
