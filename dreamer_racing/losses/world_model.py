"""World-model loss: reward, continuation, dynamics and representation, and the targets that shape the latents.

Shape legend: B batch, T time, L latents, K classes, D belief, S state, F = D + S features.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.losses.targets import find_targets
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.rssm import mix_uniform
from dreamer_racing.modules.stored_latents import CONTEXT
from dreamer_racing.modules.world_model import WorldModel, join_features

OPEN_LOOP_STARTS = 64
"""N, records of a batch from which rewards and ends are predicted ahead: this project's choice, for its time."""


class Latents(NamedTuple):
    """What the world model has inferred of a batch ``[B, T]``, with its graph.

    Attributes:
        belief: ``(B, T, D)``.
        state: ``(B, T, S)``.
    """

    belief: Tensor
    state: Tensor

    @property
    def features(self) -> Tensor:
        """Both, ``(B, T, F)``."""
        return join_features(self.belief, self.state)


class WorldModelLoss(nn.Module):
    """Reward and continuation losses, the dynamics and representation losses, and those of targets.

    Targets are what shapes the latents beside rewards; parameters that one owns are trained, saved and restored with
    those of the networks.

    Args:
        agent: Whose world model is trained.
        config: Which targets (``world_model``), and numbers: ``dynamics_scale`` of KL(sg(posterior) ‖ prior),
            ``representation_scale`` of KL(posterior ‖ sg(prior)), ``free_nats``.

    Attributes:
        in_keys: What is read of a batch.
        targets: By their classes' names.

    Raises:
        ValueError: If a target is not known, or lacks what it needs.

    Reference: DreamerV3, Eq. 4-5.
    """

    def __init__(self, agent: Agent, config: LossConfig) -> None:
        super().__init__()
        self.world_model = agent.world_model
        self.config = config
        kinds = find_targets(config.world_model)
        self.targets = nn.ModuleDict({kind.__name__: kind(agent, config) for kind in kinds})
        decoders = (agent.world_model.decoder, agent.world_model.vector_decoder)
        if any(kind.decodes for kind in kinds) and not any(decoders):
            raise ValueError(f"loss {config.world_model!r} needs a world model with decoders: Agent(..., decode=True).")
        of_targets = [key for kind in kinds for key in kind.reads]
        self.in_keys: list[NestedKey] = [
            *agent.world_model.encoder.keys, "previous_action", "reward", "is_init", "terminated", *of_targets,
        ]  # fmt: skip

    def forward(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], Latents]:
        """Compute the losses of a batch, and infer its latents.

        Args:
            batch: Records ``[B, T]``: what the encoder and the targets see, ``previous_action``, ``reward``,
                ``is_init``, ``terminated``, and ``context``, from whose first record windows go on where it is there.

        Returns:
            Scalars: ``loss_reward``, ``loss_continue``, ``loss_dynamics``, ``loss_representation``, ``reward_error``,
            ``kl`` (nats) and what the targets write; and the latents.

        Raises:
            KeyError: If the batch lacks a key.
        """
        require_keys(batch, self.in_keys)
        model, rssm, stored = self.world_model, self.world_model.rssm, batch.get(CONTEXT, None)

        # Infer the latents of the records, from where windows begin.
        embedding = model.encoder(batch)
        initial = None if stored is None else rssm.latent_format.unpack(stored[:, 0])
        is_init = batch.get("is_init").squeeze(-1)
        posterior = rssm.observe(embedding, batch.get("previous_action"), is_init, initial=initial)
        features = join_features(posterior.belief, posterior.state)

        # Targets: what the latents must tell beside rewards.
        losses: dict[str, Tensor] = {}
        for target in self.targets.values():
            losses |= target(posterior, features, embedding, batch)

        # Rewards received on arriving at each record, and whether the episode goes on there.
        reward, goes_on, head = batch.get("reward"), 1.0 - batch.get("terminated").float(), model.reward_head
        logits = head(features)
        with torch.no_grad():
            reward_error = (head.two_hot.decode(logits) - reward).abs().mean()
        losses["loss_reward"] = head.two_hot.cross_entropy(logits.log_softmax(-1), reward).mean()
        losses["loss_continue"] = F.binary_cross_entropy_with_logits(model.continue_head(features), goes_on)
        losses["reward_error"] = reward_error

        # Dynamics: predict the latents before the observation is seen, and let observations tell what is predictable.
        dynamics, representation, kl = kl_losses(
            posterior.posterior_logits, posterior.prior_logits, self.config.free_nats, rssm.unimix
        )
        losses["loss_dynamics"] = self.config.dynamics_scale * dynamics.mean()
        losses["loss_representation"] = self.config.representation_scale * representation.mean()
        losses["kl"] = kl.mean()
        return losses, Latents(posterior.belief, posterior.state)


