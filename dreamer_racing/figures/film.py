"""Videos and GIFs of flights and of a world model's predictions, and their captions, (T, H, W, 3) uint8 frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory, swapped_in
from dreamer_racing.figures.drawing import CRASH_COLOR, INK, SPEED_COLORS, camera_directions, draw_track

VIDEO_HEIGHT = 256  # pixels
CONTEXT_COLOR = (64, 160, 80)  # the model observes the images
OPEN_LOOP_COLOR = (230, 120, 20)  # the model predicts the images from actions alone
WHITE = (255, 255, 255)
GAP = 8  # pixels between pictures side by side
STRIP_FRAMES = 6  # per stage of training in a film strip
MAP_MARGIN = 1.6  # m around the gates of a moving map
MAP_TAIL = 1.0  # s of the path that a moving map shows
GIF_SIZE = 256  # pixels, least side of either picture of a GIF
MIN_DELAY = 0.02  # s; browsers show shorter GIF frames much longer
SHORTEST_FILM = 4.0  # s; shorter flights are shown in slow motion, so that a viewer can follow them
SLOWEST = 8  # maximum factor of slow motion
STRIP_COLOR = (33, 37, 41)
LETTER_SIZES = range(16, 6, -1)  # pixels
MARGIN = 5  # pixels left and right of the caption
BEGINNING = 300  # control steps shown if there is no second lap
SEEN = "seen"

logger = logging.getLogger(__name__)


def write_video(path: str | Path, frames: np.ndarray | torch.Tensor, fps: float = 50, scale: int | None = 1) -> bool:
    """Write an H.264 (yuv420p) mp4 file, which most players support; return whether there was an ffmpeg to do it.

    Pixels are enlarged by the factor ``scale``, None for that of `enlarge_to_watch`. Odd sizes then grow by one pixel,
    because H.264 needs even ones.

    Raises:
        ValueError: the frames have another shape or type, or there are none.
    """
    array = _as_frames(frames, "frames")
    if not _finds_ffmpeg():
        return False
    import imageio.v2 as imageio  # slow to import

    looks: Any = {"codec": "libx264", "pixelformat": "yuv420p", "quality": 8, "macro_block_size": 1}
    with swapped_in(path) as partial:
        writer: Any = imageio.get_writer(partial, format="FFMPEG", fps=fps, **looks)
        with writer:
            for frame in array:
                # One by one, as a whole film is large
                larger = enlarge_to_watch(frame[None])[0] if scale is None else enlarge(frame, scale)
                writer.append_data(_make_even(larger))
    return True


@cache
def _finds_ffmpeg() -> bool:
    """Return whether ffmpeg is available; warn the first time if not."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        logger.warning("no videos are written: %s. For ffmpeg: pip install imageio-ffmpeg.", str(error).rstrip("."))
        return False
    return True


def write_gif(path: str | Path, frames: np.ndarray | torch.Tensor, fps: float = 25, colors: int = 64) -> int:
    """Write a small GIF with one palette for all frames and no dithering, so that unchanged pixels take no space.

    There are at most 50 frames a second; the delay is rounded to the format's unit of 1/100 s. The palette may have 2
    to 256 colours. Returns the size of the file in bytes.

    Raises:
        ValueError: the frames have another shape or type, or there are none.
    """
    array = _as_frames(frames, "frames")
    few = array[np.linspace(0, len(array) - 1, min(16, len(array))).round().astype(int)]
    palette = Image.fromarray(few.reshape(-1, *few.shape[2:])).quantize(colors, method=Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in array]
    delay = round(max(MIN_DELAY, 1 / fps), 2)
    animated: Any = {"save_all": True, "duration": round(1000 * delay), "optimize": False, "disposal": 1, "loop": 0}
    with swapped_in(path) as partial:
        images[0].save(partial, format="GIF", append_images=images[1:], **animated)
    return Path(path).stat().st_size


def side_by_side(
    real: np.ndarray | torch.Tensor, imagined: np.ndarray | torch.Tensor, context: int, scale: int = 4
) -> np.ndarray:
    """Compose on-board view | prediction, (T, scale H + 8, 2 (scale W + 8), 3), with pixels enlarged without blurring.

    The prediction's border is green in the ``context`` that the model observes, and orange while it predicts open loop.
    """
    seen, predicted = _as_frames(real, "real"), _as_frames(imagined, "imagined")
    phase = np.full((len(seen), 3), OPEN_LOOP_COLOR, dtype=np.uint8)  # (T, 3)
    phase[:context] = CONTEXT_COLOR
    framed = [
        add_border(enlarge(panel, scale), color, 4)
        for panel, color in ((seen, np.full_like(phase, WHITE)), (predicted, phase))
    ]
    return np.concatenate(framed, axis=2)


