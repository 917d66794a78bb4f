"""Videos of flights from an external chase camera, with or without the on-board view."""

from __future__ import annotations

import math

import numpy as np

from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.film import enlarge


def chase_frames(view: ChaseView, trajectory: Trajectory) -> np.ndarray:
    """Render a flight from the chase camera.

    Args:
        view: chase view of one drone, N = 1, on the flight's track.
        trajectory: a recorded episode of K steps.

    Returns:
        (K + 1, size, size, 3) uint8.
    """
    position, attitude = trajectory.position.double().numpy(), trajectory.attitude.double().numpy()
    gate, time = trajectory.target_gate.numpy(), trajectory.control_dt * np.arange(len(position))
    rows = (slice(row, row + 1) for row in range(len(position)))
    return np.concatenate([view.draw(position[row], attitude[row], gate[row], time[row]) for row in rows])


def chase_beside_onboard(view: ChaseView, trajectory: Trajectory, gap: int = 8) -> np.ndarray:
    """Compose chase view | on-board view, or the chase view alone if there are no images.

    Args:
        view: chase view of one drone, N = 1, on the flight's track.
        trajectory: a recorded episode of K steps.
        gap: space between the views, pixels.

    Returns:
        (K + 1, size, size + gap + width, 3) uint8. On-board images are scaled by an integer factor and centred.
    """
    outside = chase_frames(view, trajectory)
    if trajectory.pixels is None:
        return outside
    height = outside.shape[1]
    seen = enlarge(trajectory.pixels.numpy(), max(1, height // trajectory.pixels.shape[1]))
    if seen.shape[1] > height:
        seen = seen[:, :: math.ceil(seen.shape[1] / height), :: math.ceil(seen.shape[1] / height)]
    missing = height - seen.shape[1]
    seen = np.pad(seen, ((0, 0), (missing // 2, missing - missing // 2), (gap, 0), (0, 0)), constant_values=255)
    return np.concatenate((outside, seen), axis=2)
