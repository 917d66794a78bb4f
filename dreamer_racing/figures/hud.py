"""Words on films: how far a race is, and what a world model has seen or only imagines.

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

SHORTEST_FILM = 4.0  # s that a flight is stretched to last, so that one can follow it
SLOWEST = 8  # times as long as the flight, at most
STRIP_COLOR, WORDS_COLOR = (33, 37, 41), (255, 255, 255)
LETTER_SIZES = range(16, 6, -1)  # pixels
MARGIN = 5  # pixels left and right of words
SEEN = "seen"


def race_words(track: Track, trajectory: Trajectory) -> list[str]:
    """Say time, speed, next gate and lap at every row of a flight, K + 1 lines.

    Args:
        track: that is flown.
        trajectory: from the start of an episode on; what `Trajectory.part` cuts out would count from its own beginning.
    """
    completed = laps_completed(trajectory).tolist()
    rows = zip(trajectory.speed.tolist(), trajectory.target_gate.tolist(), completed, strict=True)
    return [
        f"{row * trajectory.control_dt:5.2f} s  {_speed(speed)}  gate {target + 1}/{track.num_gates}  "
        f"lap {min(laps + 1, track.laps)}/{track.laps}"
        for row, (speed, target, laps) in enumerate(rows)
    ]


def laps_completed(trajectory: Trajectory) -> np.ndarray:
    """Count the laps behind a drone at every row of a flight from its start on, (K + 1,).

    A lap ends where the next gate is an earlier one: the first, or one behind it where a step passed two.
    """
    gate = trajectory.target_gate.numpy()
    return np.concatenate(([0], np.cumsum(gate[1:] < gate[:-1])))


def _speed(speed: float) -> str:
    return f"{speed:4.1f} m/s" if math.isfinite(speed) else " lost"


def dream_words(frames: int, context: int, frame_dt: float, cycle: int | None = None) -> list[str]:
    """Say of each frame whether the model has seen it, or for how long it has imagined.

    Args:
        frames: T.
        context: first frames that it sees.
        frame_dt: s between two of them.
        cycle: frames after which it sees again; None if never.
    """
    place = [frame % cycle if cycle else frame for frame in range(frames)]
    return [SEEN if at < context else f"imagined {(at - context + 1) * frame_dt:+.2f} s" for at in place]


def slow_motion(seconds: float) -> int:
    """Return by what whole factor to slow a flight of so many seconds down: those of the young are over at once."""
    return min(SLOWEST, max(1, math.ceil(SHORTEST_FILM / max(seconds, 1e-6))))


def caption(frames: np.ndarray, left: Sequence[str], right: Sequence[str] = ()) -> np.ndarray:
    """Put a strip with words above every frame; it covers none of the picture.

    Args:
        frames: (T, H, W, 3) uint8, large enough to read words in.
        left: a line each.
        right: words above the right half, if any; green for what is seen, orange for what is imagined.

    Returns:
        (T, H + strip, W, 3) uint8.

    Raises:
        ValueError: there are not as many lines as frames.
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


def dream_video(dreams: Sequence[tuple[str, Dream]], scale: int = 2) -> np.ndarray:
    """Compose the stages of training under each other, each real | imagined under words, as long as the longest.

    Args:
        dreams: the stages, each with its name; their windows follow one another.
        scale: whole factor by which pixels are enlarged, without blurring.

    Returns:
        (frames, height, width, 3) uint8.
    """
    films = [_film(name, dream, scale) for name, dream in dreams]
    length = max(map(len, films))
    held = [np.concatenate((film, film[-1:].repeat(length - len(film), axis=0))) for film in films]
    return np.concatenate(held, axis=1)


def _fitting_font(line: str, room: int) -> ImageFont.FreeTypeFont:
    """Choose the largest letters in which a line takes no more pixels than there are; the smallest if none does."""
    for size in LETTER_SIZES:
        font = cast(ImageFont.FreeTypeFont, ImageFont.load_default(size=size))
        if font.getlength(line) <= room:
            break
    return font


def _film(name: str, dream: Dream, scale: int) -> np.ndarray:
    pairs = zip(dream.real, dream.imagined, strict=True)
    frames = np.concatenate([side_by_side(*pair, context=dream.context, scale=scale) for pair in pairs])
    words = dream_words(len(frames), dream.context, dream.frame_dt, cycle=dream.real.shape[1])
    return caption(frames, [name] * len(frames), words)
