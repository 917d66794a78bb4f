"""What cameras show that are slower than control: the same image, until they take the next frame.

Shapes: N worlds, M rows. Images are uint8 RGB.
"""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor


class HeldFrames:
    """The newest frame of each of N cameras.

    All take a frame in the same control step, so that they are drawn together. Where an episode begins, its camera
    takes one at once, and the next one with the others: how long a first frame is held is left to chance, as where a
    camera is not started with the flight. If all episodes begin together, so do their cameras.

    Args:
        interval: control steps from one frame to the next.
        draw: draws what the cameras see now, of all worlds if given None, or of rows.
    """

    def __init__(self, interval: int, draw: Callable[[Tensor | None], Tensor]) -> None:
        self._interval, self._draw = interval, draw
        self._steps = 0  # control steps since the last frame
        self._images: Tensor | None = None  # (N, height, width, 3)

    @property
    def next_is_frame(self) -> bool:
        """Whether the coming control step ends with a frame."""
        return self._steps + 1 >= self._interval

    def begin(self, mask: Tensor | None) -> None:
        """Take a frame where episodes begin, (N,) bool; everywhere if None."""
        if mask is None or self._images is None:
            self._images, self._steps = self._draw(None), 0
        else:
            self._images[mask] = self._draw(mask)

    def step(self) -> None:
        """Let a control step pass."""
        self._steps += 1
        if self._steps >= self._interval:
            self._images, self._steps = self._draw(None), 0

    def show(self, rows: Tensor | None) -> Tensor:
        """Copies of what the cameras show, (M, height, width, 3): of all worlds, a mask (N,) bool, or numbers (M,)."""
        assert self._images is not None, "an episode has begun"
        return self._images.clone() if rows is None else self._images[rows]

    def state_dict(self) -> dict[str, Any]:
        """Return what is shown, and for how long it has been."""
        return {"steps": self._steps, "images": None if self._images is None else self._images.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from what `state_dict` returned."""
        images = state_dict["images"]
        self._steps, self._images = state_dict["steps"], None if images is None else images.clone()
