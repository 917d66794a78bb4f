"""PPO on flown rollouts with a critic of the loss's own, which learns from what was flown: nothing is imagined.

Shape legend: N environments, S steps kept of each environment, X numbers that the critic sees.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.flown_ppo_actor import FlownPPOActorLoss
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.heads import TwoHotHead


class OwnCriticActorLoss(FlownPPOActorLoss):
    """Keep what the collector's policy flew, and weigh it by a critic that learns from the same steps.

    The critic is a two-hot regression of the λ-returns, in as many epochs of minibatches as the actor makes, after the
    advantages were computed. The learner does not call ``forward``: nothing is imagined, and the time is the world
    model's. Where time ran out, and behind the last step kept, the value of the step itself stands for what comes, as
    in ``FlownPPOActorLoss``. What the critic sees is a subclass's, which makes it by ``_make_critic`` once it is
    initialised itself: ``LatentPPOActorLoss``, ``AsymmetricPPOActorLoss``.

    Args:
        args, kwargs: Of ``FlownPPOActorLoss``.
    """

    imagines = False
    critic_layers, critic_units = 3, 256
    """Hidden layers of the critic [choice]."""

    @property
    @abstractmethod
    def own_critic(self) -> TwoHotHead:
        """The critic, of what ``_kept_inputs`` and ``_inputs_of`` return."""

    @abstractmethod
    def _kept_inputs(self) -> Tensor:
        """Return what the critic sees of the steps kept, ``(S, N, X)``."""

    @abstractmethod
    def _inputs_of(self, acted: TensorDictBase) -> Tensor:
        """Return what it sees of records ``[N]`` that a policy has acted on, ``(N, X)``.

        The latents by which it acted are under ``"next"``; those beside the observation are of the step before.
        """

    def value_function(self) -> Callable[[TensorDictBase], Tensor]:
        """Return what the loss's own critic expects."""
        return self._value_of_records

    @torch.no_grad()
    def _value_of_records(self, acted: TensorDictBase) -> Tensor:
        return self.own_critic.mean(self._inputs_of(acted).to(self.flown.device))

    @torch.no_grad()
    def _value(self) -> Tensor:
        return self.own_critic.mean(self._kept_inputs())

    def _make_critic(self, features: int) -> TwoHotHead:
        """Make a critic of X numbers, and let the loss's optimiser train it."""
        size = self.world_model.size
        critic = TwoHotHead(features, self.critic_layers, self.critic_units, size.norm, size.bins)
        self.optimizer.add_param_group({"params": list(critic.parameters()), "lr": self.ppo.critic_learning_rate})
        return critic

    def _teach(self, returns: Tensor, value: Tensor) -> dict[str, Tensor]:
        """Teach the critic.

        Returns:
            ``ppo/critic_loss``, ``ppo/explained_variance`` (of the returns, by the values before), ``entropy`` of the
            policy that flew, nats, and ``gradient_norm/own_critic``.
        """
        seen, target = self._kept_inputs().flatten(0, 1), returns.flatten(0, 1)
        steps = [
            self._regress(seen[chosen], target[chosen])
            for _ in range(self.ppo.epochs)
            for chosen in self._shuffled(len(seen))
        ]
        losses, norms = zip(*steps, strict=True)
        flown = ActionDistribution(*self.old.chunk(2, -1))
        return {
            "ppo/critic_loss": torch.stack(losses).mean(),
            "ppo/explained_variance": 1.0 - (returns - value).var() / returns.var().clamp_min(1e-8),
            "entropy": flown.entropy().mean(),
            "gradient_norm/own_critic": torch.stack(norms).mean(),
        }

    def _regress(self, seen: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Make one gradient step of the critic; return its loss and the norm of its gradient."""
        log_probabilities = self.own_critic(seen).log_softmax(-1)
        loss = self.own_critic.two_hot.cross_entropy(log_probabilities, target).mean()
        return loss.detach(), self._descend(loss, self.own_critic)
