"""World-model loss: prediction, dynamics and representation.

Shape legend: B batch, T time, L latents, K classes, D belief, S state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from dreamer_racing.modules.rssm import Posterior, mix_uniform
from dreamer_racing.modules.world_model import WorldModel, join_features

if TYPE_CHECKING:
    from dreamer_racing.learner import Agent, LearnerConfig


def kl_losses(
    posterior_logits: Tensor, prior_logits: Tensor, free_nats: float, unimix: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the two KL losses between posterior and prior.

    The free nats apply to the sum over latents, not to each categorical.

    Args:
        posterior_logits: ``(..., L, K)``.
        prior_logits: ``(..., L, K)``.
        free_nats: KL below which there is no gradient, nats.
        unimix: Share of the uniform distribution in both.

    Returns:
        The dynamics loss, which moves the prior only; the representation loss, which moves the posterior only; and the
        plain KL without gradient; each ``(...)``, nats.

    Reference: DreamerV3, Eq. 5.
    """
    posterior, prior = mix_uniform(posterior_logits, unimix), mix_uniform(prior_logits, unimix)
    log_posterior, log_prior = posterior.log(), prior.log()
    dynamics = (posterior.detach() * (log_posterior.detach() - log_prior)).sum((-2, -1))
    representation = (posterior * (log_posterior - log_prior.detach())).sum((-2, -1))
    return dynamics.clamp_min(free_nats), representation.clamp_min(free_nats), dynamics.detach()


class WorldModelLoss(LossModule):
    """Image, reward and continuation losses plus the dynamics and representation losses.

    Args:
        world_model: The module to train.
        dynamics_scale: Weight of KL(sg(posterior) ‖ prior).
        representation_scale: Weight of KL(posterior ‖ sg(prior)).
        free_nats: KL, summed over latents, below which there is no gradient, nats.

    Reads a batch ``[B, T]`` of replay records: ``pixels``, ``previous_action``, ``reward``, ``is_init``,
    ``terminated``. Writes, as scalars, ``loss_image`` (squared error summed over an image's pixels), ``loss_reward``,
    ``loss_continue``, ``loss_dynamics``, ``loss_representation``, the metrics ``kl``, ``image_error`` (mean squared
    error of a pixel), ``reward_error`` (mean absolute); and ``replay_context``, batch ``[B, T]``, with ``belief`` and
    ``state``, which carry gradient.

    Reference: DreamerV3, Eq. 4-6.
    """

    in_keys = ["pixels", "previous_action", "reward", "is_init", "terminated"]
    out_keys = [
        "loss_image",
        "loss_reward",
        "loss_continue",
        "loss_dynamics",
        "loss_representation",
        "kl",
        "image_error",
        "reward_error",
        "replay_context",
    ]

    def __init__(
        self,
        world_model: WorldModel,
        *,
        dynamics_scale: float = 1.0,
        representation_scale: float = 0.1,
        free_nats: float = 1.0,
    ) -> None:
        super().__init__()
        self.world_model = world_model
        self.dynamics_scale = dynamics_scale
        self.representation_scale = representation_scale
        self.free_nats = free_nats

    @classmethod
    def from_config(cls, agent: Agent, config: LearnerConfig) -> WorldModelLoss:
        """Make the loss of an agent with a learner's numbers."""
        return cls(
            agent.world_model,
            dynamics_scale=config.dynamics_scale,
            representation_scale=config.representation_scale,
            free_nats=config.free_nats,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the losses of a batch ``[B, T]``; keys in the class's docstring."""
        pixels = tensordict.get("pixels")
        posterior = self.world_model.observe(
            pixels, tensordict.get("previous_action"), tensordict.get("is_init").squeeze(-1)
        )
        losses = self._image_losses(posterior, pixels)
        losses |= self._head_losses(posterior, tensordict.get("reward"), tensordict.get("terminated"))
        losses |= self._kl_losses(posterior)
        context = TensorDict({"belief": posterior.belief, "state": posterior.state}, tensordict.batch_size)
        return TensorDict({**losses, "replay_context": context}, [])

    def _image_losses(self, posterior: Posterior, pixels: Tensor) -> dict[str, Tensor]:
        error = self.world_model.decoder.squared_error(posterior.belief, posterior.state, pixels)
        # Mean over the batch of the sum over an image.
        return {"loss_image": error * pixels.shape[-3:].numel(), "image_error": error.detach()}

    def _head_losses(self, posterior: Posterior, reward: Tensor, terminated: Tensor) -> dict[str, Tensor]:
        features = join_features(posterior.belief, posterior.state)
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
            posterior.posterior_logits, posterior.prior_logits, self.free_nats, self.world_model.rssm.unimix
        )
        return {
            "loss_dynamics": self.dynamics_scale * dynamics.mean(),
            "loss_representation": self.representation_scale * representation.mean(),
            "kl": kl.mean(),
        }
