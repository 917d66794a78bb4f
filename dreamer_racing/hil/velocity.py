"""Estimates velocities and body rates from successive poses, for sources that measure poses only."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dreamer_racing.hil.attitude import rotation_between

GAP = 0.1
"""s between two poses beyond which their difference says nothing about the present velocity [choice]."""

SPEED_MAX = 50.0
"""m/s above which a pose has jumped instead of moved [choice]: more than twice what racing drones reach."""

RATE_MAX = 50.0
"""rad/s above which an attitude has jumped instead of turned [choice]: almost three times 1000 deg/s."""


class Velocity(NamedTuple):
    """A vehicle's velocity and body rates."""

    linear_velocity: np.ndarray  # (3,) m/s, world
    body_rates: np.ndarray  # (3,) rad/s, body frame


class VelocityEstimator:
    """Differentiates successive poses, and smooths the result with a first-order low-pass.

    The filter starts at the first difference, so that steady motion is known exactly from the second pose on. The
    estimate lags by half the time between two poses, plus the time constant.

    Args:
        time_constant: s, of the low-pass, after which 63 % of a step has passed; 0 disables the filter.

    Example:
        >>> level = np.array([1.0, 0.0, 0.0, 0.0])
        >>> estimator = VelocityEstimator(time_constant=0.01)
        >>> estimator.update(0.0, np.zeros(3), level) is None
        True
        >>> estimator.update(0.5**4, np.array([0.25, 0.0, 0.0]), level).linear_velocity.tolist()
        [4.0, 0.0, 0.0]
    """

    def __init__(self, time_constant: float) -> None:
        self._time_constant = time_constant
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None
        self._velocity: Velocity | None = None

    def update(self, time: float, position: np.ndarray, attitude: np.ndarray) -> Velocity | None:
        """Add a pose: when it was measured, s, position (3,), m, and attitude (4,) wxyz of unit length and either sign.

        Returns:
            None for the first pose, and after a gap, a jump or a step back in time, where estimation starts anew.
        """
        last, self._last = self._last, (time, position, attitude)
        elapsed = math.inf if last is None else time - last[0]
        if last is None or not 0.0 < elapsed <= GAP:
            self._velocity = None
            return None
        moved, turned = position - last[1], rotation_between(last[2], attitude)
        if np.linalg.norm(moved) > SPEED_MAX * elapsed or np.linalg.norm(turned) > RATE_MAX * elapsed:
            self._velocity = None
            return None
        self._velocity = self._filtered(Velocity(moved / elapsed, turned / elapsed), elapsed)
        return self._velocity

    def _filtered(self, measured: Velocity, elapsed: float) -> Velocity:
        if self._velocity is None or self._time_constant == 0.0:
            return measured
        gain = -math.expm1(-elapsed / self._time_constant)  # exact for a constant input
        return Velocity(*(old + gain * (new - old) for old, new in zip(self._velocity, measured, strict=True)))
