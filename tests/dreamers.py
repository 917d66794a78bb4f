"""Learners for tests, from a flat list of numbers, and what they make of given latents."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses, Latents, Trajectory
from dreamer_racing.modules import Interface, ModelSize

OF_UPDATES = {field.name for field in dataclasses.fields(LearnerConfig)}


def learner_of(
    size: ModelSize | str = "debug",
    interface: Interface | None = None,
    *,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    horizon: int = 16,
    **numbers: Any,
) -> DreamerV3:
    """A learner with numbers of `DreamerV3Losses` and of `LearnerConfig`."""
    config = LearnerConfig(
        imagination_horizon=horizon, **{name: value for name, value in numbers.items() if name in OF_UPDATES}
    )
    losses = DreamerV3Losses(**{name: value for name, value in numbers.items() if name not in OF_UPDATES})
    return DreamerV3.make(size, interface, losses, config, device=device, seed=seed)


def latent_ppo_of(
    size: ModelSize | str = "debug",
    interface: Interface | None = None,
    *,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    **numbers: Any,
) -> LatentPPO:
    """A learner with numbers of `LatentPPOLosses` and of `LearnerConfig`."""
    config = LearnerConfig(**{name: value for name, value in numbers.items() if name in OF_UPDATES})
    losses = LatentPPOLosses(**{name: value for name, value in numbers.items() if name not in OF_UPDATES})
    return LatentPPO.make(size, interface, losses, config, device=device, seed=seed)


def imagine_from(
    learner: DreamerV3, belief: Tensor, state: Tensor, terminated: Tensor | None = None
) -> tuple[dict[str, Tensor], Trajectory]:
    """The losses and metrics of imagining from given latents ``(N, ·)``, and the trajectory that the objective saw.

    They are latents of a window of N records, about which the world model is not asked.
    """
    seen: list[Trajectory] = []
    objective, model_loss, never = learner.objective, learner.world_model_loss, torch.zeros(1, len(belief), 1).bool()

    def watched(trajectory: Trajectory, **numbers: Any) -> tuple[Tensor, dict[str, Tensor]]:
        seen.append(trajectory)
        return objective(trajectory, **numbers)

    watched.through_dynamics = getattr(objective, "through_dynamics", False)  # type: ignore[attr-defined]
    flags = {"is_init": never, "truncated": never, "terminated": never}
    if terminated is not None:
        flags["terminated"] = terminated.unsqueeze(0)
    actions = learner.agent.interface.action_dim
    batch = TensorDict(
        {**flags, "reward": never.float(), "previous_action": torch.zeros(1, len(belief), actions)}, [1, len(belief)]
    )
    learner.objective = watched
    learner.world_model_loss = lambda batch: ({}, Latents(belief.unsqueeze(0), state.unsqueeze(0)))  # type: ignore
    try:
        return learner.compute_losses(batch), seen[0]
    finally:
        learner.objective, learner.world_model_loss = objective, model_loss
