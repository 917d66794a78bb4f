"""Videos of flights from an external chase camera, with or without the on-board view."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.film import enlarge, write_gif, write_video
from dreamer_racing.figures.hud import caption, race_words, second_lap

STRIDE, COLORS = 3, 32  # control steps a frame, and colours, of chase.gif, in which the whole picture moves


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


def film_from_outside(directory: Path, view: ChaseView, track: Track, trajectory: Trajectory) -> str:
    """Write a video of the whole flight and a GIF of its second lap, from outside and by the drone; name the files."""
    frames, words = chase_beside_onboard(view, trajectory), race_words(track, trajectory)
    view.close()
    filmed = write_video(directory / "chase.mp4", caption(frames, words), fps=1 / trajectory.control_dt, scale=1)
    first, last = second_lap(trajectory)
    shown = slice(first, last + 1, STRIDE)
    gif = caption(frames[shown], words[shown])
    size = write_gif(directory / "chase.gif", gif, fps=1 / (STRIDE * trajectory.control_dt), colors=COLORS)
    return f"{'chase.mp4, ' if filmed else ''}chase.gif ({size / 1e6:.2f} MB)"
