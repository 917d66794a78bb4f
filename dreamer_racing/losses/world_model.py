"""World-model loss: reward, continuation, dynamics, representation and targets.

Targets shape the latents besides rewards: images, vectors, the simulator's state, or the encoder's embedding.

Shape legend: B batch, T time, L latents, K classes, D belief, S state, F = D + S features, E embedding, P width of the
privileged vector, M = B·T records.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
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
"""N, records of a batch from which `open_loop_loss` predicts; this project's choice, which limits its time."""


class Latents(NamedTuple):
    """Latents that the world model inferred for a batch ``[B, T]``, with gradient.

    Attributes:
        belief: ``(B, T, D)``.
        state: ``(B, T, S)``.
    """

    belief: Tensor
    state: Tensor

    @property
    def features(self) -> Tensor:
        """Belief and state side by side, ``(B, T, F)``."""
        return join_features(self.belief, self.state)


class WorldModelLoss(nn.Module):
    """Losses of reward, continuation, dynamics, representation and targets.

    Parameters of targets are trained, saved and restored with those of the networks.

    Args:
        agent: Agent whose world model is trained.
        config: Names of the targets (``world_model``), and weights: ``dynamics_scale`` of KL(sg(posterior) ‖ prior),
            ``representation_scale`` of KL(posterior ‖ sg(prior)), ``free_nats``.

    Attributes:
        in_keys: Keys of a batch that are read.
        targets: Targets by the names of their classes.

    Raises:
        ValueError: If a target is unknown, lacks something that it needs, or has the class name of another one.

    Reference: DreamerV3, Eq. 4-5.
    """

    def __init__(self, agent: Agent, config: LossConfig) -> None:
        super().__init__()
        self.world_model = agent.world_model
        self.config = config
        kinds = find_targets(config.world_model)
        self.targets = nn.ModuleDict({kind.__name__: kind(agent, config) for kind in kinds})
        if len(self.targets) < len(kinds):
            raise ValueError(f"loss.world_model={config.world_model}: two targets have one class name; rename yours.")
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
            batch: Records ``[B, T]``: inputs of the encoder and the targets, ``previous_action``, ``reward``,
                ``is_init``, ``terminated``, and optionally ``context``, the stored latents from which windows start.

        Returns:
            Scalars: ``loss_reward``, ``loss_continue``, ``loss_dynamics``, ``loss_representation``, ``reward_error``,
            ``kl`` (nats) and those of the targets; and the latents.

        Raises:
            KeyError: If the batch lacks a key.
            ValueError: If a target returns a name that is taken.
        """
        if missing := [key for key in self.in_keys if batch.get(key, None) is None]:
            found = ", ".join(sorted(map(str, batch.keys())))
            raise KeyError(f"The losses need {missing}, which the batch lacks. It has: {found}.")
        model, rssm, stored = self.world_model, self.world_model.rssm, batch.get(CONTEXT, None)

        # Infer the latents of the records, starting from those stored with each window's first record, if any.
        embedding = model.encoder(batch)
        initial = None if stored is None else rssm.latent_format.unpack(stored[:, 0])
        is_init = batch.get("is_init").squeeze(-1)
        posterior = rssm.observe(embedding, batch.get("previous_action"), is_init, initial=initial)
        features = join_features(posterior.belief, posterior.state)

        # Targets: what the latents must encode besides rewards.
        of_targets = [target(posterior, features, embedding, batch) for target in self.targets.values()]

        # Rewards received on arriving at each record, and whether the episode continues there.
        reward, goes_on, head = batch.get("reward"), 1.0 - batch.get("terminated").float(), model.reward_head
        logits = head(features)
        with torch.no_grad():
            reward_error = (head.two_hot.decode(logits) - reward).abs().mean()
        losses: dict[str, Tensor] = {}
        losses["loss_reward"] = head.two_hot.cross_entropy(logits.log_softmax(-1), reward).mean()
        losses["loss_continue"] = F.binary_cross_entropy_with_logits(model.continue_head(features), goes_on)
        losses["reward_error"] = reward_error

        # Dynamics: train the prior to predict the posterior; representation: keep the posterior predictable.
        dynamics, representation, kl = kl_losses(
            posterior.posterior_logits, posterior.prior_logits, self.config.free_nats, rssm.unimix
        )
        losses["loss_dynamics"] = self.config.dynamics_scale * dynamics.mean()
        losses["loss_representation"] = self.config.representation_scale * representation.mean()
        losses["kl"] = kl.mean()
        return joined(*of_targets, losses), Latents(posterior.belief, posterior.state)


def joined(*parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Join losses and metrics by name, also those of one's own.

    Raises:
        ValueError: If a name stands in two of the parts.
    """
    names = Counter(name for part in parts for name in part)
    if twice := [name for name, number in names.items() if number > 1]:
        raise ValueError(f"Two losses or metrics are called {' and '.join(twice)}: rename yours.")
    return {name: value for part in parts for name, value in part.items()}


