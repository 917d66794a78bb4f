"""PPO on flown rollouts with a critic of the latents: an extension, not part of DreamerV3.

For training without the simulator's state: ``AsymmetricPPOActorLoss`` needs it, and what ``FlownPPOActorLoss`` learns
its values by, imagination, takes a quarter of an update's time (docs/experiments.md, entry 42).

Shape legend: N environments, S steps kept of each environment, F features.
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.own_critic_actor import OwnCriticActorLoss
from dreamer_racing.modules.heads import TwoHotHead
from dreamer_racing.modules.world_model import join_features


class LatentPPOActorLoss(OwnCriticActorLoss):
    """Keep what the collector's policy flew, and weigh it by a critic that sees what the actor sees.

    The agent's own critic learns from what is replayed and teaches the world model by it; this one learns from what is
    flown and teaches the actor.

    Args:
        args, kwargs: Of ``OwnCriticActorLoss``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.latent_critic = self._make_critic(self.world_model.size.features)

    @property
    def own_critic(self) -> TwoHotHead:
        """The critic of the latents."""
        return self.latent_critic

    def _kept_inputs(self) -> Tensor:
        return self.features

    def _inputs_of(self, acted: TensorDictBase) -> Tensor:
        return join_features(acted["next", "belief"], acted["next", "state"])
