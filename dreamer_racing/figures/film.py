"""Videos and GIFs of flights and of a world model's predictions.

Shapes: T frames of H × W pixels, RGB, uint8.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory, swapped_in
from dreamer_racing.figures.drawing import CRASH_COLOR, INK, SPEED_COLORS, camera_directions, draw_track, tilt_of

VIDEO_HEIGHT = 256  # minimum height of a video in pixels, unless its scale is given
CONTEXT_COLOR = (64, 160, 80)  # the model observes the images
OPEN_LOOP_COLOR = (230, 120, 20)  # the model predicts the images from actions alone
WHITE = (255, 255, 255)
GAP = 8  # pixels between pictures side by side
STRIP_FRAMES = 6  # per stage of training in a film strip
MAP_MARGIN = 1.6  # m around the gates of a moving map
MAP_TAIL = 1.0  # s of the path that a moving map shows
GIF_SIZE = 256  # pixels, least side of either picture of a GIF
MIN_DELAY = 0.02  # s; browsers show shorter GIF frames much longer

logger = logging.getLogger(__name__)


def write_video(path: str | Path, frames: np.ndarray | torch.Tensor, fps: float = 50, scale: int | None = None) -> bool:
    """Write an H.264 (yuv420p) mp4 file, which most players support; without ffmpeg, write nothing and warn once.

    Frames are (T, H, W, 3) uint8. Their pixels are enlarged by an integer factor without blurring, None for the
    smallest one that makes the video at least 256 pixels high. Odd sizes then grow by one pixel, because H.264 needs
    even ones. Returns whether the file was written.

    Raises:
        ValueError: the frames have another shape or type, or there are none.
    """
    array = _as_frames(frames, "frames")
    if not _finds_ffmpeg():
        return False
    import imageio.v2 as imageio  # slow to import

    scale = math.ceil(VIDEO_HEIGHT / array.shape[1]) if scale is None else scale
    looks: Any = {"codec": "libx264", "pixelformat": "yuv420p", "quality": 8, "macro_block_size": 1}
    with swapped_in(path) as partial:
        writer: Any = imageio.get_writer(partial, format="FFMPEG", fps=fps, **looks)
        with writer:
            for frame in array:
                writer.append_data(_make_even(enlarge(frame, scale)))
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

    Frames are (T, H, W, 3) uint8, 50 a second at most; the delay is rounded to the format's unit of 1/100 s. The
    palette may have 2 to 256 colours. Returns the size of the file in bytes.

    Raises:
        ValueError: the frames have another shape or type, or there are none.
    """
    array = _as_frames(frames, "frames")
    palette = _shared_palette(array, colors)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in array]
    delay = round(max(MIN_DELAY, 1 / fps), 2)
    with swapped_in(path) as partial:
        images[0].save(
            partial,
            format="GIF",
            save_all=True,
            append_images=images[1:],
            duration=round(1000 * delay),
            optimize=False,
            disposal=1,
            loop=0,
        )
    return Path(path).stat().st_size


def side_by_side(
    real: np.ndarray | torch.Tensor, imagined: np.ndarray | torch.Tensor, context: int, scale: int = 4
) -> np.ndarray:
    """Compose on-board view | prediction.

    The prediction's border is green while the model observes the images and orange while it predicts open loop.

    Args:
        real: (T, H, W, 3) uint8.
        imagined: (T, H, W, 3) uint8.
        context: number of first frames that the model observed.
        scale: integer factor by which pixels are enlarged, without blurring.

    Returns:
        (T, scale H + 8, 2 (scale W + 8), 3) uint8.

    Raises:
        ValueError: the frames have another shape or type, or different shapes.
    """
    seen, predicted = _as_frames(real, "real"), _as_frames(imagined, "imagined")
    if seen.shape != predicted.shape:
        raise ValueError(f"real has shape {seen.shape}, imagined {predicted.shape}; they must be equal.")
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
    """Enlarge (T, H, W, 3) by the default factor of `write_video`."""
    return enlarge(pixels, math.ceil(VIDEO_HEIGHT / pixels.shape[1]))


def add_border(panel: np.ndarray, color: np.ndarray, border: int) -> np.ndarray:
    """Add a border to (T, H, W, 3), with one colour per frame (T, 3)."""
    frames, height, width, _ = panel.shape
    framed = np.empty((frames, height + 2 * border, width + 2 * border, 3), dtype=np.uint8)
    framed[:] = color[:, None, None]
    framed[:, border : border + height, border : border + width] = panel
    return framed


def top_down_frames(track: Track, trajectory: Trajectory, size: int = 256) -> np.ndarray:
    """Draw an animated map: the drone from above, its camera's direction, and the most recent part of its path.

    Returns:
        (K + 1, size, size, 3) uint8, for an episode of K steps.
    """
    background, points = _map_of(track, 2 * size, trajectory.position[:, :2].numpy())
    view = camera_directions(trajectory.attitude, tilt_of(trajectory))[:, :2].numpy()
    view = view * (1.0, -1.0)  # image rows go down
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
    """Compose on-board view | animated map, of an episode of K steps with square images.

    Images are enlarged by an integer factor to a side of at least ``size`` pixels.

    Returns:
        (K + 1, side, 2 side + `GAP`, 3) uint8.

    Raises:
        ValueError: there are no images, or they are not square.
    """
    if trajectory.pixels is None:
        raise ValueError("the trajectory has no images: record it in an environment with from_pixels=True.")
    height, width = trajectory.pixels.shape[1:3]
    if height != width:
        raise ValueError(f"images of {height} × {width} pixels do not fit beside a square map.")
    view = enlarge(trajectory.pixels.numpy(), math.ceil(size / height))
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


def _shared_palette(frames: np.ndarray, colors: int) -> Image.Image:
    """Compute a common palette from up to 16 evenly spaced frames."""
    chosen = frames[np.linspace(0, len(frames) - 1, min(16, len(frames))).round().astype(int)]
    return Image.fromarray(chosen.reshape(-1, *chosen.shape[2:])).quantize(colors, method=Image.Quantize.MEDIANCUT)


def shown_frames(dream: Dream) -> list[int]:
    """Choose `STRIP_FRAMES` to show: the last two of the context, then evenly spaced ones to the end."""
    last = dream.real.shape[1] - 1
    context = list(range(max(0, dream.context - 2), dream.context))
    rest = np.linspace(dream.context, last, STRIP_FRAMES - len(context)).round().astype(int)
    return [*context, *sorted(set(rest.tolist()))]


def film_strip(dream: Dream, frames: Sequence[int]) -> np.ndarray:
    """Compose frames of the first window side by side in three rows: real, reconstructed, imagined.

    Borders of the lower two rows are green where the model has observed the image and orange where it predicts.

    Returns:
        (3 (2 H + 6), F (2 W + 6), 3) uint8: pixels are enlarged twice, and borders have 3 pixels.
    """
    chosen = np.array(frames)
    seen = np.where((chosen < dream.context)[:, None], CONTEXT_COLOR, OPEN_LOOP_COLOR)  # (F, 3)
    colors = (np.broadcast_to(WHITE, seen.shape), np.broadcast_to(CONTEXT_COLOR, seen.shape), seen)
    rows = [
        np.concatenate(list(add_border(enlarge(images[0, chosen], 2), color, 3)), axis=1)
        for images, color in zip((dream.real, dream.reconstructed, dream.imagined), colors, strict=True)
    ]
    return np.concatenate(rows)
