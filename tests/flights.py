"""Flights and dreams that are written down, for tests of evaluation and figures."""

from __future__ import annotations

import numpy as np
import torch

from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import Trajectory


def random_flight(steps: int = 60, outcome: str | None = "ground", pixels: bool = False) -> Trajectory:
    generator = torch.Generator().manual_seed(0)
    rows = {name: torch.randn(steps + 1, size, generator=generator) for name, size in (("p", 3), ("q", 4), ("v", 3))}
    return Trajectory(
        position=rows["p"],
        attitude=rows["q"] / rows["q"].norm(dim=-1, keepdim=True),
        linear_velocity=rows["v"] * 1e-7,
        target_gate=torch.arange(steps + 1) // 25,
        action=torch.rand(steps, 4, generator=generator),
        pixels=torch.randint(0, 256, (steps + 1, 64, 64, 3), dtype=torch.uint8) if pixels else None,
        control_dt=0.02,
        outcome=outcome,
    )


def level_flight(position: torch.Tensor, **fields: object) -> Trajectory:
    """Through positions (K + 1, 3), level and at rest unless fields say otherwise."""
    rows = len(position)
    still = {
        "attitude": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, 1),
        "linear_velocity": torch.zeros(rows, 3),
        "target_gate": torch.zeros(rows, dtype=torch.int64),
        "action": torch.zeros(rows - 1, 4),
    }
    return Trajectory(position, **{**still, "pixels": None, "control_dt": 0.02, "outcome": None, **fields})


def flat_dream(context: int = 3, frames: int = 13) -> Dream:
    """Real is 10 everywhere, reconstructed 20, imagined 30."""
    images = [np.full((1, frames, 8, 8, 3), value, dtype=np.uint8) for value in (10, 20, 30)]
    return Dream(*images, context=context, frame_dt=0.08)
