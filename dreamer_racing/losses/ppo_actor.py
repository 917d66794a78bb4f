"""PPO on imagined rollouts: an extension, not part of DreamerV3.

REINFORCE takes one step along the gradient of one batch of rollouts, and an optimiser that normalises gradients makes
it a full step however noisy it is. Here the rollouts of several updates are kept, the actor does not move meanwhile,
and then a few epochs of minibatches use them up; the clipped ratio bounds how far it moves for that much imagination.

Shape legend: K updates, H horizon, N starts, M records of a minibatch, F features, A action.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from dreamer_racing.losses.actor import ActorLoss
from dreamer_racing.losses.config import ImaginedPPOConfig, LossConfig
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.agent import Agent

KL_TOLERANCE = 1.5
"""Factor that a divergence may be off its target. Reference: Schulman et al. 2017, Section 4."""
PACE_CHANGE, SLOWEST_PACE = 1.25, 0.01
"""Factor by which the learning rate then changes, and its smallest share [choice]."""


class Minibatch(NamedTuple):
    """Imagined steps to learn from; each ``(M, ...)``.

    Attributes:
        features: Seen by the policy, ``(M, F)``.
        action: Sampled there, ``(M, A)``.
        old: Mean and standard deviation of the policy that sampled, ``(M, 2·A)``.
        advantage: Normalised, ``(M, 1)``.
        weight: Discounted probability of getting there, ``(M, 1)``.
    """

    features: Tensor
    action: Tensor
    old: Tensor
    advantage: Tensor
    weight: Tensor


class PPOActorLoss(ActorLoss):
    """Keep imagined rollouts, and improve the actor on them every few updates, with an optimiser of its own.

    ``forward`` imagines and judges as its siblings do, keeps the rollout, and writes a ``loss_actor`` of zero: nothing
    for the learner's optimiser. ``improve``, which the learner calls after each update, does nothing until K rollouts
    are there; then advantages are normalised over all of them, and the actor makes epochs of minibatches on
    ``−weight · (min(r·advantage, clip(r, 1 ± ε)·advantage) + entropy_scale · H[π])``, r being the ratio of new to old
    probability of an action.

    The rollouts are buffers of the module, so a checkpoint holds them and a CUDA graph can fill them. They take the
    number of starts from the first batch; with another number, or another K or H, they begin anew.

    Args:
        ppo: Numbers of the improvement.
        args, kwargs: Of ``ActorLoss``.

    Reference: Schulman et al. 2017, "Proximal policy optimization algorithms", Eq. 7.
    """

    optimizer: torch.optim.Optimizer
    features: Tensor
    action: Tensor
    old: Tensor
    advantage: Tensor
    weight: Tensor
    cursor: Tensor
    kept: Tensor
    pace: Tensor

    def __init__(self, *args: Any, ppo: ImaginedPPOConfig | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.ppo = ppo or ImaginedPPOConfig()
        for name in Minibatch._fields:
            self.register_buffer(name, torch.empty(0))
        self.register_buffer("cursor", torch.zeros(1, dtype=torch.int64))  # the place that is written next
        self.register_buffer("kept", torch.zeros(1, dtype=torch.int64))  # places written so far, at most K
        self.register_buffer("pace", torch.ones(1))  # share of the learning rate
        self.optimizer = torch.optim.Adam(self.actor.parameters(), lr=self.ppo.learning_rate, eps=1e-5)

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, horizon: int = 16, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return super().from_config(agent, config, horizon, ppo=config.ppo, **own)

    def prepare(self, starts: int) -> None:
        """Make room for K rollouts from so many starts each; what was kept of another shape is forgotten.

        The learner calls this before an update, so that nothing is allocated inside a captured or compiled step.
        """
        shape = (self.ppo.updates, self.horizon, starts)
        if self.weight.shape[:-1] == shape:
            return
        features, actions = self.world_model.size.features, self.world_model.interface.action_dim
        for name, width in zip(Minibatch._fields, (features, actions, 2 * actions, 1, 1), strict=True):
            self.register_buffer(name, torch.zeros(*shape, width, device=self.cursor.device))
        self.cursor.zero_()
        self.kept.zero_()

    @torch.no_grad()
    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        self.prepare(len(belief))
        features, action = self._imagine(belief, state)
        judged = self._judge(features, terminated)
        policy = self.actor(features[:-1])
        if self.training:
            self._keep(
                features=features[:-1],
                action=action,
                old=torch.cat((policy.mean, policy.std), -1),
                advantage=judged.lambda_return - judged.value,
                weight=judged.weight,
            )
        return features.new_zeros(()), self._report(features, policy.entropy(), judged)

    def _keep(self, **rollout: Tensor) -> None:
        """Write a rollout of ``(H, N, ...)`` into the next of the K places."""
        for name, value in rollout.items():
            self.get_buffer(name).index_copy_(0, self.cursor, value.unsqueeze(0).float())
        self.cursor.add_(1).remainder_(self.ppo.updates)
        self.kept.add_(1).clamp_(max=self.ppo.updates)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Take the number of starts from what is loaded; rollouts of another number or horizon are left out."""
        saved = state_dict.get(f"{prefix}weight")
        if saved is not None and saved.shape[:2] == (self.ppo.updates, self.horizon):
            self.prepare(saved.shape[2])
        else:
            for name in (*Minibatch._fields, "cursor", "kept"):
                state_dict.pop(prefix + name, None)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def improve(self, updates: int) -> dict[str, Tensor]:
        """Train the actor if the rollouts of K updates are there.

        Args:
            updates: Updates of the learner so far.

        Returns:
            Nothing, or ``ppo/loss``, ``ppo/kl``, ``ppo/clipped`` (share of steps), ``ppo/epochs``, ``ppo/pace`` (share
            of the learning rate) and ``gradient_norm/actor`` of what was done; scalars. A step whose gradient is not
            finite is not made.
        """
        if updates % self.ppo.updates or int(self.kept) < self.ppo.updates:
            return {}
        if self.ppo.kl_target is None:
            self.pace.fill_(1.0)
        with self._paced():
            metrics = self._improve(self._normalised())
        metrics["ppo/pace"] = self.pace.squeeze().clone()
        self._set_pace(metrics["ppo/kl"])
        return metrics

    def _improve(self, records: Minibatch) -> dict[str, Tensor]:
        """Make epochs of gradient steps, until one comes upon too large a divergence."""
        number, size = len(records.features), min(self.ppo.minibatch, len(records.features))
        done: list[dict[str, Tensor]] = []
        for _ in range(self.ppo.epochs):
            order = torch.randperm(number, device=records.features.device)
            for chosen in order.split(size):
                metrics = self._minibatch(Minibatch(*(value[chosen] for value in records)))
                done.append(metrics)
                if not metrics["ppo/kl"] <= self.ppo.kl_stop:  # waits for the device, some times an improvement
                    return _summary(done, math.ceil(number / size))
        return _summary(done, math.ceil(number / size))

    @contextmanager
    def _paced(self) -> Iterator[None]:
        """Take the present share of the learning rates."""
        pace, groups = float(self.pace), self.optimizer.param_groups
        rates = [group["lr"] for group in groups]
        for group, rate in zip(groups, rates, strict=True):
            group["lr"] = rate * pace
        try:
            yield
        finally:
            for group, rate in zip(groups, rates, strict=True):
                group["lr"] = rate

    def _set_pace(self, kl: Tensor) -> None:
        """Go slower after a divergence well above the target, and faster, up to the full rate, well below it."""
        target = self.ppo.kl_target
        if target is None:
            return
        if not kl <= KL_TOLERANCE * target:
            self.pace.div_(PACE_CHANGE).clamp_(min=SLOWEST_PACE)
        elif kl < target / KL_TOLERANCE:
            self.pace.mul_(PACE_CHANGE).clamp_(max=1.0)

    def _normalised(self) -> Minibatch:
        """Return all imagined steps, with advantages of mean 0 and deviation 1 under their weights."""
        records = Minibatch(*(self.get_buffer(name).flatten(0, 2) for name in Minibatch._fields))
        share = records.weight / records.weight.sum().clamp_min(1e-8)
        mean = (share * records.advantage).sum()
        deviation = (share * (records.advantage - mean).square()).sum().sqrt()
        advantage = (records.advantage - mean) / (deviation + 1e-8)
        return records._replace(advantage=advantage.clamp(-self.ppo.advantage_clip, self.ppo.advantage_clip))

    def _minibatch(self, batch: Minibatch) -> dict[str, Tensor]:
        """Make one gradient step; the divergence is that from before it."""
        loss, metrics = clipped_objective(self.actor(batch.features), batch, self.ppo.clip_epsilon, self.entropy_scale)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.actor.parameters(), self.ppo.gradient_clip)
        if norm.isfinite():
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return {"ppo/loss": loss.detach(), **metrics, "gradient_norm/actor": norm}