def open_loop_loss(model: WorldModel, latents: Latents, batch: TensorDictBase, steps: int) -> Tensor:
    """Compute the loss of rewards and episode ends that are predicted over K steps from replayed actions alone.

    Imagination evaluates the heads at predicted latents. Heads that are only trained at latents inferred from
    observations do not account for the uncertainty of predicted ones, and underestimate crashes (docs/learning.md).

    Args:
        model: World model that inferred the latents; its dynamics and heads learn.
        latents: Latents of the batch, with gradient.
        batch: Records ``[B, T]``: ``previous_action``, ``reward``, ``terminated``, ``is_init``.
        steps: K, at least 1 and less than T.

    Returns:
        A scalar: the mean of both heads' losses over the steps within an episode, from `OPEN_LOOP_STARTS` records.

    Raises:
        ValueError: If the windows are too short.

    Reference: Hafner et al. 2019, "Learning latent dynamics for planning from pixels", latent overshooting; here for
    the heads.
    """
    starts = batch.shape[1] - steps  # in each window
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
    """Compute the two KL losses between posterior and prior; free nats apply to the KL summed over latents.

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


class Target(nn.Module):
    """Loss on something that the latents must encode; base class of targets.

    Modules that a target makes are trained, saved and restored with the networks.

    Args:
        agent: The networks; a target may use any of the world model's.
        config: Settings of the losses.

    Attributes:
        world_model: World model of the agent.
        config: As given.
        decodes: Whether the world model must have decoders of the observations.
        reads: Keys of the batch that it needs, besides those of the encoder.
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
            embedding: Encoded observations, ``(B, T, E)``.
            batch: The records ``[B, T]``.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement forward().")


class Image(Target):
    """Target of DreamerV3: reconstructs the images that the agent sees, if any.

    Writes ``loss_image`` (squared error summed over an image's pixels, values in [0, 1], times ``image_scale``) and
    ``image_error`` (mean squared error per pixel). With ``image_share`` below 1 and gradients enabled, only that share
    of each window's records is decoded, at least one: the same random positions in all windows, new ones in each call.
    """

    decodes = True

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the loss of the images."""
        if self.world_model.decoder is None:
            return {}
        belief, state, pixels = self._share_of_records(posterior.belief, posterior.state, batch.get(PIXELS))
        error = self.world_model.decoder.squared_error(belief, state, pixels)
        # Mean over the batch of the sum over an image.
        image = self.config.image_scale * error * pixels.shape[-3:].numel()
        return {"loss_image": image, "image_error": error.detach()}

    def _share_of_records(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Return ``image_share`` of the T records of each tensor ``(B, T, ...)``; all of them without gradients."""
        share = self.config.image_share
        if share == 1 or not torch.is_grad_enabled():
            return values
        time = values[0].shape[1]
        places = torch.rand(time, device=values[0].device).argsort()[: max(1, round(share * time))]
        return tuple(value.index_select(1, places) for value in values)


class Vector(Target):
    """Target that reconstructs the vector that the agent sees, if any: ``loss_vector``, summed squared symlog error."""

    decodes = True

    def forward(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, batch: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the loss of the vector."""
        if self.world_model.vector_decoder is None:
            return {}
        numbers = batch.get(self.world_model.interface.vector_key)
        return {"loss_vector": self.world_model.vector_decoder.squared_error(features, numbers)}


class State(Target):
    """Target that decodes the simulator's state, which neither policy nor world model sees.

    Writes ``loss_privileged`` (squared error of symlogs, summed over P, times ``privileged_scale``) and
    ``privileged_error`` (mean over P, unscaled). Without images an update takes about a third less time.

    Attributes:
        decoder: Decoder of the state; not part of the world model.

    Raises:
        ValueError: If the environment gives no privileged vector.

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
        """Return the loss of the state."""
        target = batch.get(PRIVILEGED)
        error = self.decoder.squared_error(features, target)
        return {
            "loss_privileged": self.config.privileged_scale * error,
            "privileged_error": error.detach() / target.shape[-1],
        }


class Barlow(Target):
    """Target that correlates the latents with the encoder's embedding by Barlow Twins, without a decoder.

    A linear projection of belief and state is correlated with the embedding of the same record, and redundancy between
    dimensions is penalised. The embedding is detached: the encoder learns through the posterior. Writes
    ``loss_barlow``, times ``barlow_scale``, and ``agreement``, the mean correlation of matching dimensions, at most 1.

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
    """Compute the Barlow-Twins objective of two ``(M, E)``: correlation one on the diagonal, zero off it.

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
"""Targets by the names that ``LossConfig.world_model`` may have."""


def find_targets(names: str) -> tuple[type[Target], ...]:
    """Return targets by names such as ``reconstruction``, ``my_targets:Mine`` or ``privileged+my_targets:Mine``.

    Raises:
        ValueError: If a name is unknown; the message lists the known ones, or says where the module was searched.
    """
    found: list[type[Target]] = []
    for name in names.split("+"):
        if ":" in name:
            own = import_own(name, f"Target {name!r}")
            if not (isinstance(own, type) and issubclass(own, Target)):
                raise ValueError(f"Target {name!r} is not a subclass of dreamer_racing.losses.Target.")
            found.append(own)
        elif name in TARGETS:
            found += TARGETS[name]
        else:
            raise ValueError(
                f"Unknown loss {name!r}{suggestion(name, TARGETS)}. Known losses: {', '.join(TARGETS)}. Give your own "
                "target as module:Class; join several with +."
            )
    return tuple(dict.fromkeys(found))
