"""PPO on flown rollouts with a critic that sees the simulator's state: an extension, not part of DreamerV3.

Whoever flies sees images; whoever is only there in training may see more. A critic of the state does not take what the
world model has not seen yet for the actor's fault, and it needs no imagination, whose time the world model gets
(docs/experiments.md, entry 20).

Shape legend: N environments, S steps kept of each environment, P privileged numbers.
"""

from __future__ import annotations

from typing import Any, Self

from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.config import HORIZON, LossConfig
from dreamer_racing.losses.flown_ppo_actor import FlownPPOActorLoss
from dreamer_racing.losses.own_critic_actor import OwnCriticActorLoss
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.heads import TwoHotHead, symlog
from dreamer_racing.modules.interface import PRIVILEGED


class AsymmetricPPOActorLoss(OwnCriticActorLoss):
    """Keep what the collector's policy flew, and weigh it by a critic of the simulator's state.

    Args:
        privileged_dim: P.
        args, kwargs: Of ``OwnCriticActorLoss``.

    Raises:
        ValueError: If ``privileged_dim`` is 0.

    Reference: Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning".
    """

    reads_privileged = True
    kept = (*FlownPPOActorLoss.kept, "privileged")
    watched_keys = (*FlownPPOActorLoss.watched_keys, PRIVILEGED)
    privileged: Tensor

    def __init__(self, *args: Any, privileged_dim: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if privileged_dim < 1:
            raise ValueError(
                f"{type(self).__name__} needs privileged numbers for its critic, but the environment gives none under "
                f"{PRIVILEGED}: use an environment with privileged=True, or another loss."
            )
        self.state_critic = self._make_critic(privileged_dim)

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, horizon: int = HORIZON, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return super().from_config(agent, config, horizon, privileged_dim=agent.interface.privileged_dim, **own)

    @property
    def own_critic(self) -> TwoHotHead:
        """The critic of the simulator's state."""
        return self.state_critic

    def _steps(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        return {**super()._steps(rollout), "privileged": symlog(rollout[PRIVILEGED])}

    def _kept_inputs(self) -> Tensor:
        return self.privileged

    def _inputs_of(self, acted: TensorDictBase) -> Tensor:
        return symlog(acted[PRIVILEGED])