def _summary(done: list[dict[str, Tensor]], minibatches: int) -> dict[str, Tensor]:
    """Average over the gradient steps; the divergence is the last."""
    means = {name: torch.stack([metrics[name] for metrics in done]).mean() for name in done[0]}
    kl = done[-1]["ppo/kl"]
    return means | {"ppo/kl": kl, "ppo/epochs": torch.full_like(kl, len(done) / minibatches)}


def clipped_objective(
    policy: ActionDistribution, batch: Minibatch, clip_epsilon: float, entropy_scale: float | Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute PPO's loss on a minibatch, a scalar, and what to watch: ``ppo/kl`` and ``ppo/clipped``.

    Args:
        policy: The present one at the minibatch's features.
        batch: The minibatch.
        clip_epsilon: ε.
        entropy_scale: Weight of the entropy.

    Reference: Schulman et al. 2017, Eq. 7.
    """
    old = ActionDistribution(*batch.old.chunk(2, -1))
    ratio = (policy.log_prob(batch.action) - old.log_prob(batch.action)).exp()
    bounded = ratio.clamp(1.0 - clip_epsilon, 1.0 + clip_epsilon)
    gain = torch.minimum(ratio * batch.advantage, bounded * batch.advantage)
    loss = -(batch.weight * (gain + entropy_scale * policy.entropy())).mean()
    with torch.no_grad():
        reached = batch.weight.sum().clamp_min(1e-8)
        kl = (batch.weight * normal_divergence(old, policy)).sum() / reached  # of what the objective counts
        clipped = ((ratio - 1.0).abs() > clip_epsilon).float().mean()
    return loss, {"ppo/kl": kl, "ppo/clipped": clipped}


def normal_divergence(old: ActionDistribution, new: ActionDistribution) -> Tensor:
    """Return KL(old ‖ new) of independent normals, nats, ``(..., 1)``."""
    variances = (old.std.square() + (old.mean - new.mean).square()) / (2.0 * new.std.square())
    return (new.std.log() - old.std.log() + variances - 0.5).sum(-1, keepdim=True)
