"""The agent, which is world model, actor and critic, and its policy as a TensorDictModule.

Shape legend: N environments, A action, D belief, S state.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from dreamer_racing.modules.heads import MAX_STD, MIN_STD, ActionDistribution, Actor, Critic
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.rssm import join_features
from dreamer_racing.modules.sizes import ModelSize
from dreamer_racing.modules.world_model import WorldModel


class Agent(nn.Module):
    """World model, actor and critic.

    Args:
        size: Sizes of the networks.
        interface: Observations and actions of the agent.
        decode: Whether the world model has decoders of the observations.
        min_std: Smallest standard deviation of actions.
        max_std: Largest standard deviation of actions.

    Attributes:
        world_model: Encoder, dynamics, decoders, reward and continue heads.
        actor: Policy head.
        critic: Value function with its slow copy.
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


class DreamerPolicy(TensorDictModuleBase):
    """Recurrent policy that encodes the observation, updates the latents and chooses an action.

    The recurrent keys are read at the root and written under ``"next"``, from where the environment's step moves them
    to the next root; append ``make_primer()`` and ``InitTracker()`` to the environment so that they exist. If
    ``is_init`` is set, their values at the root are ignored, so partial and automatic resets need nothing more.

    Args:
        world_model: World model whose encoder and RSSM are used (shared, not copied).
        actor: The policy head.
        deterministic: Use the mode of latents that are ``sampled``, and the mean of clipped actions; may be set at any
            time.

    | key | read / written | shape |
    |---|---|---|
    | ``pixels``, ``vector`` or ``imu`` | read, if the agent sees them | uint8 (N, height, width, 3), float32 (N, V) |
    | ``is_init`` | read | bool (N, 1) |
    | ``belief``, ``state``, ``previous_action`` | read | (N, D), (N, S), (N, A) |
    | ``action`` | written | (N, A) in [−1, 1] |
    | ``loc``, ``scale`` | written | (N, A): mean and standard deviation that the action was drawn from |
    | ``("next", "belief")``, ``("next", "state")``, ``("next", "previous_action")`` | written | as above |
    """

    def __init__(self, world_model: WorldModel, actor: Actor, deterministic: bool = False) -> None:
        super().__init__()
        self.in_keys = [*world_model.encoder.keys, "is_init", "belief", "state", "previous_action"]
        self.out_keys = ["action", "loc", "scale", ("next", "belief"), ("next", "state"), ("next", "previous_action")]
        self.encoder = world_model.encoder
        self.rssm = world_model.rssm
        self.actor = actor
        self.deterministic = deterministic

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next recurrent keys to a tensordict of any batch size, and return it."""
        batch = tensordict.batch_size
        flat = {key: tensordict.get(key).reshape(-1, *tensordict.get(key).shape[len(batch) :]) for key in self.in_keys}
        policy, action, belief, state = self._decide(flat)
        for key, value in zip(self.out_keys, (action, *policy, belief, state, action), strict=True):
            tensordict.set(key, value.reshape(*batch, -1))
        return tensordict

    def act(self, seen: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return action (N, A), belief (N, D) and state (N, S) as plain tensors.

        Args:
            seen: The keys that the table lists as read, with one batch dimension; ``is_init`` may be (N,).
        """
        return self._decide(seen)[1:]

    @torch.no_grad()
    def _decide(self, seen: Mapping[str, Tensor]) -> tuple[ActionDistribution, Tensor, Tensor, Tensor]:
        """Return the distribution of the action, then action, belief and state as ``act`` does."""
        belief, state = self.rssm.observe_step(
            self.encoder(seen),
            seen["previous_action"],
            seen["is_init"].flatten(),
            seen["belief"],
            seen["state"],
            deterministic=self.deterministic,
        )
        policy = self.actor(join_features(belief, state))
        action = policy.clipped_mean() if self.deterministic else policy.sample()
        return policy, action.clamp(-1.0, 1.0), belief, state

    def make_primer(self) -> TensorDictPrimer:
        """Make the transform that adds the recurrent keys, zero at a reset, to an environment of any batch size."""
        size = {
            "belief": self.rssm.initial_belief.shape[-1],
            "state": self.rssm.latents * self.rssm.classes,
            "previous_action": self.rssm.cell.action_dim,
        }
        specs = {key: Unbounded(shape=(width,)) for key, width in size.items()}
        return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)
