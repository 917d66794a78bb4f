"""Losses of the DreamerV3 learner, each a TorchRL ``LossModule`` that also works alone.

A loss is chosen by name in ``LossConfig``. To add one, put a class with ``from_config(agent, config)`` under a new
name; it must read and write the keys that the class it replaces documents. See ``docs/losses.md``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

from torchrl.objectives import LossModule

from dreamer_racing.losses.actor import ActorLoss, DynamicsActorLoss, ReinforceLoss
from dreamer_racing.losses.asymmetric_ppo_actor import AsymmetricPPOActorLoss
from dreamer_racing.losses.config import HORIZON, ActorPPOConfig, LossConfig
from dreamer_racing.losses.critic import CriticLoss, replay_return
from dreamer_racing.losses.flown_ppo_actor import FlownPPOActorLoss
from dreamer_racing.losses.imagination import Imagination, imagine, lambda_return
from dreamer_racing.losses.ppo_actor import PPOActorLoss
from dreamer_racing.losses.representation import (
    DecoderFreeLoss,
    InformedLoss,
    PrivilegedLoss,
    ReconstructionLoss,
    redundancy_reduction,
)
from dreamer_racing.losses.world_model import KL_MODES, WorldModelLoss, kl_losses
from dreamer_racing.modules.agent import Agent

T = TypeVar("T")


class LossClass(Protocol):
    """A loss that can be made of an agent and numbers."""

    def from_config(self, agent: Agent, config: LossConfig, **own: Any) -> LossModule:
        """Make the loss of an agent with the losses' numbers; an actor's is given its ``horizon`` too."""
        ...


WORLD_MODEL_LOSSES: dict[str, type[WorldModelLoss]] = {
    "reconstruction": ReconstructionLoss,
    "informed": InformedLoss,
    "privileged": PrivilegedLoss,
    "decoder_free": DecoderFreeLoss,
    "reward_only": WorldModelLoss,
}
ACTOR_LOSSES: dict[str, LossClass] = {
    "reinforce": ReinforceLoss,
    "dynamics": DynamicsActorLoss,
    "ppo": PPOActorLoss,
    "flown_ppo": FlownPPOActorLoss,
    "asymmetric_ppo": AsymmetricPPOActorLoss,
}
CRITIC_LOSSES: dict[str, LossClass] = {"two_hot": CriticLoss}


def find_loss(registry: Mapping[str, T], name: str) -> T:
    """Return the class registered under a name, or found in a module.

    Args:
        registry: ``WORLD_MODEL_LOSSES``, ``ACTOR_LOSSES`` or ``CRITIC_LOSSES``.
        name: Key of the registry, or ``module:Class`` of a loss of your own.

    Raises:
        ValueError: If no loss has that name; the message lists those that exist.
    """
    module, colon, attribute = name.partition(":")
    if colon:
        try:
            return getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"Loss {name!r}, given as module:Class, cannot be imported: {error}.") from error
    if name not in registry:
        raise ValueError(
            f"Unknown loss {name!r}. Known here: {', '.join(registry)}; a loss of your own is given as module:Class."
        )
    return registry[name]


def make_losses(agent: Agent, config: LossConfig, horizon: int = HORIZON) -> dict[str, LossModule]:
    """Make the three losses of an agent, by their names, on its device.

    Args:
        agent: The networks that they train; it must have decoders if the world model's loss ``decodes``.
        config: Which they are, and their numbers.
        horizon: H, imagined actions from each start.

    Returns:
        ``world_model``, ``actor`` and ``critic``, as ``DreamerLearner`` takes them.

    Raises:
        ValueError: If there is no loss of a name.
    """
    device = next(agent.parameters()).device
    losses = {
        "world_model": find_loss(WORLD_MODEL_LOSSES, config.world_model).from_config(agent, config),
        "actor": find_loss(ACTOR_LOSSES, config.actor).from_config(agent, config, horizon=horizon),
        "critic": find_loss(CRITIC_LOSSES, config.critic).from_config(agent, config),
    }
    return {name: loss.to(device) for name, loss in losses.items()}


__all__ = [
    "ACTOR_LOSSES",
    "CRITIC_LOSSES",
    "KL_MODES",
    "WORLD_MODEL_LOSSES",
    "ActorLoss",
    "ActorPPOConfig",
    "AsymmetricPPOActorLoss",
    "CriticLoss",
    "DecoderFreeLoss",
    "DynamicsActorLoss",
    "FlownPPOActorLoss",
    "Imagination",
    "InformedLoss",
    "LossClass",
    "LossConfig",
    "PPOActorLoss",
    "PrivilegedLoss",
    "ReconstructionLoss",
    "ReinforceLoss",
    "WorldModelLoss",
    "find_loss",
    "imagine",
    "kl_losses",
    "lambda_return",
    "make_losses",
    "redundancy_reduction",
    "replay_return",
]