def enlarge(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Enlarge (..., H, W, 3) by repeating pixels."""
    return pixels if scale == 1 else pixels.repeat(scale, axis=-3).repeat(scale, axis=-2)


def enlarge_to_watch(pixels: np.ndarray) -> np.ndarray:
    """Enlarge (T, H, W, 3) by the smallest integer factor to a height of `VIDEO_HEIGHT` or more."""
    return enlarge(pixels, math.ceil(VIDEO_HEIGHT / pixels.shape[1]))


def add_border(panel: np.ndarray, color: np.ndarray, border: int) -> np.ndarray:
    """Add a border to (T, H, W, 3), with one colour per frame (T, 3)."""
    frames, height, width, _ = panel.shape
    framed = np.empty((frames, height + 2 * border, width + 2 * border, 3), dtype=np.uint8)
    framed[:] = color[:, None, None]
    framed[:, border : border + height, border : border + width] = panel
    return framed


def top_down_frames(track: Track, trajectory: Trajectory, size: int = 256) -> np.ndarray:
    """Draw an animated map, (K + 1, size, size, 3) uint8: drone, camera's direction, and the last part of the path."""
    background, points = _map_of(track, 2 * size, trajectory.position[:, :2].numpy())
    view = camera_directions(trajectory.attitude, trajectory.camera_tilt)[:, :2].numpy() * (1.0, -1.0)  # rows go down
    speed = trajectory.speed.numpy()
    colors = (255 * SPEED_COLORS(speed / max(1.0, float(np.nanmax(speed))))[:, :3]).astype(int)
    length = round(MAP_TAIL / trajectory.control_dt)
    frames = np.empty((len(points), size, size, 3), dtype=np.uint8)
    for now in range(len(points)):
        image = background.copy()
        draw = ImageDraw.Draw(image)
        for step in range(max(1, now - length), now + 1):
            draw.line([*points[step - 1], *points[step]], fill=tuple(colors[step].tolist()), width=8)
        crashed = trajectory.crashed and now == len(points) - 1
        _draw_drone(draw, points[now], view[now], size / 10, CRASH_COLOR if crashed else INK)
        frames[now] = np.asarray(image.resize((size, size), Image.Resampling.BOX))
    return frames


def onboard_beside_map(track: Track, trajectory: Trajectory, size: int = 256) -> np.ndarray:
    """Compose on-board view | animated map, (K + 1, side, 2 side + `GAP`, 3), of an episode with square images.

    Images are enlarged by an integer factor to a side of at least ``size`` pixels.
    """
    assert trajectory.pixels is not None
    view = enlarge(trajectory.pixels.numpy(), math.ceil(size / trajectory.pixels.shape[1]))
    side = view.shape[1]
    between = np.full((len(view), side, GAP, 3), 255, dtype=np.uint8)
    return np.concatenate((view, between, top_down_frames(track, trajectory, side)), axis=2)


def _map_of(track: Track, size: int, positions: np.ndarray) -> tuple[Image.Image, np.ndarray]:
    """Draw the map of a track; return it with the pixel coordinates (M, 2) of the positions (M, 2) in m."""
    figure = Figure(figsize=(4.0, 4.0), dpi=size / 4.0)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_track(axes, track, labels=False)
    axes.set_axis_off()
    gates = np.array([gate.position[:2] for gate in (*track.gates, *track.decoys)])
    shown = np.concatenate((gates - MAP_MARGIN, gates + MAP_MARGIN, positions[np.isfinite(positions).all(1)]))
    low, high = shown.min(0), shown.max(0)
    (x, y), half = (low + high) / 2, (high - low).max() / 2
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    pixels = axes.transData.transform(positions)
    return image, np.stack((pixels[:, 0], image.height - pixels[:, 1]), axis=1)


def _draw_drone(draw: ImageDraw.ImageDraw, place: np.ndarray, view: np.ndarray, size: float, color: str) -> None:
    """Draw a dot, and a wedge of 90° (the camera's field of view) in the direction ``view`` (2,)."""
    if not np.isfinite(place).all():
        return
    x, y = place.tolist()
    heading = math.degrees(math.atan2(view[1], view[0]))
    reach = 1.6 * size * max(0.3, float(np.hypot(*view)))
    draw.pieslice((x - reach, y - reach, x + reach, y + reach), heading - 45, heading + 45, fill="#adb5bd")
    radius = 0.32 * size
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color, outline="white", width=2)


def _as_frames(frames: np.ndarray | torch.Tensor, name: str) -> np.ndarray:
    array = frames.detach().cpu().numpy() if isinstance(frames, torch.Tensor) else frames
    if array.ndim != 4 or array.shape[-1] != 3 or not array.size or array.dtype != np.uint8:
        raise ValueError(
            f"{name} is {array.dtype} of shape {array.shape}; must be uint8 (T, H, W, 3), at least 1 frame."
        )
    return array


