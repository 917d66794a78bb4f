"""The agent: the three networks that are trained together."""

from __future__ import annotations

from torch import nn

from dreamer_racing.modules import Actor, Critic, Interface, ModelSize, WorldModel


class Agent(nn.Module):
    """The three networks that are trained together.

    Args:
        size: Their widths.
        interface: What the agent sees and does.
        decode: Whether the world model has decoders of what is seen.

    Attributes:
        interface: As given.
        world_model: Predicts.
        actor: Acts.
        critic: Judges; holds its slow copy.
    """

    def __init__(self, size: ModelSize, interface: Interface, decode: bool = True) -> None:
        super().__init__()
        head = (size.actor_critic_layers, size.units, size.norm)
        self.interface = interface
        self.world_model = WorldModel(size, interface, decode)
        self.actor = Actor(size.features, interface.action_dim, *head)
        self.critic = Critic(size.features, *head, size.bins)
