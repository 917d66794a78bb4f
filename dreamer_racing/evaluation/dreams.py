"""What a world model sees, reconstructs and imagines, stored small beside an evaluation to be shown later.

Shapes: W windows of T stored frames, H × W pixels, RGB, uint8; C frames of context; K control steps of an episode;
B stretches of a flight, D belief, S state of a world model.
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
"""Images uint8 ``(B, T, H, W, 3)`` of beliefs ``(B, T, D)``, states ``(B, T, S)`` and target gates int64 ``(B, T)``."""

SEEN_FRAMES, PREDICTED_FRAMES = 3, 10  # that are stored: seen by the model, then predicted on its own
FARTHEST = 100.0  # largest number of a race vector that is drawn, of its order-one units [choice]
STRIDE = 4  # control steps from one stored frame to the next: noisy images of a young model take 10 KB each


@dataclass(frozen=True)
class Dream:
    """Windows of a flight: what the camera saw, what the model made of it, and what it imagined."""

    real: np.ndarray
    """(W, T, H, W, 3)."""
    reconstructed: np.ndarray
    """(W, T, H, W, 3): drawn from latents that saw every image up to and including this one."""
    imagined: np.ndarray
    """(W, T, H, W, 3): likewise in the context, then predicted from the actions alone."""
    context: int
    """C: frames of each window that the model saw before it imagined."""
    frame_dt: float
    """From one frame to the next, s."""
    from_pose: bool = False
    """Whether the model's images are views from the pose that it decodes, instead of images that it decodes."""

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
            from_pose=np.array(self.from_pose),
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
                from_pose = bool(file["from_pose"])
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} holds no dream, or half of one.") from error
        imagined = np.concatenate((reconstructed[:, :context], predicted), axis=1)
        return cls(real, reconstructed, imagined, context, frame_dt, from_pose)


class BelievedView:
    """Draws what the camera would see where a world model that decodes the race's state believes the drone to be.

    Args:
        decoder: Of the race vector, from features.
        worlds: Whose hall is drawn.
    """

    NEIGHBOURS = (0, -1, 1)  # the model may have passed a gate earlier or later than the flight did
    PREFERENCE = 0.01  # misfit by which a neighbour must be better, for gates may look alike [choice]

    def __init__(self, decoder: VectorDecoder, worlds: RaceWorlds) -> None:
        self._decoder, self._worlds = decoder, worlds

    @torch.no_grad()
    def __call__(self, belief: Tensor, state: Tensor, target_gate: Tensor) -> Tensor:
        """Draw, as every ``Painter``."""
        vector = self._decoder(torch.cat((belief, state), -1)).flatten(0, 1).to(self._worlds.device)
        vector = vector.nan_to_num(0.0).clamp(-FARTHEST, FARTHEST)  # of a model that has not learned yet
        gate, count = target_gate.flatten().to(vector.device), self._worlds.track.num_gates
        poses = [self._worlds.race_vector.pose(vector, (gate + offset) % count) for offset in self.NEIGHBOURS]
        position, attitude, misfit = (torch.stack(parts) for parts in zip(*poses, strict=True))
        misfit[1:] += self.PREFERENCE
        best, rows = misfit.argmin(0), torch.arange(len(vector), device=vector.device)
        images = self._worlds.picture(position[best, rows], attitude[best, rows])
        return images.unflatten(0, belief.shape[:2])


def find_painter(learner: WorldModelLearner, worlds: RaceWorlds) -> Painter | None:
    """Return what shows a learner's latents: its image decoder, or a view from the pose that it decodes, or nothing."""
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
    """Let a world model see the first records of stretches of a flight, and predict the others from its actions.

    Args:
        learner: Whose world model.
        trajectory: A recorded episode with images.
        painter: What shows its latents.
        parts: Stretches, of one length T.
        context: Records that it sees; None: all.

    Returns:
        Images uint8 ``(B, T, H, W, 3)``, one row a stretch.
    """
    assert trajectory.pixels is not None
    action = torch.nn.functional.pad(trajectory.action, (0, 0, 1, 0))  # (K + 1, A) the action that led here
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
    """Let a world model reconstruct and imagine stretches of a flight.

    Args:
        learner: whose world model.
        trajectory: a recorded episode with images.
        painter: what shows its latents; None where nothing does.
        windows: W at most; they begin at even distances.

    Returns:
        The dream; None if nothing shows it or the flight is too short.
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
    imagined[:, :seen] = reconstructed[:, :seen]  # rather than another sample of the same latents
    return Dream(
        real=torch.stack([pixels[part] for part in parts])[:, ::STRIDE].numpy(),
        reconstructed=reconstructed[:, ::STRIDE].numpy(),
        imagined=imagined[:, ::STRIDE].numpy(),
        context=SEEN_FRAMES,
        frame_dt=STRIDE * trajectory.control_dt,
        from_pose=isinstance(painter, BelievedView),
    )