def _make_even(frame: np.ndarray) -> np.ndarray:
    """Pad (H, W, 3) to an even height and width by repeating the last row or column."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def shown_frames(dream: Dream) -> list[int]:
    """Choose `STRIP_FRAMES` to show: the last two of the context, then evenly spaced ones to the end."""
    last = dream.real.shape[1] - 1
    context = list(range(max(0, dream.context - 2), dream.context))
    rest = np.linspace(dream.context, last, STRIP_FRAMES - len(context)).round().astype(int)
    return [*context, *sorted(set(rest.tolist()))]


def film_strip(dream: Dream, frames: Sequence[int]) -> np.ndarray:
    """Compose F frames of the first window in three rows: real, reconstructed, imagined; (3 (2 H + 6), F (2 W + 6), 3).

    Borders of the lower two rows are green where the model has observed the image and orange where it predicts.
    """
    chosen = np.array(frames)
    seen = np.where((chosen < dream.context)[:, None], CONTEXT_COLOR, OPEN_LOOP_COLOR)  # (F, 3)
    colors = (np.broadcast_to(WHITE, seen.shape), np.broadcast_to(CONTEXT_COLOR, seen.shape), seen)
    rows = [
        np.concatenate(list(add_border(enlarge(images[0, chosen], 2), color, 3)), axis=1)
        for images, color in zip((dream.real, dream.reconstructed, dream.imagined), colors, strict=True)
    ]
    return np.concatenate(rows)


def race_words(track: Track, trajectory: Trajectory) -> list[str]:
    """Return captions with time, speed, next gate and lap for each of the K + 1 rows of an episode from its start."""
    completed = laps_completed(trajectory).tolist()
    speeds = [f"{speed:4.1f} m/s" if math.isfinite(speed) else " lost" for speed in trajectory.speed.tolist()]
    rows = zip(speeds, trajectory.target_gate.tolist(), completed, strict=True)
    return [
        f"{row * trajectory.control_dt:5.2f} s  {speed}  gate {target + 1}/{track.num_gates}  "
        f"lap {min(laps + 1, track.laps)}/{track.laps}"
        for row, (speed, target, laps) in enumerate(rows)
    ]


def laps_completed(trajectory: Trajectory) -> np.ndarray:
    """Count the completed laps at every row of a flight from its start, (K + 1,)."""
    # A lap ends where the index of the next gate decreases: to 0, or above 0 if one step passed two gates.
    gate = trajectory.target_gate.numpy()
    return np.concatenate(([0], np.cumsum(gate[1:] < gate[:-1])))


def second_lap(trajectory: Trajectory) -> tuple[int, int]:
    """Return the first and last step of the second lap, flown at racing speed; else of the flight's beginning."""
    ends = (np.diff(laps_completed(trajectory)).nonzero()[0] + 1).tolist()
    return (ends[0], ends[1]) if len(ends) > 1 else (0, min(BEGINNING, len(trajectory.action)))


def dream_words(frames: int, context: int, frame_dt: float, cycle: int | None = None) -> list[str]:
    """Return captions: whether the model observes a frame, in the context of each cycle, or how long it imagined."""
    place = [frame % cycle if cycle else frame for frame in range(frames)]
    return [SEEN if at < context else f"imagined {(at - context + 1) * frame_dt:+.2f} s" for at in place]


def slow_motion(seconds: float) -> int:
    """Return the integer factor of slow motion for a flight's duration; flights of untrained policies are short."""
    return min(SLOWEST, max(1, math.ceil(SHORTEST_FILM / max(seconds, 1e-6))))


def caption(frames: np.ndarray, left: Sequence[str], right: Sequence[str] = ()) -> np.ndarray:
    """Add a strip with a caption above every frame, (T, H, W, 3) → (T, H + strip, W, 3) uint8.

    Captions above the right half, if any, are green if `SEEN`, else orange.
    """
    width = frames.shape[2]
    room = (width // 2 if right else width) - 2 * MARGIN
    font = _fitting_font(max((*left, *right), key=len), room)
    height = round(font.size) + 8
    strips = np.empty((len(left), height, width, 3), np.uint8)
    for index, (words, beside) in enumerate(zip(left, right or [""] * len(left), strict=True)):
        strip = Image.new("RGB", (width, height), STRIP_COLOR)
        draw = ImageDraw.Draw(strip)
        draw.text((MARGIN, 3), words, fill=WHITE, font=font)
        if beside:
            color = CONTEXT_COLOR if beside == SEEN else OPEN_LOOP_COLOR
            draw.text((width // 2 + MARGIN, 3), beside, fill=color, font=font)
        strips[index] = np.asarray(strip)
    return np.concatenate((strips, frames), axis=1)


def dream_video(dreams: Sequence[tuple[str, Dream]]) -> np.ndarray:
    """Compose named stages of training below each other, each as real | imagined; shorter ones hold their last frame.

    The windows of a stage are shown one after another.
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