def open_loop_loss(model: WorldModel, latents: Latents, batch: TensorDictBase, steps: int) -> Tensor:
    """Compute the loss of rewards and ends predicted steps ahead, from replayed actions alone.

    Imagination reads the heads at latents that no observation has corrected. Heads that are trained at corrected ones
    alone do not know how unsure the others are, and underrate crashes (docs/learning.md).

    Args:
        model: Whose dynamics and heads learn, and that made the latents.
        latents: Inferred of the batch, with their graph.
        batch: Records ``[B, T]``: ``previous_action``, ``reward``, ``terminated``, ``is_init``.
        steps: K, at least 1 and less than T.

    Returns:
        A scalar: the mean of both heads' losses over the steps within an episode, from `OPEN_LOOP_STARTS` records.

    Raises:
        ValueError: If the windows are too short.

    Reference: Hafner et al. 2019, "Learning latent dynamics for planning from pixels", latent overshooting, of heads.
    """
    starts = batch.shape[1] - steps  # of a window
    if starts < 1:
        raise ValueError(
            f"open_loop_steps={steps} must be less than the {batch.shape[1]} records of a window (batch_length)."
        )
    device = latents.belief.device
    chosen = torch.rand(len(batch) * starts, device=device).topk(min(OPEN_LOOP_STARTS, len(batch) * starts)).indices
    window, first = chosen // starts, chosen % starts  # (N,)
    following = (window.unsqueeze(1), first.unsqueeze(1) + torch.arange(1, steps + 1, device=device))  # (N, K)
    action, reward, terminated, is_init = (
        batch[key][following] for key in ("previous_action", "reward", "terminated", "is_init")
    )
    within = (~is_init).float().cumprod(1)  # (N, K, 1): 0 from the next episode's first record on

    features = join_features(*model.predict(latents.belief[window, first], latents.state[window, first], action))
    head = model.reward_head
    rewards = head.two_hot.cross_entropy(head(features).log_softmax(-1), reward).view_as(within)
    ends = F.binary_cross_entropy_with_logits(model.continue_head(features), 1.0 - terminated.float(), reduction="none")
    return (within * (rewards + ends)).sum() / within.sum().clamp_min(1.0)


def kl_losses(
    posterior_logits: Tensor, prior_logits: Tensor, free_nats: float, unimix: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the two KL losses between posterior and prior; free nats apply to the sum over latents.

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
    dynamics = (posterior.detach() * (log_posterior.detach() - log_prior)).sum(-1)
    representation = (posterior * (log_posterior - log_prior.detach())).sum(-1)
    return (
        dynamics.sum(-1).clamp_min(free_nats),
        representation.sum(-1).clamp_min(free_nats),
        dynamics.detach().sum(-1),
    )


def require_keys(batch: TensorDictBase, keys: list[NestedKey]) -> None:
    """Refuse a batch that lacks something.

    Raises:
        KeyError: If a key is missing; the message names it, and what there is.
    """
    missing = [key for key in keys if batch.get(key, None) is None]
    if missing:
        found = sorted(map(str, batch.keys()))
        raise KeyError(f"The losses need {missing}, which the batch lacks. It has: {', '.join(found)}.")
