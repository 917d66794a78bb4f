"""What shapes the latents beside rewards: reconstruction, privileged state, or agreement with the encoder.

Shape legend: B batch, T time, E embedding, F features, P privileged numbers, M = B·T records.
"""

from __future__ import annotations

from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.config import LossConfig
from dreamer_racing.losses.world_model import WorldModelLoss
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.interface import PIXELS, PRIVILEGED
from dreamer_racing.modules.layers import autocast, linear
from dreamer_racing.modules.rssm import Posterior
from dreamer_racing.modules.world_model import WorldModel


class ReconstructionLoss(WorldModelLoss):
    """Reconstruct what the agent sees: DreamerV3.

    Adds, as scalars, ``loss_image`` (squared error summed over an image's pixels, values in [0, 1], scaled) and the
    metric ``image_error`` (mean squared error of a pixel) where the agent sees images; ``loss_vector`` (squared error
    of symlogs, summed) where it sees numbers. Everything else as ``WorldModelLoss``.

    Args:
        world_model: The module to train.
        image_scale: Weight of the images' squared error.
        image_share: Share of a window's records, at least one, whose images are decoded where gradients are wanted:
            those of the same random places in all windows, drawn anew in every call. With 1 nothing is drawn.
        kwargs: Of ``WorldModelLoss``.
    """

    decodes = True

    def __init__(
        self,
        world_model: WorldModel,
        *,
        image_scale: float = LossConfig.image_scale,
        image_share: float = LossConfig.image_share,
        **kwargs: Any,
    ) -> None:
        super().__init__(world_model, **kwargs)
        self.image_scale = image_scale
        self.image_share = image_share
        images = ["loss_image", "image_error"] if world_model.decoder is not None else []
        numbers = ["loss_vector"] if world_model.vector_decoder is not None else []
        self.out_keys = [*images, *numbers, *self.out_keys]
        if world_model.decoder is None and world_model.vector_decoder is None:
            raise ValueError(f"{type(self).__name__} needs a world model with decoders: WorldModel(..., decode=True).")

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        images = {"image_scale": config.image_scale, "image_share": config.image_share}
        return super().from_config(agent, config, **images, **own)

    def represent(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the reconstruction losses."""
        losses: dict[str, Tensor] = {}
        if self.world_model.decoder is not None:
            belief, state, pixels = self._share_of_records(posterior.belief, posterior.state, tensordict.get(PIXELS))
            error = self.world_model.decoder.squared_error(belief, state, pixels)
            # Mean over the batch of the sum over an image.
            image = self.image_scale * error * pixels.shape[-3:].numel()
            losses |= {"loss_image": image, "image_error": error.detach()}
        if self.world_model.vector_decoder is not None:
            numbers = tensordict.get(self.world_model.interface.vector_key)
            losses["loss_vector"] = self.world_model.vector_decoder.squared_error(features, numbers)
        return losses

    def _share_of_records(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Return each ``(B, T, ...)`` at ``image_share`` of its T records; whole, where it is only measured."""
        if self.image_share == 1 or not torch.is_grad_enabled():
            return values
        time = values[0].shape[1]
        places = torch.rand(time, device=values[0].device).argsort()[: max(1, round(self.image_share * time))]
        return tuple(value.index_select(1, places) for value in values)


class PrivilegedLoss(WorldModelLoss):
    """Decode the privileged state from the latents, and no images.

    The decoder is the loss's own: policy and world model never see the state. Images cost nothing here, so an update
    takes about a third less time than with ``ReconstructionLoss``.

    Args:
        world_model: The module to train.
        privileged_dim: P.
        privileged_scale: Weight of the squared error.
        kwargs: Of ``WorldModelLoss``.

    Reads ``("privileged", "vector")`` ``(B, T, P)`` too. Adds ``loss_privileged`` (squared error of symlogs, summed
    over P, scaled) and the metric ``privileged_error`` (the same, unscaled mean over P).

    Raises:
        ValueError: If ``privileged_dim`` is 0.

    Reference: Lambrechts et al. 2023, "Informed POMDP"; SkyDreamer decodes the state in place of images.
    """

    reads_privileged = True
    represent_keys: ClassVar[tuple[str, ...]] = ("loss_privileged", "privileged_error")

    def __init__(
        self,
        world_model: WorldModel,
        privileged_dim: int,
        *,
        privileged_scale: float = LossConfig.privileged_scale,
        **kwargs: Any,
    ) -> None:
        super().__init__(world_model, **kwargs)
        if privileged_dim < 1:
            raise ValueError(
                f"{type(self).__name__} needs privileged numbers to decode, but the environment gives none under "
                f"{PRIVILEGED}: use an environment with privileged=True, or another loss."
            )
        size = world_model.size
        self.privileged_decoder = VectorDecoder(
            size.features, privileged_dim, size.vector_layers, size.units, size.norm
        )
        self.privileged_scale = privileged_scale
        self.in_keys = [*self.in_keys, PRIVILEGED]

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        privileged = {"privileged_dim": agent.interface.privileged_dim, "privileged_scale": config.privileged_scale}
        return super().from_config(agent, config, **privileged, **own)

    def represent(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the privileged loss."""
        target = tensordict.get(PRIVILEGED)
        error = self.privileged_decoder.squared_error(features, target)
        return {
            "loss_privileged": self.privileged_scale * error,
            "privileged_error": error.detach() / target.shape[-1],
        }


class InformedLoss(PrivilegedLoss, ReconstructionLoss):
    """Decode the privileged state beside what the agent sees: both losses added up.

    Reference: as ``PrivilegedLoss``.
    """

    def represent(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the losses of both parents."""
        arguments = (posterior, features, embedding, tensordict)
        return ReconstructionLoss.represent(self, *arguments) | PrivilegedLoss.represent(self, *arguments)


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


class DecoderFreeLoss(WorldModelLoss):
    """Make the latents agree with the encoder's embedding, without redundancy between dimensions, and decode nothing.

    A linear projection of belief and state is correlated with the embedding of the same record. The embedding is a
    fixed target: the encoder learns through the posterior.

    Args:
        world_model: The module to train.
        barlow_scale: Weight of the loss.
        off_diagonal_scale: Weight of the correlations off the diagonal.
        kwargs: Of ``WorldModelLoss``.

    Adds ``loss_barlow`` and the metric ``agreement``, the mean correlation of matching dimensions, 1 at best.

    Reference: R2-Dreamer (decoder-free, redundancy reduction between projected latents and image embeddings);
    Zbontar et al. 2021, "Barlow Twins".
    """

    represent_keys: ClassVar[tuple[str, ...]] = ("loss_barlow", "agreement")

    def __init__(
        self,
        world_model: WorldModel,
        *,
        barlow_scale: float = LossConfig.barlow_scale,
        off_diagonal_scale: float = 5e-4,
        **kwargs: Any,
    ) -> None:
        super().__init__(world_model, **kwargs)
        self.projector = linear(world_model.size.features, world_model.encoder.embedding_size, bias=False)
        self.barlow_scale = barlow_scale
        self.off_diagonal_scale = off_diagonal_scale

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return super().from_config(agent, config, barlow_scale=config.barlow_scale, **own)

    def represent(
        self, posterior: Posterior, features: Tensor, embedding: Tensor, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        """Return the redundancy-reduction loss."""
        projected = self.projector(features).flatten(0, 1).float()
        target = embedding.detach().flatten(0, 1).float()
        with autocast(features.device, enabled=False):
            loss, agreement = redundancy_reduction(projected, target, self.off_diagonal_scale)
        return {"loss_barlow": self.barlow_scale * loss, "agreement": agreement}
