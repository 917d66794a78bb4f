"""Observed, reconstructed and imagined images of a world model, stored compactly with an evaluation for display.

Shapes: W windows of T stored frames, H × W pixels, RGB, uint8; C frames of context; K control steps of an episode;
B segments of a flight, D belief, S state of a world model.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from dreamer_racing.losses import State
from dreamer_racing.modules.autoencoder import VectorDecoder

if TYPE_CHECKING:
    from dreamer_racing.envs.worlds import RaceWorlds
    from dreamer_racing.evaluation.trajectory import Trajectory
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
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        partial = Path(path).with_name(f".{Path(path).name}.partial.npz")
        predicted = self.imagined[:, self.context :]  # the context equals the reconstruction
        np.savez_compressed(
            partial,
            real=self.real,
            reconstructed=self.reconstructed,
            imagined=predicted,
            context=np.array(self.context),
            frame_dt=np.array(self.frame_dt),
            from_pose=np.array(self.from_pose),
        )
        os.replace(partial, path)

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
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} holds no dream, or an incomplete one.") from error
        imagined = np.concatenate((reconstructed[:, :context], predicted), axis=1)
        return cls(real, reconstructed, imagined, context, frame_dt, from_pose)


class BelievedView:
    """Painter for world models that decode the race vector: renders the camera image at the decoded pose.

    Args:
        decoder: Decoder of the race vector from features.
        worlds: Environments that render the scene.
    """

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
    learner: WorldModelLearner, trajectory: Trajectory, painter: Painter, parts: list[slice], context: int | None = None
) -> Tensor:
    """Let a world model observe the first records of segments of a flight and predict the rest from the actions.

    Args:
        learner: The learner with the world model.
        trajectory: A recorded episode with images.
        painter: Function from latents to images.
        parts: Segments of equal length T.
        context: Number of records observed; None: all.

    Returns:
        Images uint8 ``(B, T, H, W, 3)``, one row per segment.
    """
    assert trajectory.pixels is not None
    action = torch.nn.functional.pad(trajectory.action, (0, 0, 1, 0))  # (K + 1, A) action before each row
    flight = {"pixels": trajectory.pixels, "previous_action": action, "target_gate": trajectory.target_gate}
    beside = {"imu": trajectory.imu, "vector": trajectory.vector}
    flight |= {name: numbers for name, numbers in beside.items() if numbers is not None}
    windows = {name: torch.stack([value[part] for part in parts]) for name, value in flight.items()}
    shape = windows["pixels"].shape[:2]
    windows["is_init"] = torch.zeros(*shape, 1, dtype=torch.bool)
    windows["is_init"][:, 0] = True
    latents = learner.open_loop(TensorDict(windows, shape), context or shape[1])
    return painter(*latents, windows["target_gate"]).cpu()


def record_dream(
    learner: WorldModelLearner, trajectory: Trajectory, painter: Painter | None, windows: int = 1
) -> Dream | None:
    """Let a world model reconstruct and imagine windows of a flight.

    Args:
        learner: the learner with the world model.
        trajectory: a recorded episode with images.
        painter: function from latents to images, see `find_painter`.
        windows: maximum of W; windows are evenly spaced.

    Returns:
        The dream; None without a painter or images, or if the flight is too short.
    """
    pixels = trajectory.pixels
    if painter is None or pixels is None or len(pixels) <= SEEN_FRAMES * STRIDE:
        return None
    frames = min(SEEN_FRAMES + PREDICTED_FRAMES - 1, (len(pixels) - 1) // STRIDE)
    length = STRIDE * frames + 1  # ends with a stored frame
    starts = sorted({int(start) for start in np.linspace(0, len(pixels) - length, windows + 1)[:-1]})
    parts = [slice(start, start + length) for start in starts]
    seen = STRIDE * (SEEN_FRAMES - 1) + 1
    reconstructed = dream(learner, trajectory, painter, parts)
    imagined = dream(learner, trajectory, painter, parts, seen)
    imagined[:, :seen] = reconstructed[:, :seen]  # the same sample of the latents in both
    return Dream(
        real=torch.stack([pixels[part] for part in parts])[:, ::STRIDE].numpy(),
        reconstructed=reconstructed[:, ::STRIDE].numpy(),
        imagined=imagined[:, ::STRIDE].numpy(),
        context=SEEN_FRAMES,
        frame_dt=STRIDE * trajectory.control_dt,
        from_pose=isinstance(painter, BelievedView),
    )
