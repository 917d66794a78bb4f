"""PPO on flown rollouts with a critic that sees the simulator's state: an extension, not part of DreamerV3.

Whoever flies sees images; who judges a flight in training may see more. A critic of the state does not take what the
world model has not seen yet for the actor's fault, and it needs no imagination, whose time the world model gets
(docs/experiments.md, entry 20).

Shape legend: N environments, S steps kept of each environment, P privileged numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.config import HORIZON, LossConfig
from dreamer_racing.losses.flown_ppo_actor import FlownPPOActorLoss
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.heads import TwoHotHead, symlog
from dreamer_racing.modules.interface import PRIVILEGED


class AsymmetricPPOActorLoss(FlownPPOActorLoss):
    """Keep what the collector's policy flew, and judge it by a critic of the simulator's state.

    That critic is a two-hot regression of the λ-returns, in as many epochs of minibatches as the actor makes, after the
    advantages were computed. The learner does not call ``forward``: nothing is imagined. Where time ran out, and behind
    the last step kept, the value of the step itself stands for what comes, as in ``FlownPPOActorLoss``.

    Args:
        privileged_dim: P.
        args, kwargs: Of ``FlownPPOActorLoss``.

    Raises:
        ValueError: If ``privileged_dim`` is 0.

    Reference: Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning".
    """

    imagines = False
    reads_privileged = True
    critic_layers, critic_units = 3, 256
    """Hidden layers of the critic [choice]."""
    kept = (*FlownPPOActorLoss.kept, "privileged")
    watched_keys = (*FlownPPOActorLoss.watched_keys, PRIVILEGED)
    privileged: Tensor

    def __init__(self, *args: Any, privileged_dim: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if privileged_dim < 1:
            raise ValueError(
                f"{type(self).__name__} needs privileged numbers to judge by, but the environment gives none under "
                f"{PRIVILEGED}: use an environment with privileged=True, or another loss."
            )
        size = self.world_model.size
        self.state_critic = TwoHotHead(privileged_dim, self.critic_layers, self.critic_units, size.norm, size.bins)
        critic = {"params": list(self.state_critic.parameters()), "lr": self.ppo.critic_learning_rate}
        self.optimizer.add_param_group(critic)

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, horizon: int = HORIZON, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return super().from_config(agent, config, horizon, privileged_dim=agent.interface.privileged_dim, **own)

    def value_function(self) -> Callable[[TensorDictBase], Tensor]:
        """Return what the critic of the simulator's state expects."""
        return self._value_of_states

    @torch.no_grad()
    def _value_of_states(self, acted: TensorDictBase) -> Tensor:
        privileged = acted[PRIVILEGED].to(self.flown.device)
        return self.state_critic.mean(symlog(privileged))

    def _steps(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        return {**super()._steps(rollout), "privileged": symlog(rollout[PRIVILEGED])}

    @torch.no_grad()
    def _value(self) -> Tensor:
        return self.state_critic.mean(self.privileged)

    def _teach(self, returns: Tensor, value: Tensor) -> dict[str, Tensor]:
        """Teach the critic.

        Returns:
            ``ppo/critic_loss``, ``ppo/explained_variance`` (of the returns, by the values before), ``entropy`` of the
            policy that flew, nats, and ``gradient_norm/state_critic``.
        """
        state, target = self.privileged.flatten(0, 1), returns.flatten(0, 1)
        steps = [
            self._regress(state[chosen], target[chosen])
            for _ in range(self.ppo.epochs)
            for chosen in self._shuffled(len(state))
        ]
        losses, norms = zip(*steps, strict=True)
        flown = ActionDistribution(*self.old.chunk(2, -1))
        return {
            "ppo/critic_loss": torch.stack(losses).mean(),
            "ppo/explained_variance": 1.0 - (returns - value).var() / returns.var().clamp_min(1e-8),
            "entropy": flown.entropy().mean(),
            "gradient_norm/state_critic": torch.stack(norms).mean(),
        }

    def _regress(self, state: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Make one gradient step of the critic; return its loss and the norm of its gradient."""
        log_probabilities = self.state_critic(state).log_softmax(-1)
        loss = self.state_critic.two_hot.cross_entropy(log_probabilities, target).mean()
        return loss.detach(), self._descend(loss, self.state_critic)
