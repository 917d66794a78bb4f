"""The agent: the three networks that are trained together."""

from __future__ import annotations

from torch import nn

from dreamer_racing.modules.actor import MAX_STD, MIN_STD, Actor
from dreamer_racing.modules.critic import Critic
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.sizes import ModelSize
from dreamer_racing.modules.world_model import WorldModel


class Agent(nn.Module):
    """The three networks that are trained together.

    Args:
        size: Their widths.
        interface: What the agent sees and does.
        decode: Whether the world model has decoders of what is seen.
        min_std: Smallest standard deviation of actions.
        max_std: Largest.

    Attributes:
        size: As given.
        interface: As given.
        world_model: Predicts.
        actor: Acts.
        critic: Judges; holds its slow copy.
    """

    def __init__(
        self,
        size: ModelSize,
        interface: Interface,
        decode: bool = True,
        min_std: float = MIN_STD,
        max_std: float = MAX_STD,
    ) -> None:
        super().__init__()
        head = (size.actor_critic_layers, size.units, size.norm)
        self.size = size
        self.interface = interface
        self.world_model = WorldModel(size, interface, decode)
        self.actor = Actor(size.features, interface.action_dim, *head, min_std, max_std, size.state_std)
        self.critic = Critic(size.features, *head, size.bins)
