"""World-model loss: reward, continuation, dynamics and representation; what shapes the latents is a subclass's.

Shape legend: B batch, T time, L latents, K classes, E embedding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Self

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.losses.contract import require_keys
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.rssm import Posterior, mix_uniform
from dreamer_racing.modules.stored_latents import CONTEXT
from dreamer_racing.modules.world_model import WorldModel, join_features


def separate_kl(kl: Tensor, free_nats: float) -> Tensor:
    """Sum the KL ``(..., L)`` over latents, then apply the free nats (DreamerV3)."""
    return kl.sum(-1).clamp_min(free_nats)


def per_latent_kl(kl: Tensor, free_nats: float) -> Tensor:
    """Give every latent its share of the free nats, then sum ``(..., L)`` (TorchRL's ``"balanced"``, for ablations)."""
    return kl.clamp_min(free_nats / kl.shape[-1]).sum(-1)


KL_MODES: dict[str, Callable[[Tensor, float], Tensor]] = {"separate": separate_kl, "per_latent": per_latent_kl}
"""How free nats apply to the KL of each latent, by the name in ``LossConfig``."""


def kl_losses(
    posterior_logits: Tensor, prior_logits: Tensor, free_nats: float, unimix: float, mode: str = LossConfig.kl_mode
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the two KL losses between posterior and prior.

    Args:
        posterior_logits: ``(..., L, K)``.
        prior_logits: ``(..., L, K)``.
        free_nats: KL below which there is no gradient, nats.
        unimix: Share of the uniform distribution in both.
        mode: Key of ``KL_MODES``; the reference applies the free nats to the sum over latents.

    Returns:
        The dynamics loss, which moves the prior only; the representation loss, which moves the posterior only; and the
        plain KL without gradient; each ``(...)``, nats.

    Reference: DreamerV3, Eq. 5.
    """
    posterior, prior = mix_uniform(posterior_logits, unimix), mix_uniform(prior_logits, unimix)
    log_posterior, log_prior = posterior.log(), prior.log()
    dynamics = (posterior.detach() * (log_posterior.detach() - log_prior)).sum(-1)
    representation = (posterior * (log_posterior - log_prior.detach())).sum(-1)
    bound = KL_MODES[mode]
    return bound(dynamics, free_nats), bound(representation, free_nats), dynamics.detach().sum(-1)


class WorldModelLoss(LossModule):
    """Reward and continuation losses plus the dynamics and representation losses.

    On its own this shapes the latents by rewards alone. Subclasses add what else shall shape them in ``represent``:
    ``ReconstructionLoss``, ``InformedLoss``, ``DecoderFreeLoss``. Parameters that a subclass owns are trained, saved
    and restored by the learner with those of the networks.

    Args:
        world_model: The module to train.
        dynamics_scale: Weight of KL(sg(posterior) ‖ prior).
        representation_scale: Weight of KL(posterior ‖ sg(prior)).
        free_nats: KL below which there is no gradient, nats.
        kl_mode: Key of ``KL_MODES``.

    Reads a batch ``[B, T]`` of replay records: what the encoder sees, ``previous_action``, ``reward``, ``is_init``,
    ``terminated``; where the records have a ``context``, windows go on from the first one's latents, else from an
    episode's start. Writes, as scalars, ``loss_reward``, ``loss_continue``, ``loss_dynamics``, ``loss_representation``,
    what ``represent`` adds, the metrics ``kl`` and ``reward_error`` (mean absolute); and ``replay_context``, batch
    ``[B, T]``, with ``belief`` and ``state``, which carry gradient.

    Raises:
        ValueError: If ``kl_mode`` is unknown.

    Reference: DreamerV3, Eq. 4-6.
    """

    decodes: ClassVar[bool] = False
    """Whether the loss trains the world model's decoders, so that they must exist."""
    reads_privileged: ClassVar[bool] = False
    """Whether the loss needs ``("privileged", "vector")`` of the environment."""
    represent_keys: ClassVar[tuple[str, ...]] = ()
    """What ``represent`` writes, all of it."""

    def __init__(
        self,
        world_model: WorldModel,
        *,
        dynamics_scale: float = LossConfig.dynamics_scale,
        representation_scale: float = LossConfig.representation_scale,
        free_nats: float = LossConfig.free_nats,
        kl_mode: str = LossConfig.kl_mode,
    ) -> None:
        super().__init__()
        if kl_mode not in KL_MODES:
            raise ValueError(f"Unknown kl_mode {kl_mode!r}. Known modes: {', '.join(KL_MODES)}.")
        self.world_model = world_model
        self.dynamics_scale = dynamics_scale
        self.representation_scale = representation_scale
        self.free_nats = free_nats
        self.kl_mode = kl_mode
        self.in_keys: list[NestedKey] = [
            *world_model.encoder.keys,
            "previous_action",
            "reward",
            "is_init",
            "terminated",
        ]
        heads = ["loss_reward", "loss_continue", "reward_error", "loss_dynamics", "loss_representation", "kl"]
        self.out_keys = [*self.represent_keys, *heads, "replay_context"]

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return cls(
            agent.world_model,
            dynamics_scale=config.dynamics_scale,
            representation_scale=config.representation_scale,
            free_nats=config.free_nats,
            kl_mode=config.kl_mode,
            **own,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the losses of a batch ``[B, T]``; keys in the class's docstring."""
        require_keys(self, tensordict, self.in_keys)
        embedding = self.world_model.encoder(tensordict)
        rssm, context = self.world_model.rssm, tensordict.get(CONTEXT, None)
        posterior = rssm.observe(
            embedding,
            tensordict.get("previous_action"),
            tensordict.get("is_init").squeeze(-1),
            initial=None if context is None else rssm.latent_format.unpack(context[:, 0]),
        )
        features = join_features(posterior.belief, posterior.state)
        losses = self.represent(posterior, features, embedding, tensordict)
        if unwritten := set(self.represent_keys) - losses.keys():
            names = ", ".join(sorted(unwritten))
            raise ValueError(f"{type(self).__name__}.represent left out {names}, which represent_keys promises.")
        losses |= self._head_losses(features, tensordict.get("reward"), tensordict.get("terminated"))
        losses |= self._kl_losses(posterior)
        context = TensorDict({"belief": posterior.belief, "state": posterior.state}, tensordict.batch_size)
        return TensorDict({**losses, "replay_context": context}, [])

    def represent(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the losses (``loss_*``) and metrics that shape the latents beside rewards; scalars.

        Args:
            posterior: Latents of the batch.
            features: Belief and state side by side, ``(B, T, F)``.
            embedding: What the encoder made of the observations, ``(B, T, E)``.
            tensordict: The batch.
        """
        return {}

    def _head_losses(self, features: Tensor, reward: Tensor, terminated: Tensor) -> dict[str, Tensor]:
        head = self.world_model.reward_head
        logits = head(features)
        with torch.no_grad():
            reward_error = (head.two_hot.decode(logits) - reward).abs().mean()
        continuation = 1.0 - terminated.float()
        return {
            "loss_reward": head.two_hot.cross_entropy(logits.log_softmax(-1), reward).mean(),
            "loss_continue": F.binary_cross_entropy_with_logits(self.world_model.continue_head(features), continuation),
            "reward_error": reward_error,
        }

    def _kl_losses(self, posterior: Posterior) -> dict[str, Tensor]:
        dynamics, representation, kl = kl_losses(
            posterior.posterior_logits,
            posterior.prior_logits,
            self.free_nats,
            self.world_model.rssm.unimix,
            self.kl_mode,
        )
        return {
            "loss_dynamics": self.dynamics_scale * dynamics.mean(),
            "loss_representation": self.representation_scale * representation.mean(),
            "kl": kl.mean(),
        }
