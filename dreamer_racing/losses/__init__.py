"""Losses of the DreamerV3 learner, each a TorchRL ``LossModule`` that also works alone.

A loss is chosen by name in ``LossConfig``. To add one, put a subclass of ``WorldModelLoss``, ``ActorLoss`` or
``CriticLoss`` under a new name; it must read and write the keys that the class it replaces documents. See
``docs/losses.md``.
"""

from __future__ import annotations

import importlib
from typing import Any, TypeVar

from torchrl.objectives import LossModule

from dreamer_racing.losses.actor import ActorLoss, DynamicsActorLoss, ReinforceLoss
from dreamer_racing.losses.asymmetric_ppo_actor import AsymmetricPPOActorLoss
from dreamer_racing.losses.config import HORIZON, ActorPPOConfig, LossConfig
from dreamer_racing.losses.critic import CriticLoss, replay_return
from dreamer_racing.losses.flown_ppo_actor import FlownPPOActorLoss
from dreamer_racing.losses.imagination import Imagination, imagine, lambda_return
from dreamer_racing.losses.latent_ppo_actor import LatentPPOActorLoss
from dreamer_racing.losses.own_critic_actor import OwnCriticActorLoss
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
from dreamer_racing.settings import suggestion

Loss = TypeVar("Loss", bound=LossModule)

WORLD_MODEL_LOSSES: dict[str, type[WorldModelLoss]] = {
    "reconstruction": ReconstructionLoss,
    "informed": InformedLoss,
    "privileged": PrivilegedLoss,
    "decoder_free": DecoderFreeLoss,
    "reward_only": WorldModelLoss,
}
ACTOR_LOSSES: dict[str, type[ActorLoss]] = {
    "reinforce": ReinforceLoss,
    "dynamics": DynamicsActorLoss,
    "ppo": PPOActorLoss,
    "flown_ppo": FlownPPOActorLoss,
    "latent_ppo": LatentPPOActorLoss,
    "asymmetric_ppo": AsymmetricPPOActorLoss,
}
CRITIC_LOSSES: dict[str, type[CriticLoss]] = {"two_hot": CriticLoss}


def find_loss(kind: type[Loss], name: str) -> type[Loss]:
    """Return the class registered under a name, or found in a module.

    Args:
        kind: ``WorldModelLoss``, ``ActorLoss`` or ``CriticLoss``.
        name: In the registry of its kind, or ``module:Class`` of a loss of your own.

    Raises:
        ValueError: If no loss has that name, where the message lists those that exist; or if it is none of that kind.
    """
    registries: dict[Any, dict] = {
        WorldModelLoss: WORLD_MODEL_LOSSES,
        ActorLoss: ACTOR_LOSSES,
        CriticLoss: CRITIC_LOSSES,
    }
    module, colon, attribute = name.partition(":")
    if colon:
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"Loss {name!r}, given as module:Class, cannot be imported: {error}.") from error
    elif (found := registries[kind].get(name)) is None:
        known = ", ".join(registries[kind])
        meant = suggestion(name, registries[kind])
        raise ValueError(
            f"Unknown loss {name!r}{meant}. Known here: {known}; a loss of your own is given as module:Class."
        )
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ValueError(f"Loss {name!r} is no {kind.__name__}: subclass that, or its nearest child.")
    return found


def make_losses(agent: Agent, config: LossConfig, horizon: int = HORIZON) -> dict[str, LossModule]:
    """Make the three losses of an agent, by their names, on its device.

    Args:
        agent: The networks that they train; it must have decoders if the world model's loss ``decodes``.
        config: Which they are, and their numbers.
        horizon: H, imagined actions from each start.

    Returns:
        ``world_model``, ``actor`` and ``critic``, as ``DreamerLearner`` takes them.

    Raises:
        ValueError: As ``find_loss``.
    """
    device = next(agent.parameters()).device
    losses: dict[str, LossModule] = {
        "world_model": find_loss(WorldModelLoss, config.world_model).from_config(agent, config),
        "actor": find_loss(ActorLoss, config.actor).from_config(agent, config, horizon=horizon),
        "critic": find_loss(CriticLoss, config.critic).from_config(agent, config),
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
    "LatentPPOActorLoss",
    "LossConfig",
    "OwnCriticActorLoss",
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
