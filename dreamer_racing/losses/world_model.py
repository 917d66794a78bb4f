"""World-model loss: reward, continuation, dynamics and representation, and targets.

Targets are what shapes the latents beside rewards: images, numbers, the simulator's state, or the encoder itself.

Shape legend: B batch, T time, L latents, K classes, D belief, S state, F = D + S features, E embedding, P privileged
numbers, M = B·T records.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.autoencoder import VectorDecoder
from dreamer_racing.modules.interface import PIXELS, PRIVILEGED
from dreamer_racing.modules.layers import autocast, linear
from dreamer_racing.modules.rssm import CONTEXT, Posterior, join_features, mix_uniform
from dreamer_racing.modules.world_model import WorldModel
from dreamer_racing.settings import import_own, suggestion

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


class Target(nn.Module):
    """Something that the latents must tell, and its loss.

    Modules that a target makes are trained, saved and restored with the networks.

    Args:
        agent: The networks; a target may use any of the world model's.
        config: Numbers of the losses.

    Attributes:
        world_model: Of the agent.
        config: As given.
        decodes: Whether the world model must have decoders of what is seen.
        reads: Keys of the batch that it needs, beside what the encoder sees.
    """

    decodes: ClassVar[bool] = False
    reads: ClassVar[tuple[NestedKey, ...]] = ()

    def __init__(self, agent: Agent, config: LossConfig) -> None:
        super().__init__()
        self.world_model = agent.world_model
        self.config = config

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return losses (``loss_*``, which are minimised) and metrics, scalars.

        Args:
            posterior: Latents of the batch, and their distributions.
            features: Belief and state side by side, ``(B, T, F)``.
            embedding: What the encoder made of the observations, ``(B, T, E)``.
            batch: The records ``[B, T]``.
        """
        raise NotImplementedError(f"{type(self).__name__} must say what it minimises.")


