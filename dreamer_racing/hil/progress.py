"""Tracks which gate comes next, from positions alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Pose


class GatePass(NamedTuple):
    """A gate that was passed."""

    gate: int  # its index
    time: float  # s, by the loop's clock, when the vehicle crossed its plane
    offset: float  # m, from its centre


class GateProgress:
    """Counts gates passed in order. A pass crosses the gate's plane forwards, inside its opening less a margin.

    A pose that has jumped further than the safety limits allow passes no gate.

    Attributes:
        target: Index of the gate that comes next.
        passes: Gates passed since `reset`, in order.
    """

    def __init__(self, track: Track, limits: SafetyLimits) -> None:
        self._centres = np.array([gate.position for gate in track.gates])  # (G, 3)
        self._forward = np.array([gate.forward for gate in track.gates])  # (G, 3)
        self._left = np.array([gate.left for gate in track.gates])  # (G, 3)
        self._half_width = track.shape.pass_half_width
        self._limits = limits
        self.reset()

    def reset(self) -> None:
        """Begin at the first gate."""
        self.target = 0
        self.passes: list[GatePass] = []
        self._last: Pose | None = None

    def update(self, pose: Pose, judged: bool = True) -> GatePass | None:
        """Add the next measured pose; return the gate passed since the one before, if any.

        Safety judges the newest pose of each tick. One that is not judged and has jumped is ignored, and progress
        continues from the one before.
        """
        last = self._last
        if last is None:
            self._last = pose
            return None
        reached = float(np.linalg.norm(pose.position - last.position)) <= self._limits.reach(pose.time - last.time)
        if reached or judged:
            self._last = pose
        if not reached:
            return None
        centre, forward, left = self._centres[self.target], self._forward[self.target], self._left[self.target]
        before, after = float((last.position - centre) @ forward), float((pose.position - centre) @ forward)
        if not before < 0.0 <= after:
            return None
        share = before / (before - after)
        crossing = last.position + share * (pose.position - last.position) - centre
        if max(abs(float(crossing @ left)), abs(float(crossing[2]))) > self._half_width:
            return None
        time = last.time + share * (pose.time - last.time)
        passed = GatePass(self.target, time, float(np.linalg.norm(crossing)))
        self.passes.append(passed)
        self.target = (self.target + 1) % len(self._centres)
        return passed


def flying_laps(passes: Sequence[GatePass]) -> list[float]:
    """Return the times of whole laps, from the first gate to the first gate, s."""
    firsts = [passed.time for passed in passes if passed.gate == 0]
    return np.diff(firsts).tolist()
