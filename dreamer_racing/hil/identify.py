"""The flight for `dreamer_racing.identification`: small steps of body rates and thrust around a hover at the start."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.hil.attitude import rotation_matrix
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint

RATE = 100.0  # Hz, of commands: as often as a radio accepts them

AXES = ("roll", "pitch", "yaw", "thrust")
AMPLITUDES = {"roll": (1.0, 2.0, 4.0), "pitch": (1.0, 2.0, 4.0), "yaw": (0.7, 1.4, 2.1), "thrust": (1.5, 3.0, 4.5)}
"""Amplitudes of steps: rad/s about the body's axes, m/s² of thrust [choice]."""
HOLD = {"roll": 0.10, "pitch": 0.10, "yaw": 0.30, "thrust": 0.12}
"""s for which the first and third of three steps are held; the second is opposite and twice as long, so that the
vehicle ends where it was, and nearly at rest [choice]."""
REST = 1.0  # s between two triples, in which the vehicle returns to its place [choice]
SETTLE = 2.0  # s of hover before the first step and after the last [choice]
RANDOM = 4.0  # s of steps of random sign per axis, which reveal delays better [choice]
RANDOM_HOLD = 0.05, 0.15  # s, shortest and longest of these steps [choice]
HEIGHT = 0.3  # m of the hover above the start [choice]
KP, KD, KA, KYAW = 3.0, 3.0, 6.0, 2.0
"""Gains of the hover, in 1/s², 1/s, 1/s and 1/s: slow compared with any usable rate loop [choice]."""
SIDEWAYS = 3.0  # m/s², largest sideways acceleration [choice]


class Step(NamedTuple):
    """An offset that is added to the hover's setpoint for a while."""

    begin: float  # s, from the beginning of the flight
    end: float  # s
    axis: int  # index in `AXES`
    value: float  # rad/s or m/s²


def make_schedule() -> list[Step]:
    """Return the steps of a flight, in order."""
    steps, time = [], SETTLE
    for axis, name in enumerate(AXES):
        for amplitude in AMPLITUDES[name]:
            for sign in (1.0, -1.0):
                for share, held in ((sign, 1.0), (-sign, 2.0), (sign, 1.0)):
                    end = time + held * HOLD[name]
                    steps.append(Step(time, end, axis, share * amplitude))
                    time = end
                time += REST
        for begin, end, sign in _draw(time, axis):
            steps.append(Step(begin, end, axis, sign * AMPLITUDES[name][1]))
            time = end
        time += REST
    return steps


def _draw(time: float, seed: int) -> Iterator[tuple[float, float, float]]:
    """Yield start, end and sign of random steps from a time on; their integral over time stays near zero."""
    random, until, turned = np.random.default_rng(seed), time + RANDOM, 0.0
    while time < until:
        held = random.uniform(*RANDOM_HOLD)
        sign = random.choice((-1.0, 1.0)) if abs(turned) < 2.0 * RANDOM_HOLD[1] else -math.copysign(1.0, turned)
        turned += sign * held
        yield time, time + held, float(sign)
        time += held


class IdentificationFlyer:
    """A `Flyer` that hovers above its start, and makes the steps of `make_schedule`.

    Attributes:
        duration: Length of the whole flight, s.
    """

    rate = RATE
    camera: Camera | None = None

    def __init__(self) -> None:
        self._steps = make_schedule()
        self.duration = self._steps[-1].end + SETTLE
        self.reset()

    def reset(self) -> None:
        """Begin a flight."""
        self._began: float | None = None

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        """Return the setpoint of the hover, plus the step that is due."""
        turned = rotation_matrix(pose.attitude)
        if self._began is None:
            self._began, self._place = pose.time, pose.position + np.array((0.0, 0.0, HEIGHT))
            self._forward = turned[:2, 0] / max(float(np.linalg.norm(turned[:2, 0])), 1e-6)
        elapsed = pose.time - self._began
        wanted = KP * (self._place - pose.position) - KD * pose.linear_velocity
        wanted[:2] *= min(1.0, SIDEWAYS / max(float(np.linalg.norm(wanted[:2])), 1e-6))
        wanted[2] = GRAVITY + min(max(wanted[2], -0.4 * GRAVITY), 0.4 * GRAVITY)
        thrust = max(float(wanted @ turned[:, 2]), 0.3 * GRAVITY)
        tilt_error = turned.T @ np.cross(turned[:, 2], wanted / np.linalg.norm(wanted))
        nose = turned[:2, 0]
        yaw_error = math.atan2(nose[0] * self._forward[1] - nose[1] * self._forward[0], float(nose @ self._forward))
        rates = np.array((KA * tilt_error[0], KA * tilt_error[1], KYAW * yaw_error))
        for step in self._steps:
            if step.begin <= elapsed < step.end:
                if step.axis < 3:
                    rates[step.axis] += step.value
                else:
                    thrust += step.value
        return Setpoint(thrust, rates)

    def prepare(self) -> None:
        """Do nothing: the next pose is not known yet."""
