"""Cameras with a lower rate than control: they repeat the same image until the next frame.

Shapes: N worlds, M rows. Images are uint8 RGB.
"""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor


class FrameHold:
    """Holds the newest frame of each of N cameras.

    All cameras take their frames in the same control steps, so that they are rendered in one batch. A camera whose
    episode begins takes a frame at once and the next one with the others, so its first frame is held for a random
    time, as with a camera that does not start with the flight. If all episodes begin together, all cameras restart.

    Args:
        interval: control steps from one frame to the next.
        draw: renders the current images of all worlds if given None, else of the masked rows.
    """

    def __init__(self, interval: int, draw: Callable[[Tensor | None], Tensor]) -> None:
        self._interval, self._draw = interval, draw
        self._steps = 0  # control steps since the last frame
        self._images: Tensor | None = None  # (N, height, width, 3)

    @property
    def next_is_frame(self) -> bool:
        """Whether the next control step ends with a new frame."""
        return self._steps + 1 >= self._interval

    def begin(self, mask: Tensor | None) -> None:
        """Take a frame in the worlds whose episode begins, (N,) bool; in all if None."""
        if mask is None or self._images is None:
            self._images, self._steps = self._draw(None), 0
        else:
            self._images[mask] = self._draw(mask)

    def step(self) -> None:
        """Advance by one control step, and take a frame if one is due."""
        self._steps += 1
        if self._steps >= self._interval:
            self._images, self._steps = self._draw(None), 0

    def show(self, rows: Tensor | None) -> Tensor:
        """Return copies of the held images (M, height, width, 3): of all worlds, a mask (N,) bool or indices (M,)."""
        assert self._images is not None, "reset() comes first"
        return self._images.clone() if rows is None else self._images[rows]

    def state_dict(self) -> dict[str, Any]:
        """Return the held images and their age."""
        return {"steps": self._steps, "images": None if self._images is None else self._images.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        images = state_dict["images"]
        self._steps, self._images = state_dict["steps"], None if images is None else images.clone()
