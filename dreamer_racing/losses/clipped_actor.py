"""PPO's improvement of an actor: epochs of minibatches on clipped ratios, with an optimiser of its own.

REINFORCE takes one step along the gradient of one batch of rollouts, and an optimiser that normalises gradients makes
it a full step however noisy it is. Here rollouts are kept, the actor does not move meanwhile, and then a few epochs of
minibatches use them up; the clipped ratio bounds how far it moves for that much experience. Where that comes from is a
subclass's: ``PPOActorLoss`` imagines it, ``FlownPPOActorLoss`` takes what the collector flew.

Nothing here waits for a CUDA device. Whether a gradient step is to be made is known there alone: it is made with a mask
that may leave everything as it was, and after too large a divergence the remaining steps of an improvement are such.

Shape legend: M records of a minibatch, F features, A action.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.losses.actor import ActorLoss
from dreamer_racing.losses.config import HORIZON, ActorPPOConfig, LossConfig
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.agent import Agent

KL_TOLERANCE = 1.5
"""Factor that a divergence may be off its target. Reference: Schulman et al. 2017, Section 4."""
PACE_CHANGE, SLOWEST_PACE = 1.25, 0.01
"""Factor by which the learning rate then changes, and its smallest share [choice]."""


def masks_steps(device: torch.device) -> bool:
    """Tell whether steps are masked on a device, rather than left out, for which the CPU would have to wait."""
    return device.type == "cuda"


LogProb = Callable[[ActionDistribution, Tensor], Tensor]
"""Log-probability ``(..., 1)`` of an action ``(..., A)``."""


class Minibatch(NamedTuple):
    """Steps to learn from; each ``(M, ...)``.

    Attributes:
        features: Seen by the policy, ``(M, F)``.
        action: Sampled there, ``(M, A)``.
        old: Mean and standard deviation of the policy that sampled, ``(M, 2·A)``.
        advantage: Normalised, ``(M, 1)``.
        weight: What a step counts for, ``(M, 1)``.
    """

    features: Tensor
    action: Tensor
    old: Tensor
    advantage: Tensor
    weight: Tensor


class ClippedActorLoss(ActorLoss):
    """Improve the actor on steps that a subclass keeps.

    Epochs of minibatches are made on ``−weight · (min(r·advantage, clip(r, 1 ± ε)·advantage) + entropy_scale · H[π])``,
    r being the ratio of new to old probability of an action.

    Args:
        ppo: Numbers of the improvement.
        args, kwargs: Of ``ActorLoss``.

    Reference: Schulman et al. 2017, "Proximal policy optimization algorithms", Eq. 7.
    """

    log_prob: LogProb = staticmethod(ActionDistribution.log_prob)
    """Of an action as it is kept."""
    optimizer: torch.optim.Optimizer
    pace: Tensor

    def __init__(self, *args: Any, ppo: ActorPPOConfig | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.ppo = ppo or ActorPPOConfig()
        self.kl_target = self.ppo.kl_target  # may be on a schedule, `DreamerLearner.adjust`
        self.register_buffer("pace", torch.ones(1))  # share of the learning rate
        self._masked = masks_steps(next(self.actor.parameters()).device)
        # The fused one takes a mask, and a rate that is a tensor.
        self.optimizer = torch.optim.Adam(
            self.actor.parameters(), lr=self.ppo.learning_rate, eps=1e-5, fused=True if self._masked else None
        )

    @classmethod
    def from_config(cls, agent: Agent, config: LossConfig, horizon: int = HORIZON, **own: Any) -> Self:
        """Make the loss of an agent with the losses' numbers, and with arguments of a subclass's own."""
        return super().from_config(agent, config, horizon, ppo=config.ppo, **own)

    @torch.no_grad()
    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Imagine and judge, for the critic and for what is kept; the loss itself is zero."""
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
        """Keep an imagined rollout, the parts of a ``Minibatch`` with ``(H, N)`` in front."""

    def _improve_on(self, records: Minibatch) -> dict[str, Tensor]:
        """Improve the actor on all records, at the present share of the learning rate.

        Returns:
            ``ppo/loss``, ``ppo/kl``, ``ppo/clipped`` (share of steps), ``ppo/epochs``, ``ppo/pace`` (share of the
            learning rate) and ``gradient_norm/actor`` of what was done; scalars. A step whose gradient is not finite is
            not made.
        """
        if self.kl_target is None:
            self.pace.fill_(1.0)
        with self._paced():
            clip = self.ppo.advantage_clip
            advantage = normalised(records.advantage, records.weight).clamp(-clip, clip)
            metrics = self._make_epochs(records._replace(advantage=advantage))
        metrics["ppo/pace"] = self.pace.squeeze().clone()
        self._set_pace(metrics["ppo/kl"])
        return metrics

    def _make_epochs(self, records: Minibatch) -> dict[str, Tensor]:
        """Make epochs of gradient steps, until one comes upon too large a divergence.

        It is that from the policy as it is now: from the one that sampled, a bound of the deviation that has come down
        since would count as if the steps had done it, and end them (docs/experiments.md, 40).
        """
        with torch.no_grad():
            before = torch.cat(self.actor(records.features), -1)  # (M, 2·A)
        number = len(records.features)
        going = records.features.new_ones((), dtype=torch.bool)
        done, made = list[dict[str, Tensor]](), list[Tensor]()
        for _ in range(self.ppo.epochs):
            for chosen in self._shuffled(number):
                batch = Minibatch(*(value[chosen] for value in records))
                metrics = self._minibatch(batch, before[chosen], going)
                done.append(metrics)
                made.append(going)
                going = going & (metrics["ppo/kl"] <= self.ppo.kl_stop)
                if not self._masked and not going:
                    return _summary(done, made, self._minibatches(number))
        return _summary(done, made, self._minibatches(number))

    def _minibatches(self, number: int) -> int:
        """Return how many minibatches make an epoch of so many records."""
        return math.ceil(number / self.ppo.minibatch)

    def _shuffled(self, number: int) -> Sequence[Tensor]:
        """Draw an epoch of so many records: the places of each minibatch, which differ in size by one at most."""
        order = torch.randperm(number, device=self.pace.device)
        return order.tensor_split(self._minibatches(number))

    @contextmanager
    def _paced(self) -> Iterator[None]:
        """Take the present share of the learning rates."""
        pace, groups = self.pace if self._masked else float(self.pace), self.optimizer.param_groups
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
        target = self.kl_target
        if target is None:
            return
        slower, faster = (self.pace / PACE_CHANGE).clamp(min=SLOWEST_PACE), (self.pace * PACE_CHANGE).clamp(max=1.0)
        pace = torch.where(kl < target / KL_TOLERANCE, faster, self.pace)
        self.pace.copy_(torch.where(kl <= KL_TOLERANCE * target, pace, slower))  # the latter also where it is no number

    def _minibatch(self, batch: Minibatch, before: Tensor, going: Tensor) -> dict[str, Tensor]:
        """Make one gradient step if ``going``, bool, a scalar.

        Its divergence is that of the policy ahead of the step from the one ``before`` the improvement, ``(M, 2·A)``.
        """
        policy = self.actor(batch.features)
        numbers = self.ppo.clip_epsilon, self.entropy_scale, self.log_prob
        loss, metrics = clipped_objective(policy, batch, *numbers, ActionDistribution(*before.chunk(2, -1)))
        norm = self._descend(loss, self.actor, going)
        return {"ppo/loss": loss.detach(), **metrics, "gradient_norm/actor": norm}

    def _descend(self, loss: Tensor, network: nn.Module, going: Tensor | None = None) -> Tensor:
        """Make one gradient step of a network, unless its gradient is not finite; return the norm before clipping.

        Args:
            loss: A scalar.
            network: Whose gradient is clipped.
            going: Whether to make the step at all, bool, a scalar; None: yes.
        """
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if parallel.count() > 1:
            parallel.average_gradients(network.parameters())
        norm = nn.utils.clip_grad_norm_(network.parameters(), self.ppo.gradient_clip)
        good = norm.isfinite() if going is None else norm.isfinite() & going
        if self._masked:
            self.optimizer.found_inf = (~good).float()  # type: ignore[attr-defined]  # what a `GradScaler` tells it
            self.optimizer.step()
        elif good:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return norm


