"""World model: encoder, RSSM, decoders, reward and continue heads.

Shape legend: B batch, T time, A action, V width of the observed vector, D belief, S state, F = D + S features.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from dreamer_racing.modules.autoencoder import ImageDecoder, ObservationEncoder, VectorDecoder
from dreamer_racing.modules.heads import ContinueHead, TwoHotHead
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.rssm import RSSM, Posterior
from dreamer_racing.modules.sizes import ModelSize, get_size


class WorldModel(nn.Module):
    """Networks that infer latents, and predict the next latents, observations, rewards and episode ends.

    Args:
        size: A ``ModelSize`` or its name.
        interface: Observations and actions of the agent.
        decode: Whether to make the decoders of observations, which some losses do not need.

    Attributes:
        decoder: ``ImageDecoder``, or None.
        vector_decoder: ``VectorDecoder`` of the observed vector, or None.

    Raises:
        ValueError: If the size has an unknown ``recurrence``.

    Example:
        >>> import torch
        >>> world_model = WorldModel("debug")
        >>> seen = {"pixels": torch.zeros(2, 3, 64, 64, 3, dtype=torch.uint8)}
        >>> posterior = world_model.observe(seen, torch.zeros(2, 3, 4), torch.zeros(2, 3, dtype=torch.bool))
        >>> world_model.decoder(posterior.belief, posterior.state).shape
        torch.Size([2, 3, 64, 64, 3])
    """

    def __init__(self, size: ModelSize | str, interface: Interface | None = None, decode: bool = True) -> None:
        super().__init__()
        size, interface = get_size(size), interface or Interface()
        self.size, self.interface = size, interface
        self.encoder = ObservationEncoder(size, interface)
        self.rssm = RSSM(size, self.encoder.embedding_size, interface.action_dim)
        self.decoder = ImageDecoder(size, interface.image_size) if decode and interface.pixels else None
        self.vector_decoder = (
            VectorDecoder(size.features, interface.vector_dim, size.vector_layers, size.units, size.norm)
            if decode and interface.vector_dim
            else None
        )
        self.reward_head = TwoHotHead(size.features, size.head_layers, size.units, size.norm, size.bins)
        self.continue_head = ContinueHead(size.features, size.head_layers, size.units, size.norm)

    def observe(
        self,
        observation: Mapping[str, Tensor],
        previous_action: Tensor,
        is_init: Tensor,
        deterministic: bool = False,
    ) -> Posterior:
        """Encode a sequence of records, and infer their latents; see `RSSM.observe`.

        Args:
            observation: Observations by key: ``pixels`` uint8 ``(B, T, height, width, 3)``, ``vector`` ``(B, T, V)``.
            previous_action: ``(B, T, A)``.
            is_init: bool ``(B, T)``.
            deterministic: Take the posterior's mode instead of a sample.
        """
        return self.rssm.observe(self.encoder(observation), previous_action, is_init, deterministic=deterministic)

    @torch.no_grad()
    def open_loop(
        self, observation: Mapping[str, Tensor], previous_action: Tensor, is_init: Tensor, num_observed: int
    ) -> tuple[Tensor, Tensor]:
        """Observe the first ``num_observed`` records, then predict the others from their actions alone.

        Resets beyond the observed records are ignored. Arguments as for ``observe``.

        Returns:
            Beliefs ``(B, T, D)`` and states ``(B, T, S)``.

        Raises:
            ValueError: If ``num_observed`` is not between 1 and T.
        """
        time = previous_action.shape[1]
        if not 1 <= num_observed <= time:
            raise ValueError(
                f"open_loop: num_observed must lie between 1 and the {time} records of the batch, got {num_observed}"
            )
        seen = slice(0, num_observed)
        posterior = self.observe(
            {key: observation[key][:, seen] for key in self.encoder.keys}, previous_action[:, seen], is_init[:, seen]
        )
        predicted = self.predict(posterior.belief[:, -1], posterior.state[:, -1], previous_action[:, num_observed:])
        return torch.cat((posterior.belief, predicted[0]), 1), torch.cat((posterior.state, predicted[1]), 1)

    def predict(self, belief: Tensor, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Predict latents from actions alone.

        Args:
            belief: ``(B, D)``, before the first action.
            state: ``(B, S)``, before the first action.
            actions: ``(B, H, A)``.

        Returns:
            Beliefs ``(B, H, D)`` and states ``(B, H, S)`` after each action.
        """
        beliefs, states = [belief], [state]
        for action in actions.unbind(1):
            belief, state = self.rssm.imagine_step(belief, state, action)
            beliefs.append(belief)
            states.append(state)
        return torch.stack(beliefs, 1)[:, 1:], torch.stack(states, 1)[:, 1:]

    def images(self, belief: Tensor, state: Tensor) -> Tensor:
        """Decode images uint8 ``(B, T, height, width, 3)`` from beliefs ``(B, T, D)`` and states ``(B, T, S)``.

        Raises:
            ValueError: If there is no image decoder.
        """
        if self.decoder is None:
            raise ValueError("images: this world model has no image decoder, so its predictions cannot be seen.")
        return self.decoder(belief, state).mul(255.0).round().to(torch.uint8)
