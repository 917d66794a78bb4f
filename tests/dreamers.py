"""Learners for tests, from a flat list of numbers, and what they make of given latents."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.losses import Latents, Trajectory
from dreamer_racing.modules import RSSM, SIZES, Interface, ModelSize

OF_UPDATES = {field.name for field in dataclasses.fields(LearnerConfig)}
Places = Sequence[tuple[int, int]]
"""Records of windows: (window, step) of each."""


def learner_of(
    size: ModelSize | str = "debug",
    interface: Interface | None = None,
    *,
    kind: Any = DreamerV3,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    horizon: int = 16,
    **numbers: Any,
) -> Any:
    """A learner with numbers of its losses and of `LearnerConfig`."""
    of_updates = {name: value for name, value in numbers.items() if name in OF_UPDATES}
    losses = kind.Losses(**{name: value for name, value in numbers.items() if name not in OF_UPDATES})
    config = LearnerConfig(imagination_horizon=horizon, **of_updates)
    return kind.make(size, interface, losses, config, device=device, seed=seed)


latent_ppo_of = functools.partial(learner_of, kind=LatentPPO)


def learner_by(actor: str, *size_and_interface: Any, horizon: int = 3, **numbers: Any) -> Any:
    """A learner whose actor imagines, or that of ``latent_ppo``."""
    if actor == "latent_ppo":
        return latent_ppo_of(*size_and_interface, seed=0, **numbers)
    return learner_of(*size_and_interface, seed=0, horizon=horizon, actor=actor, **numbers)


def make_windows(
    batch: int,
    time: int,
    *,
    is_init: Places = (),
    terminated: Places = (),
    truncated: Places = (),
    image_size: int = 64,
    vector: int = 0,
    privileged: int = 0,
) -> TensorDict:
    """Windows of random records, some of which are flagged."""
    shape, generator = (batch, time), torch.Generator().manual_seed(1)
    flags = {name: torch.zeros(*shape, 1, dtype=torch.bool) for name in ("is_init", "terminated", "truncated")}
    for flag, places in zip(flags.values(), (is_init, terminated, truncated), strict=True):
        for place in places:
            flag[place] = True
    images = torch.randint(0, 256, (*shape, image_size, image_size, 3), dtype=torch.uint8, generator=generator)
    widths = {"reward": 1, "vector": vector, ("privileged", "vector"): privileged}
    numbers = {key: torch.randn(*shape, width, generator=generator) for key, width in widths.items() if width}
    action = torch.rand(*shape, 4, generator=generator) * 2 - 1
    return TensorDict({"pixels": images, "previous_action": action, **numbers, **flags}, shape)


def differing(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> set[str]:
    """Names of tensors that are not the same in both, or that only one has."""
    both = found.keys() & expected.keys()
    return (found.keys() ^ expected.keys()) | {name for name in both if not torch.equal(found[name], expected[name])}


def rssm_of(**numbers: Any) -> RSSM:
    """An RSSM of embeddings of 8 and actions of 4 numbers, D = 16, L = 3, K = 4, unless other numbers are given."""
    size = {"belief": 16, "hidden": 8, "latents": 3, "classes": 4, **numbers}
    return RSSM(dataclasses.replace(SIZES["size1m"], **size), embedding=8, action=4)


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