def _summary(done: list[dict[str, Tensor]], made: list[Tensor], minibatches: int) -> dict[str, Tensor]:
    """Average over the gradient steps that were ``made``, bool, scalars; the divergence is that of the last of them."""
    mask = torch.stack(made)
    number = mask.sum()
    values = {name: torch.stack([metrics[name] for metrics in done]) for name in done[0]}
    means = {name: value.where(mask, 0.0).sum() / number for name, value in values.items()}
    kl = values["ppo/kl"].gather(0, number.unsqueeze(0) - 1).squeeze(0)
    return means | {"ppo/kl": kl, "ppo/epochs": number.to(kl.dtype) / minibatches}


def normalised(advantage: Tensor, weight: Tensor) -> Tensor:
    """Return advantages ``(..., 1)`` with mean 0 and deviation 1, over all processes, under weights ``(..., 1)``."""
    share = weight / parallel.total(weight.sum()).clamp_min(1e-8)
    mean = parallel.total((share * advantage).sum())
    deviation = parallel.total((share * (advantage - mean).square()).sum()).sqrt()
    return (advantage - mean) / (deviation + 1e-8)


def clipped_objective(
    policy: ActionDistribution,
    batch: Minibatch,
    clip_epsilon: float,
    entropy_scale: float | Tensor,
    log_prob: LogProb = ActionDistribution.log_prob,
    before: ActionDistribution | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute PPO's loss on a minibatch, a scalar, and what to watch: ``ppo/kl`` and ``ppo/clipped``.

    Args:
        policy: The present one at the minibatch's features.
        batch: The minibatch.
        clip_epsilon: ε.
        entropy_scale: Weight of the entropy.
        log_prob: Of an action as the minibatch has it.
        before: Policy that ``ppo/kl`` is the divergence from; None: the one that sampled.

    Reference: Schulman et al. 2017, Eq. 7.
    """
    old = ActionDistribution(*batch.old.chunk(2, -1))
    ratio = (log_prob(policy, batch.action) - log_prob(old, batch.action)).exp()
    bounded = ratio.clamp(1.0 - clip_epsilon, 1.0 + clip_epsilon)
    gain = torch.minimum(ratio * batch.advantage, bounded * batch.advantage)
    loss = -(batch.weight * (gain + entropy_scale * policy.entropy())).mean()
    with torch.no_grad():
        reached = parallel.total(batch.weight.sum()).clamp_min(1e-8)
        diverged = parallel.total((batch.weight * (old if before is None else before).divergence(policy)).sum())
        kl = diverged / reached  # of what the objective counts, in all processes: it ends the epochs of all
        clipped = ((ratio - 1.0).abs() > clip_epsilon).float().mean()
    return loss, {"ppo/kl": kl, "ppo/clipped": clipped}