class Image(Target):
    """Reconstruct the images that the agent sees, if it does: DreamerV3.

    Writes ``loss_image`` (squared error summed over an image's pixels, values in [0, 1], by ``image_scale``) and
    ``image_error`` (mean squared error of a pixel). With ``image_share`` below 1 so many of a window's records, at
    least one, are decoded where gradients are wanted: those of the same random places in all windows, drawn anew in
    every call.
    """

    decodes = True

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the images' loss."""
        if self.world_model.decoder is None:
            return {}
        belief, state, pixels = self._share_of_records(posterior.belief, posterior.state, batch.get(PIXELS))
        error = self.world_model.decoder.squared_error(belief, state, pixels)
        # Mean over the batch of the sum over an image.
        image = self.config.image_scale * error * pixels.shape[-3:].numel()
        return {"loss_image": image, "image_error": error.detach()}

    def _share_of_records(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Return each ``(B, T, ...)`` at ``image_share`` of its T records; whole, where it is only measured."""
        share = self.config.image_share
        if share == 1 or not torch.is_grad_enabled():
            return values
        time = values[0].shape[1]
        places = torch.rand(time, device=values[0].device).argsort()[: max(1, round(share * time))]
        return tuple(value.index_select(1, places) for value in values)


class Vector(Target):
    """Reconstruct the numbers that the agent sees, if it does: ``loss_vector``, squared error of symlogs, summed."""

    decodes = True

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the numbers' loss."""
        if self.world_model.vector_decoder is None:
            return {}
        numbers = batch.get(self.world_model.interface.vector_key)
        return {"loss_vector": self.world_model.vector_decoder.squared_error(features, numbers)}


class State(Target):
    """Decode the simulator's state, which neither policy nor world model sees.

    Writes ``loss_privileged`` (squared error of symlogs, summed over P, by ``privileged_scale``) and
    ``privileged_error`` (the same, unscaled mean over P). Without images an update takes about a third less time.

    Attributes:
        decoder: Of the state; no part of the world model.

    Raises:
        ValueError: If the environment gives no privileged numbers.

    Reference: Lambrechts et al. 2023, "Informed POMDP"; SkyDreamer decodes the state in place of images.
    """

    reads = (PRIVILEGED,)

    def __init__(self, agent: Agent, config: LossConfig) -> None:
        super().__init__(agent, config)
        size, privileged_dim = self.world_model.size, agent.interface.privileged_dim
        if privileged_dim < 1:
            raise ValueError(
                f"The target {type(self).__name__} needs privileged numbers to decode, but the environment gives none "
                f"under {PRIVILEGED}: use an environment with privileged=True, or another loss."
            )
        self.decoder = VectorDecoder(size.features, privileged_dim, size.vector_layers, size.units, size.norm)

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the state's loss."""
        target = batch.get(PRIVILEGED)
        error = self.decoder.squared_error(features, target)
        return {
            "loss_privileged": self.config.privileged_scale * error,
            "privileged_error": error.detach() / target.shape[-1],
        }


class Barlow(Target):
    """Make the latents agree with the encoder's embedding, without redundancy between dimensions, and decode nothing.

    A linear projection of belief and state is correlated with the embedding of the same record. The embedding is a
    fixed target: the encoder learns through the posterior. Writes ``loss_barlow``, by ``barlow_scale``, and
    ``agreement``, the mean correlation of matching dimensions, 1 at best.

    Reference: R2-Dreamer (decoder-free, redundancy reduction between projected latents and image embeddings);
    Zbontar et al. 2021, "Barlow Twins".
    """

    off_diagonal_scale = 5e-4
    """Weight of the correlations off the diagonal."""

    def __init__(self, agent: Agent, config: LossConfig) -> None:
        super().__init__(agent, config)
        world_model = self.world_model
        self.projector = linear(world_model.size.features, world_model.encoder.embedding_size, bias=False)

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the redundancy-reduction loss."""
        projected = self.projector(features).flatten(0, 1).float()
        target = embedding.detach().flatten(0, 1).float()
        with autocast(features.device, enabled=False):
            loss, agreement = redundancy_reduction(projected, target, self.off_diagonal_scale)
        return {"loss_barlow": self.config.barlow_scale * loss, "agreement": agreement}


def redundancy_reduction(first: Tensor, second: Tensor, off_diagonal_scale: float) -> tuple[Tensor, Tensor]:
    """Compute the Barlow-Twins objective: correlation one on the diagonal, zero off it.

    Args:
        first: ``(M, E)``.
        second: ``(M, E)``.
        off_diagonal_scale: Weight of the squared correlations off the diagonal.

    Returns:
        The loss, a scalar, and the mean correlation on the diagonal, without gradient.

    Reference: Zbontar et al. 2021, Eq. 1.
    """
    first, second = ((x - x.mean(0)) / (x.std(0, unbiased=False) + 1e-5) for x in (first, second))
    correlation = first.T @ second / len(first)  # (E, E)
    diagonal = correlation.diagonal()
    on_diagonal = (1 - diagonal).square().sum()
    off_diagonal = correlation.square().sum() - diagonal.square().sum()
    return on_diagonal + off_diagonal_scale * off_diagonal, diagonal.detach().mean()


TARGETS: dict[str, tuple[type[Target], ...]] = {
    "reconstruction": (Image, Vector),
    "informed": (Image, Vector, State),
    "privileged": (State,),
    "decoder_free": (Barlow,),
    "reward_only": (),
}
"""What shapes the latents beside rewards, by the names that ``LossConfig.world_model`` may have."""


def find_targets(names: str) -> tuple[type[Target], ...]:
    """Return the targets of a row of `TARGETS`, and of ``module:Class`` of your own; several are joined by ``+``.

    Args:
        names: For example ``reconstruction``, ``my_targets:Mine`` or ``privileged+my_targets:Mine``.

    Raises:
        ValueError: If there is none of a name; the message lists those that there are, or says where a module was
            looked for.
    """
    found: list[type[Target]] = []
    for name in names.split("+"):
        if ":" in name:
            own = import_own(name, f"Target {name!r}")
            if not (isinstance(own, type) and issubclass(own, Target)):
                raise ValueError(f"Target {name!r} is no subclass of dreamer_racing.losses.Target.")
            found.append(own)
        elif name in TARGETS:
            found += TARGETS[name]
        else:
            raise ValueError(
                f"Unknown loss {name!r}{suggestion(name, TARGETS)}. Known here: {', '.join(TARGETS)}; a target of your "
                "own is given as module:Class, and several are joined by +."
            )
    return tuple(dict.fromkeys(found))
