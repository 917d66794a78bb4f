"""Losses of the DreamerV3 learner, each a TorchRL ``LossModule`` that also works alone.

A loss is chosen by name in ``LearnerConfig``. To add one, put a factory ``(agent, config) -> LossModule`` under a new
name; it must read and write the keys that the class it replaces documents.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from torchrl.objectives import LossModule

from dreamer_racing.losses.actor import ActorLoss
from dreamer_racing.losses.critic import CriticLoss, replay_return
from dreamer_racing.losses.imagination import Imagination, imagine, lambda_return
from dreamer_racing.losses.world_model import WorldModelLoss, kl_losses

if TYPE_CHECKING:
    from dreamer_racing.learner import Agent, LearnerConfig

LossFactory = Callable[["Agent", "LearnerConfig"], LossModule]

WORLD_MODEL_LOSSES: dict[str, LossFactory] = {"reconstruction": WorldModelLoss.from_config}
ACTOR_LOSSES: dict[str, LossFactory] = {"reinforce": ActorLoss.from_config}
CRITIC_LOSSES: dict[str, LossFactory] = {"two_hot": CriticLoss.from_config}


def make_loss(registry: dict[str, LossFactory], name: str, agent: Agent, config: LearnerConfig) -> LossModule:
    """Make a registered loss.

    Args:
        registry: ``WORLD_MODEL_LOSSES``, ``ACTOR_LOSSES`` or ``CRITIC_LOSSES``.
        name: Key of the registry.
        agent: Networks.
        config: Numbers.

    Raises:
        ValueError: If no loss has that name; the message lists those that exist.
    """
    if name not in registry:
        raise ValueError(f"Unknown loss {name!r}. Known here: {', '.join(registry)}.")
    return registry[name](agent, config)


__all__ = [
    "ACTOR_LOSSES",
    "CRITIC_LOSSES",
    "WORLD_MODEL_LOSSES",
    "ActorLoss",
    "CriticLoss",
    "Imagination",
    "LossFactory",
    "WorldModelLoss",
    "imagine",
    "kl_losses",
    "lambda_return",
    "make_loss",
    "replay_return",
]
