"""Observed, reconstructed and imagined images of a world model, stored compactly with an evaluation for display.

Shapes: W windows (1 is recorded) of T stored frames, H × W pixels, RGB, uint8; C frames of context; K control steps of
an episode; B sequences of latents, D belief, S state of a world model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from dreamer_racing.evaluation.trajectory import BROKEN_NPZ, Trajectory, swapped_in
from dreamer_racing.losses import State
from dreamer_racing.modules.autoencoder import VectorDecoder

if TYPE_CHECKING:
    from dreamer_racing.envs.worlds import RaceWorlds
    from dreamer_racing.learners.update import WorldModelLearner

Painter = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Maps beliefs ``(B, T, D)``, states ``(B, T, S)``, target gates int64 ``(B, T)`` to uint8 ``(B, T, H, W, 3)``."""

SEEN_FRAMES, PREDICTED_FRAMES = 3, 10  # stored frames: observed by the model, then predicted open loop
FARTHEST = 100.0  # clips decoded race vectors, whose entries are of order one [choice]
STRIDE = 4  # control steps per stored frame; the noisy images of a barely trained model take 10 KB each


@dataclass(frozen=True)
class Dream:
    """Windows of a flight: camera images, the model's reconstructions, and its open-loop predictions."""

    real: np.ndarray
    """(W, T, H, W, 3)."""
    reconstructed: np.ndarray
    """(W, T, H, W, 3): from posterior latents, which depend on all images up to and including this one."""
    imagined: np.ndarray
    """(W, T, H, W, 3): reconstructed within the context, then predicted from the actions alone."""
    context: int
    """C: frames of each window that the model observed before it predicted."""
    frame_dt: float
    """Time between frames, s."""
    from_pose: bool = False
    """Whether the model's images are rendered from a decoded pose, not decoded directly."""

    def save(self, path: str | Path) -> None:
        """Write a compressed `.npz` atomically."""
        predicted = self.imagined[:, self.context :]  # the context equals the reconstruction
        with swapped_in(path) as partial:
            np.savez_compressed(partial, **{**vars(self), "imagined": predicted})

    @classmethod
    def load(cls, path: str | Path) -> Dream:
        """Read a file written by `save`.

        Raises:
            ValueError: the file is of another kind or incomplete.
            OSError: the file cannot be read.
        """
        try:
            with np.load(path) as file:
                real, reconstructed, predicted = (file[name] for name in ("real", "reconstructed", "imagined"))
                context, frame_dt = int(file["context"]), float(file["frame_dt"])
                from_pose = bool(file["from_pose"])
        except BROKEN_NPZ as error:
            raise ValueError(f"{path} holds no dream, or an incomplete one.") from error
        imagined = np.concatenate((reconstructed[:, :context], predicted), axis=1)
        return cls(real, reconstructed, imagined, context, frame_dt, from_pose)


class BelievedView:
    """Painter for world models that decode the race vector: renders the camera image at the decoded pose."""

    NEIGHBOURS = (0, -1, 1)  # the model may predict a gate pass earlier or later than in the flight
    PREFERENCE = 0.01  # a neighbouring gate must fit better by this misfit, because gates may look alike [choice]

    def __init__(self, decoder: VectorDecoder, worlds: RaceWorlds) -> None:
        self._decoder, self._worlds = decoder, worlds

    @torch.no_grad()
    def __call__(self, belief: Tensor, state: Tensor, target_gate: Tensor) -> Tensor:
        """Return the images, as every ``Painter`` does."""
        vector = self._decoder(torch.cat((belief, state), -1)).flatten(0, 1).to(self._worlds.device)
        vector = vector.nan_to_num(0.0).clamp(-FARTHEST, FARTHEST)  # an untrained model's
        gate, count = target_gate.flatten().to(vector.device), self._worlds.track.num_gates
        poses = [self._worlds.race_vector.pose(vector, (gate + offset) % count) for offset in self.NEIGHBOURS]
        position, attitude, misfit = (torch.stack(parts) for parts in zip(*poses, strict=True))
        misfit[1:] += self.PREFERENCE
        best, rows = misfit.argmin(0), torch.arange(len(vector), device=vector.device)
        images = self._worlds.render_at(position[best, rows], attitude[best, rows])
        return images.unflatten(0, belief.shape[:2])


def find_painter(learner: WorldModelLearner, worlds: RaceWorlds) -> Painter | None:
    """Return the image decoder of a learner, else a `BelievedView` if it decodes the race vector, else None."""
    model = learner.agent.world_model
    if model.decoder is not None:
        return lambda belief, state, _: model.images(belief, state)
    for target in learner.world_model_loss.targets.values():
        if isinstance(target, State):
            return BelievedView(target.decoder, worlds)
    return None


@torch.no_grad()
def dream(
    learner: WorldModelLearner, trajectory: Trajectory, painter: Painter, part: slice, context: int | None = None
) -> Tensor:
    """Let a world model observe the first records of a part of a flight and predict the rest from the actions.

    Args:
        learner: The learner with the world model.
        trajectory: A recorded episode with images.
        painter: See `find_painter`.
        part: T rows of the flight.
        context: Number of records observed; None: all.

    Returns:
        Images uint8 ``(T, H, W, 3)``.
    """
    assert trajectory.pixels is not None
    action = torch.nn.functional.pad(trajectory.action, (0, 0, 1, 0))  # (K + 1, A) action before each row
    flight = {"pixels": trajectory.pixels, "previous_action": action, "target_gate": trajectory.target_gate}
    beside = {"imu": trajectory.imu, "vector": trajectory.vector}
    flight |= {name: numbers for name, numbers in beside.items() if numbers is not None}
    window = TensorDict({name: value[part][None] for name, value in flight.items()}, [1, part.stop - part.start])
    window["is_init"] = torch.zeros(*window.shape, 1, dtype=torch.bool)
    window["is_init"][:, 0] = True
    latents = learner.open_loop(window, context or window.shape[1])
    return painter(*latents, window["target_gate"])[0].cpu()


def record_dream(learner: WorldModelLearner, trajectory: Trajectory, painter: Painter | None) -> Dream | None:
    """Let a world model reconstruct and imagine the beginning of a flight.

    Returns None without a painter or images, or if the flight is too short.
    """
    pixels = trajectory.pixels
    if painter is None or pixels is None or len(pixels) <= SEEN_FRAMES * STRIDE:
        return None
    frames = min(SEEN_FRAMES + PREDICTED_FRAMES - 1, (len(pixels) - 1) // STRIDE)
    part = slice(0, STRIDE * frames + 1)  # ends with a stored frame
    seen = STRIDE * (SEEN_FRAMES - 1) + 1
    reconstructed = dream(learner, trajectory, painter, part)
    imagined = dream(learner, trajectory, painter, part, seen)
    imagined[:seen] = reconstructed[:seen]  # the same sample of the latents in both
    frame_dt, from_pose = STRIDE * trajectory.control_dt, isinstance(painter, BelievedView)
    real, observed, predicted = (images[None, ::STRIDE].numpy() for images in (pixels[part], reconstructed, imagined))
    return Dream(real, observed, predicted, SEEN_FRAMES, frame_dt, from_pose)
