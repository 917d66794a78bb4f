"""Actor losses on imagined λ-returns: REINFORCE, or backpropagation through the dynamics.

Shape legend: N starts, H horizon, D belief, S state, F = D + S features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import PercentileValueNorm
from torchrl.objectives import LossModule

from dreamer_racing import parallel
from dreamer_racing.losses.config import HORIZON, LossConfig
from dreamer_racing.losses.contract import require_keys, scheduled
from dreamer_racing.losses.imagination import Imagination, imagine, lambda_return
from dreamer_racing.modules.actor import Actor
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.critic import Critic
from dreamer_racing.modules.world_model import WorldModel


class Judgement(NamedTuple):
    """What world model and critic think of an imagined rollout; each ``(H, N, 1)`` but the scale.

    Attributes:
        reward: Predicted on arriving after each action.
        continuation: Predicted probability that the episode goes on there.
        lambda_return: From each step on.
        value: Expected by the critic at each step.
        weight: Discounted probability of getting to each step.
        scale: Moving range of returns, a scalar.
    """

    reward: Tensor
    continuation: Tensor
    lambda_return: Tensor
    value: Tensor
    weight: Tensor
    scale: Tensor


class ActorLoss(LossModule):
    """Imagine from given latents and judge the actions by λ-returns; what is maximised is a subclass's.

    The weight of a step is the probability that the episode got that far, discounted: it begins with the *true*
    continuation of the start (0 at a terminal record) and goes on with the predicted ones.

    Args:
        world_model: Dynamics, reward and continue heads; receives no gradient.
        actor: The module to train.
        critic: Baseline and bootstrap; receives no gradient.
        horizon: H, number of imagined actions.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the entropy.
        return_decay: Decay of the moving percentiles.
        continuation: Whether predicted ends of episodes cut returns; if not, imagination goes on for ever.
        drift_scale: Weight of ``hold``; 0: it is not asked for.

    Reads ``belief``, ``state`` and ``terminated`` of the starts, batch ``[N]`` (or any, which is flattened). Writes the
    scalars ``loss_actor``, ``entropy``, ``return_mean``, ``return_scale``, ``imagined_reward``, ``continuation`` (mean
    prediction), and ``imagination``, batch ``[H, N]``: ``features``, ``lambda_return`` and ``weight``, without
    gradient.

    Reference: DreamerV3, Eq. 11-12.
    """

    in_keys = ["belief", "state", "terminated"]
    out_keys = [
        "loss_actor",
        "entropy",
        "return_mean",
        "return_scale",
        "imagined_reward",
        "continuation",
        "imagination",
    ]
    imagines: ClassVar[bool] = True
    """Whether the learner calls ``forward``, to imagine from what it replays."""
    reads_privileged: ClassVar[bool] = False
    """Whether ``watch`` needs ``("privileged", "vector")`` of the environment."""
    optimizer: torch.optim.Optimizer | None = None
    """Of the actor, where the loss steps it by itself in ``improve``; None: the learner's optimiser does."""

    def __init__(
        self,
        world_model: WorldModel,
        actor: Actor,
        critic: Critic,
        *,
        horizon: int = HORIZON,
        discount: float = LossConfig.discount,
        lambda_: float = LossConfig.lambda_,
        entropy_scale: float = LossConfig.entropy_scale,
        return_decay: float = LossConfig.return_decay,
        continuation: bool = LossConfig.continuation,
        drift_scale: float = LossConfig.drift_scale,
    ) -> None:
        super().__init__()
        self.world_model = world_model
        self.actor = actor
        self.critic = critic
        self.horizon = horizon
        self.discount = scheduled(discount)
        self.lambda_ = lambda_
        self.entropy_scale = scheduled(entropy_scale)
        self.continuation = continuation
        self.drift_scale = drift_scale
        self.return_normalizer = PercentileValueNorm(quantiles=(0.05, 0.95), rate=1 - return_decay, min_scale=1.0)

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, horizon: int = HORIZON, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return cls(
            agent.world_model,
            agent.actor,
            agent.critic,
            horizon=horizon,
            discount=config.discount,
            lambda_=config.lambda_,
            entropy_scale=config.entropy_scale,
            return_decay=config.return_decay,
            continuation=config.continuation,
            drift_scale=config.drift_scale,
            **own,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of imagining from a batch of starts; keys in the class's docstring."""
        require_keys(self, tensordict, self.in_keys)
        belief, state, terminated = (tensordict.get(key).detach().flatten(0, -2) for key in self.in_keys)
        loss, judged = self._objective(belief, state, terminated)
        imagination = TensorDict(
            {key: judged.pop(key) for key in ("features", "lambda_return", "weight")}, [self.horizon, len(belief)]
        )
        return TensorDict({"loss_actor": loss, **judged, "imagination": imagination}, [])

    def hold(self, before: Tensor, after: Tensor, weight: Tensor) -> dict[str, Tensor]:
        """Hold the policy where it was while the world model learns; the actor gets no gradient.

        Latents that move are, to an actor that has become precise, another policy: by a nat and more between two
        visits of a record (docs/experiments.md, 40). What is minimised is the divergence of the policy at a record's
        latents as the model makes them now from the policy at those that were stored, so that they may move wherever
        the actor does not look. Latents that are drawn differ by the draw already: it is for those that are not.

        Args:
            before: Features of the stored latents, ``(..., F)``.
            after: Of the model's own, which carry gradient, ``(..., F)``.
            weight: What a record counts for, ``(..., 1)``.

        Returns:
            ``policy_drift``, the divergence, nats, weighted mean over all records as every loss is, so that several
            processes average to the joint batch's; ``loss_drift``, that by ``drift_scale``; scalars.

        Reference: Cobbe et al. 2021, "Phasic policy gradient", the cloning term of Eq. 4; there the policy's own
        network moves, too.
        """
        with torch.no_grad():
            old = self.actor(before)
        with frozen(self.actor):
            drift = old.divergence(self.actor(after))
        drift = (weight * drift).mean()
        return {"loss_drift": self.drift_scale * drift, "policy_drift": drift.detach()}

    def prepare(self, starts: int) -> None:
        """Make room for what a loss keeps of an update with so many starts."""

    def watch(self, rollout: TensorDictBase) -> None:
        """Take note of a rollout ``[N, T]`` that the actor flew, perhaps with older weights."""

    def improve(self, updates: int) -> dict[str, Tensor]:
        """Do what a loss with an optimiser of its own does after the learner's update number ``updates``.

        Returns:
            Nothing, or metrics of what it did, scalars, with ``gradient_norm/actor`` among them.
        """
        return {}

    def value_function(self) -> Callable[[TensorDictBase], Tensor] | None:
        """Return what a critic of the loss's own makes of records ``[N]`` that a policy has acted on, ``(N, 1)``.

        None: the agent's critic teaches the actor.
        """
        return None

    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Imagine from starts ``(N, ...)``; return the loss and everything else that ``forward`` writes."""
        raise NotImplementedError(f"{type(self).__name__} must say what it maximises.")

    def _imagine(self, belief: Tensor, state: Tensor) -> Imagination:
        """Let the actor act in the world model from starts ``(N, ...)``."""
        rssm = self.world_model.rssm
        return imagine(rssm, self.actor, belief, state, self.horizon)

    def _judge(self, features: Tensor, terminated: Tensor) -> Judgement:
        """Compute returns and weights of a rollout, with the gradient of its features.

        Args:
            features: ``(H + 1, N, F)``.
            terminated: Whether each start is a terminal record, bool ``(N, 1)``.
        """
        value = self.critic.value(features)
        reward = self.world_model.reward_head.mean(features[1:])
        continuation = self._continuation(features[1:])
        discount = self.discount * continuation
        returns = lambda_return(reward, value[1:], discount, self.lambda_)
        start = 1.0 - terminated.to(discount.dtype).unsqueeze(0)
        if self.training:
            self.return_normalizer.update(parallel.gathered(returns.detach(), dim=1))
        return Judgement(
            reward=reward.detach(),
            continuation=continuation.detach(),
            lambda_return=returns,
            value=value[:-1],
            weight=torch.cat((start, discount[:-1].detach())).cumprod(0),
            scale=self.return_normalizer.scale(),
        )

    def _continuation(self, features: Tensor) -> Tensor:
        """Return the probability ``(..., 1)`` that the episode goes on after features ``(..., F)``."""
        if not self.continuation:
            return features.new_ones((*features.shape[:-1], 1), dtype=torch.float32)
        return self.world_model.continue_head.probability(features)

    def _report(self, features: Tensor, entropy: Tensor, judged: Judgement) -> dict[str, Tensor]:
        """Return all that ``forward`` writes beside the loss."""
        return {
            "entropy": entropy.detach().mean(),
            "return_mean": judged.lambda_return.detach().mean(),
            "return_scale": judged.scale.squeeze(-1),
            "imagined_reward": judged.reward.mean(),
            "continuation": judged.continuation.mean(),
            "features": features[:-1].detach(),
            "lambda_return": judged.lambda_return.detach(),
            "weight": judged.weight,
        }


class ReinforceLoss(ActorLoss):
    """Reinforce the imagined actions that did better than the critic expected.

    ``−weight · (log π(a) · advantage / scale + entropy_scale · H[π])``, where scale is the moving range from the 5th to
    the 95th percentile of returns, but at least 1. Arguments and keys: ``ActorLoss``.
    """

    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        with torch.no_grad():
            features, action = self._imagine(belief, state)
            judged = self._judge(features, terminated)
        policy = self.actor(features[:-1])
        entropy = policy.entropy()
        advantage = (judged.lambda_return - judged.value) / judged.scale
        objective = policy.log_prob(action) * advantage + self.entropy_scale * entropy
        return -(judged.weight * objective).mean(), self._report(features, entropy, judged)


class DynamicsActorLoss(ActorLoss):
    """Climb the gradient of the λ-returns through the imagined dynamics.

    ``−weight · (λ-return / scale + entropy_scale · H[π])``: straight-through samples carry the gradient from rewards
    and values back to the actions. Networks other than the actor are left without gradient. Arguments and keys:
    ``ActorLoss``.

    Reference: DreamerV2, Eq. 6 (``ρ = 0``), the default of danijar/dreamerv2 and of dreamerv3-torch for continuous
    actions; scaled by DreamerV3's return range.
    """

    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        with frozen(self.world_model, self.critic):
            features, _ = self._imagine(belief, state)
            judged = self._judge(features, terminated)
        # The policy once more on fixed features: the entropy shall not pull the dynamics towards indecision.
        entropy = self.actor(features[:-1].detach()).entropy()
        objective = judged.lambda_return / judged.scale + self.entropy_scale * entropy
        return -(judged.weight * objective).mean(), self._report(features, entropy, judged)


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Let gradient flow through modules but not into their parameters, nor what stands for these (``cast_once``)."""
    layers = {layer: None for module in modules for layer in module.modules()}
    held = [
        (layer, name, parameter)
        for layer in layers
        for name, parameter in layer._parameters.items()
        if parameter is not None and parameter.requires_grad
    ]
    for layer, name, parameter in held:
        layer._parameters[name] = parameter.detach()  # type: ignore[assignment]  # no parameter, but in its place
    try:
        yield
    finally:
        for layer, name, parameter in held:
            layer._parameters[name] = parameter
