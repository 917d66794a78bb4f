"""What a world model sees, reconstructs and imagines, stored small beside an evaluation to be shown later.

Shapes: W windows of T stored frames, H × W pixels, RGB, uint8; C frames of context; K control steps of an episode.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict

if TYPE_CHECKING:
    from dreamer_racing.evaluation.evaluate import Trajectory
    from dreamer_racing.learners.dreamer import DreamerLearner

SEEN_FRAMES, PREDICTED_FRAMES = 3, 10  # that are stored: seen by the model, then predicted on its own
STRIDE = 4  # control steps from one stored frame to the next: noisy images of a young model take 10 KB each


@dataclass(frozen=True)
class Dream:
    """Windows of a flight: what the camera saw, what the model made of it, and what it imagined."""

    real: np.ndarray
    """(W, T, H, W, 3)."""
    reconstructed: np.ndarray
    """(W, T, H, W, 3): decoded from latents that saw every image up to and including this one."""
    imagined: np.ndarray
    """(W, T, H, W, 3): likewise in the context, then predicted from the actions alone."""
    context: int
    """C: frames of each window that the model saw before it imagined."""
    frame_dt: float
    """From one frame to the next, s."""

    def save(self, path: str | Path) -> None:
        """Write a compressed `.npz`; a kill leaves none or a whole one."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        partial = Path(path).with_name(f".{Path(path).name}.partial.npz")
        predicted = self.imagined[:, self.context :]  # before that, it is the reconstruction
        np.savez_compressed(
            partial,
            real=self.real,
            reconstructed=self.reconstructed,
            imagined=predicted,
            context=np.array(self.context),
            frame_dt=np.array(self.frame_dt),
        )
        os.replace(partial, path)

    @classmethod
    def load(cls, path: str | Path) -> Dream:
        """Read what `save` wrote.

        Raises:
            ValueError: this is no such file.
            OSError: it cannot be read.
        """
        try:
            with np.load(path) as file:
                real, reconstructed, predicted = (file[name] for name in ("real", "reconstructed", "imagined"))
                context, frame_dt = int(file["context"]), float(file["frame_dt"])
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} holds no dream, or half of one.") from error
        imagined = np.concatenate((reconstructed[:, :context], predicted), axis=1)
        return cls(real, reconstructed, imagined, context, frame_dt)


@torch.no_grad()
def record_dream(learner: DreamerLearner, trajectory: Trajectory, windows: int = 1) -> Dream | None:
    """Let a world model reconstruct and imagine stretches of a flight.

    Args:
        learner: whose world model.
        trajectory: a recorded episode with images.
        windows: W at most; they begin at even distances.

    Returns:
        The dream; None if there is no image decoder or the flight is too short.
    """
    pixels = trajectory.pixels
    if learner.agent.world_model.decoder is None or pixels is None or len(pixels) <= SEEN_FRAMES * STRIDE:
        return None
    frames = min(SEEN_FRAMES + PREDICTED_FRAMES - 1, (len(pixels) - 1) // STRIDE)
    length = STRIDE * frames + 1  # ends with a stored frame
    starts = sorted({int(start) for start in np.linspace(0, len(pixels) - length, windows + 1)[:-1]})
    action = torch.nn.functional.pad(trajectory.action, (0, 0, 1, 0))  # (K + 1, A) the action that led here
    parts = [slice(start, start + length) for start in starts]
    real = torch.stack([pixels[part] for part in parts])
    is_init = torch.zeros(*real.shape[:2], 1, dtype=torch.bool)
    is_init[:, 0] = True
    batch = TensorDict(
        {"pixels": real, "previous_action": torch.stack([action[part] for part in parts]), "is_init": is_init},
        batch_size=real.shape[:2],
    )
    reconstructed = learner.open_loop(batch, length).cpu()
    seen = STRIDE * (SEEN_FRAMES - 1) + 1
    imagined = learner.open_loop(batch, seen).cpu()
    imagined[:, :seen] = reconstructed[:, :seen]  # rather than another sample of the same latents
    return Dream(
        real=real[:, ::STRIDE].numpy(),
        reconstructed=reconstructed[:, ::STRIDE].numpy(),
        imagined=imagined[:, ::STRIDE].numpy(),
        context=SEEN_FRAMES,
        frame_dt=STRIDE * trajectory.control_dt,
    )
