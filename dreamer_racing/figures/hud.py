"""Captions of videos: progress of the race, and whether a world model observes or imagines.

Shapes: T frames of H × W pixels, K control steps of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR, side_by_side

SHORTEST_FILM = 4.0  # s; shorter flights are shown in slow motion, so that a viewer can follow them
SLOWEST = 8  # maximum factor of slow motion
STRIP_COLOR, WORDS_COLOR = (33, 37, 41), (255, 255, 255)
LETTER_SIZES = range(16, 6, -1)  # pixels
MARGIN = 5  # pixels left and right of the caption
BEGINNING = 300  # control steps shown if there is no second lap
SEEN = "seen"


def race_words(track: Track, trajectory: Trajectory) -> list[str]:
    """Return captions with time, speed, next gate and lap for each of the K + 1 rows of a flight.

    The flight is from the start of the episode; in a `Trajectory.part`, time and laps would start anew.
    """
    completed = laps_completed(trajectory).tolist()
    rows = zip(trajectory.speed.tolist(), trajectory.target_gate.tolist(), completed, strict=True)
    return [
        f"{row * trajectory.control_dt:5.2f} s  {_speed(speed)}  gate {target + 1}/{track.num_gates}  "
        f"lap {min(laps + 1, track.laps)}/{track.laps}"
        for row, (speed, target, laps) in enumerate(rows)
    ]


def _speed(speed: float) -> str:
    return f"{speed:4.1f} m/s" if math.isfinite(speed) else " lost"


def laps_completed(trajectory: Trajectory) -> np.ndarray:
    """Count the completed laps at every row of a flight from its start, (K + 1,).

    A lap ends where the index of the next gate decreases: to 0, or above 0 if one step passed two gates.
    """
    gate = trajectory.target_gate.numpy()
    return np.concatenate(([0], np.cumsum(gate[1:] < gate[:-1])))


def second_lap(trajectory: Trajectory) -> tuple[int, int]:
    """Return the first and last step of the second lap, flown at racing speed; else of the flight's beginning."""
    ends = (np.diff(laps_completed(trajectory)).nonzero()[0] + 1).tolist()
    return (ends[0], ends[1]) if len(ends) > 1 else (0, min(BEGINNING, len(trajectory.action)))


def dream_words(frames: int, context: int, frame_dt: float, cycle: int | None = None) -> list[str]:
    """Return captions that say for each frame whether the model observes it, or how long it has imagined.

    The context, the frames that the model observes first, starts again after a ``cycle`` of frames, if there is one.
    """
    place = [frame % cycle if cycle else frame for frame in range(frames)]
    return [SEEN if at < context else f"imagined {(at - context + 1) * frame_dt:+.2f} s" for at in place]


def slow_motion(seconds: float) -> int:
    """Return the integer factor of slow motion for a flight's duration; flights of untrained policies are short."""
    return min(SLOWEST, max(1, math.ceil(SHORTEST_FILM / max(seconds, 1e-6))))


def caption(frames: np.ndarray, left: Sequence[str], right: Sequence[str] = ()) -> np.ndarray:
    """Add a strip with a caption above every frame.

    Captions above the right half, if any, are green if `SEEN`, else orange.

    Returns:
        (T, H + strip, W, 3) uint8, of frames (T, H, W, 3).

    Raises:
        ValueError: the numbers of captions and frames differ.
    """
    if len(left) != len(frames) or (right and len(right) != len(frames)):
        raise ValueError(f"{len(frames)} frames need as many lines: there are {len(left)} and {len(right)}.")
    width = frames.shape[2]
    room = (width // 2 if right else width) - 2 * MARGIN
    font = _fitting_font(max((*left, *right), key=len), room)
    height = round(font.size) + 8
    strips = np.empty((len(frames), height, width, 3), np.uint8)
    for index, words in enumerate(left):
        strip = Image.new("RGB", (width, height), STRIP_COLOR)
        draw = ImageDraw.Draw(strip)
        draw.text((MARGIN, 3), words, fill=WORDS_COLOR, font=font)
        if right:
            color = CONTEXT_COLOR if right[index] == SEEN else OPEN_LOOP_COLOR
            draw.text((width // 2 + MARGIN, 3), right[index], fill=color, font=font)
        strips[index] = np.asarray(strip)
    return np.concatenate((strips, frames), axis=1)


def dream_video(dreams: Sequence[tuple[str, Dream]]) -> np.ndarray:
    """Compose named stages of training below each other, each as real | imagined; shorter ones hold their last frame.

    Returns:
        (frames, height, width, 3) uint8; the windows of a stage are shown one after another.
    """
    films = [_film(name, dream) for name, dream in dreams]
    length = max(map(len, films))
    held = [np.concatenate((film, film[-1:].repeat(length - len(film), axis=0))) for film in films]
    return np.concatenate(held, axis=1)


def _fitting_font(line: str, room: int) -> ImageFont.FreeTypeFont:
    """Return the largest font in which a line is at most ``room`` pixels wide, or the smallest if none is."""
    for size in LETTER_SIZES:
        font = cast(ImageFont.FreeTypeFont, ImageFont.load_default(size=size))
        if font.getlength(line) <= room:
            break
    return font


def _film(name: str, dream: Dream) -> np.ndarray:
    pairs = zip(dream.real, dream.imagined, strict=True)
    frames = np.concatenate([side_by_side(*pair, context=dream.context, scale=2) for pair in pairs])
    words = dream_words(len(frames), dream.context, dream.frame_dt, cycle=dream.real.shape[1])
    return caption(frames, [name] * len(frames), words)
