"""Learners for tests, from a flat list of numbers."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from dreamer_racing.learners.dreamer import DreamerLearner, make_dreamer
from dreamer_racing.learners.dreamer_config import LearnerConfig
from dreamer_racing.losses import LossConfig
from dreamer_racing.modules import Interface, ModelSize

OF_LOSSES = {field.name for field in dataclasses.fields(LossConfig)}


def learner_of(
    size: ModelSize | str = "debug",
    interface: Interface | None = None,
    *,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    horizon: int = 16,
    **numbers: Any,
) -> DreamerLearner:
    """A learner with numbers of `LossConfig` and of `LearnerConfig`."""
    losses = LossConfig(**{name: value for name, value in numbers.items() if name in OF_LOSSES})
    config = LearnerConfig(**{name: value for name, value in numbers.items() if name not in OF_LOSSES})
    return make_dreamer(size, interface, losses, config, horizon=horizon, device=device, seed=seed)
