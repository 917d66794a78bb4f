"""World model: encoder, RSSM, decoder, reward and continue heads.

Shape legend: B batch, T time, A action, D belief, S state, F = D + S features.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dreamer_racing.modules.decoder import ImageDecoder
from dreamer_racing.modules.encoder import ImageEncoder
from dreamer_racing.modules.heads import ContinueHead, TwoHotHead
from dreamer_racing.modules.rssm import RSSM, Posterior
from dreamer_racing.modules.sizes import ModelSize, get_size


def join_features(belief: Tensor, state: Tensor) -> Tensor:
    """Concatenate belief ``(..., D)`` and state ``(..., S)`` into what every head reads, ``(..., F)``."""
    return torch.cat((belief, state), -1)


class WorldModel(nn.Module):
    """Everything that predicts: images, rewards, ends of episodes and the next state.

    Args:
        size: A ``ModelSize`` or its name.
        action_dim: A.

    Example:
        >>> import torch
        >>> world_model = WorldModel("debug", action_dim=4)
        >>> pixels = torch.zeros(2, 3, 64, 64, 3, dtype=torch.uint8)
        >>> posterior = world_model.observe(pixels, torch.zeros(2, 3, 4), torch.zeros(2, 3, dtype=torch.bool))
        >>> world_model.decoder(posterior.belief, posterior.state).shape
        torch.Size([2, 3, 64, 64, 3])
    """

    def __init__(self, size: ModelSize | str, action_dim: int = 4) -> None:
        super().__init__()
        size = get_size(size)
        self.size = size
        self.encoder = ImageEncoder(
            size.cnn_depth, size.cnn_multipliers, size.cnn_kernel, size.strided, size.norm, size.cnn_patch
        )
        self.rssm = RSSM(
            self.encoder.embedding_size,
            action_dim,
            size.belief,
            size.latents,
            size.classes,
            size.hidden,
            recurrence=size.recurrence,
            blocks=size.blocks,
            prior_layers=size.prior_layers,
            norm=size.norm,
            learned_initial=size.learned_initial,
        )
        self.decoder = ImageDecoder(
            size.belief,
            size.state,
            size.units,
            size.cnn_depth,
            size.cnn_multipliers,
            size.cnn_kernel,
            size.strided,
            size.blocks,
            size.norm,
            size.cnn_patch,
        )
        self.reward_head = TwoHotHead(size.features, size.head_layers, size.units, size.norm, size.bins)
        self.continue_head = ContinueHead(size.features, size.head_layers, size.units, size.norm)

    def observe(
        self, pixels: Tensor, previous_action: Tensor, is_init: Tensor, deterministic: bool = False
    ) -> Posterior:
        """Encode and unroll a sequence of records.

        Args:
            pixels: uint8 ``(B, T, 64, 64, 3)``.
            previous_action: ``(B, T, A)``.
            is_init: bool ``(B, T)``.
            deterministic: Take the posterior's mode instead of a sample.

        Returns:
            Belief, state and logits of every record.
        """
        return self.rssm.observe(self.encoder(pixels), previous_action, is_init, deterministic=deterministic)

    @torch.no_grad()
    def open_loop(self, pixels: Tensor, previous_action: Tensor, is_init: Tensor, context: int) -> Tensor:
        """Reconstruct the first records, then predict the others from their actions alone.

        Beyond the context nothing is observed: a reset there is not followed.

        Args:
            pixels: uint8 ``(B, T, 64, 64, 3)``; only the first ``context`` records are read.
            previous_action: ``(B, T, A)``.
            is_init: bool ``(B, T)``.
            context: Number of records that are observed, at least 1.

        Returns:
            Images uint8 ``(B, T, 64, 64, 3)``.

        Raises:
            ValueError: If ``context`` is not between 1 and T.
        """
        time = previous_action.shape[1]
        if not 1 <= context <= time:
            raise ValueError(
                f"open_loop: context must lie between 1 and the {time} records of the batch, got {context}"
            )
        seen = slice(0, context)
        posterior = self.observe(pixels[:, seen], previous_action[:, seen], is_init[:, seen])
        beliefs, states = list(posterior.belief.unbind(1)), list(posterior.state.unbind(1))
        for action in previous_action[:, context:].unbind(1):
            belief, state = self.rssm.imagine_step(beliefs[-1], states[-1], action)
            beliefs.append(belief)
            states.append(state)
        images = self.decoder(torch.stack(beliefs, 1), torch.stack(states, 1))
        return images.mul(255.0).round().to(torch.uint8)
