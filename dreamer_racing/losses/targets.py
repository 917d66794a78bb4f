"""What shapes the world model's latents beside rewards: images, numbers, the simulator's state, or the encoder itself.

Shape legend: B batch, T time, E embedding, F features, P privileged numbers, M = B·T records.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.interface import PIXELS, PRIVILEGED
from dreamer_racing.modules.layers import autocast, linear
from dreamer_racing.modules.rssm import Posterior
from dreamer_racing.settings import import_own, suggestion


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
