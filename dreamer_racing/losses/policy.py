"""Objectives of the policy: pure functions of imagined or collected steps.

An objective takes a `Trajectory` and hyperparameters, and returns a scalar loss and scalar metrics by name:

    def objective(trajectory, **numbers): return loss, {"name": metric}

Shape legend: H steps, N parallel rollouts (a shuffled minibatch has one dimension M in place of both), F features, A
action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.modules.heads import ActionDistribution
from dreamer_racing.modules.layers import replaced
from dreamer_racing.settings import import_own, suggestion


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Let gradients flow through modules, but not into their parameters or the copies of these by ``cast_once``."""
    layers = {layer: None for module in modules for layer in module.modules()}
    held = [
        (layer, name, parameter)
        for layer in layers
        for name, parameter in layer._parameters.items()
        if parameter is not None and parameter.requires_grad
    ]
    with replaced(held, [parameter.detach() for _, _, parameter in held]):
        yield


@dataclass(frozen=True)
class Trajectory:
    """Steps of a policy with their returns; each field ``(H, N, ...)``, or ``(M, ...)`` for a minibatch.

    Attributes:
        policy: Current policy at each step; its mean and standard deviation ``(H, N, A)`` carry gradient.
        features: Belief and state before the action, ``(H, N, F)``; without gradient.
        action: Action taken, ``(H, N, A)``: unclipped if imagined, clipped to [−1, 1] if collected.
        previous_action: Action of the step before, ``(H, N, A)``, clipped; zero at the start of an episode.
        behavior: Policy that took the action; for imagined steps the current one, without gradient.
        lambda_return: λ-return from the step on, ``(H, N, 1)``; carries gradient only if it flows through the dynamics.
        value: Critic's value, ``(H, N, 1)``.
        advantage: λ-return minus value, ``(H, N, 1)``: divided by ``scale`` for imagined steps, normalised to mean 0
            and standard deviation 1 for collected ones.
        weight: Weight of each step, ``(H, N, 1)``: 1 if collected; if imagined the product of the discounts before
            it, each γ times the probability that the episode continues to the power of ``crash_weight``; 0 if the
            rollout starts from a record that ended its episode.
        scale: Range of the returns, at least 1, a scalar.
    """

    policy: ActionDistribution
    features: Tensor
    action: Tensor
    previous_action: Tensor
    behavior: ActionDistribution
    lambda_return: Tensor
    value: Tensor
    advantage: Tensor
    weight: Tensor
    scale: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of ``weight`` times values ``(H, N, 1)`` over the steps, a scalar.

        Raises:
            ValueError: If the values have another shape, which would be broadcast.
        """
        if values.shape != self.weight.shape:
            raise ValueError(
                f"Trajectory.mean() of values of shape {tuple(values.shape)}: must be {tuple(self.weight.shape)}, one "
                "value for each step; sum over actions by .sum(-1, keepdim=True)."
            )
        return (self.weight * values).mean()

    def action_change(self) -> Tensor:
        """Return the weighted mean of ‖μₜ − μₜ₋₁‖², the squared change of the policy's mean per step, a scalar.

        The steps must be in order, ``(H, N, ...)``; the first one counts 0. The change is that of means, not of
        samples, so that it does not reward repeating the noise.

        Reference: Mysore et al. 2021, "Regularizing action policies for smooth control with reinforcement learning",
        temporal smoothness; squared here, as changes of action are in the reward (b₃).
        """
        mean, weight = self.policy.mean, self.weight
        change = (mean[1:] - mean[:-1]).square().sum(-1, keepdim=True)
        return (weight[1:] * change).sum() / weight.numel()


Objective = Callable[..., tuple[Tensor, dict[str, Tensor]]]
"""Loss function of a policy: ``(trajectory, **numbers)`` to a loss and metrics, scalars."""


def through_dynamics(objective: Objective) -> Objective:
    """Mark an objective that needs the returns' gradient through the imagined dynamics."""
    objective.through_dynamics = True  # type: ignore[attr-defined]  # functions take attributes
    return objective


def reinforce(trajectory: Trajectory, *, entropy_scale: Tensor, **numbers: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute the REINFORCE loss: make actions with a positive advantage more likely.

    ``−weight · (log π(a) · advantage + entropy_scale · H[π])``, without gradient through the advantage.

    Reference: DreamerV3, Eq. 11.
    """
    policy, entropy = trajectory.policy, trajectory.policy.entropy()
    objective = policy.log_prob(trajectory.action) * trajectory.advantage + entropy_scale * entropy
    return -trajectory.mean(objective), {"entropy": entropy.detach().mean()}


@through_dynamics
def dynamics(trajectory: Trajectory, *, entropy_scale: Tensor, **numbers: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute the loss that maximises λ-returns by their gradient through the imagined dynamics.

    ``−weight · (λ-return / scale + entropy_scale · H[π])``: straight-through samples carry the gradient from rewards
    and values back to the actions.

    Reference: DreamerV2, Eq. 6 (``ρ = 0``), the default of danijar/dreamerv2 and of dreamerv3-torch for continuous
    actions; scaled by DreamerV3's return range.
    """
    entropy = trajectory.policy.entropy()
    objective = trajectory.lambda_return / trajectory.scale + entropy_scale * entropy
    return -trajectory.mean(objective), {"entropy": entropy.detach().mean()}


def clipped_surrogate(
    trajectory: Trajectory, *, entropy_scale: Tensor, clip_epsilon: float, **numbers: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """Compute PPO's clipped surrogate loss.

    ``−weight · (min(r·advantage, clip(r, 1 ± ε)·advantage) + entropy_scale · H[π])``, where r is the ratio of the
    clipped action's probabilities under the current and the behaviour policy.

    Reference: Schulman et al. 2017, "Proximal policy optimization algorithms", Eq. 7.
    """
    policy, behavior, action = trajectory.policy, trajectory.behavior, trajectory.action
    ratio = (policy.log_prob_clipped(action) - behavior.log_prob_clipped(action)).exp()
    bounded = ratio.clamp(1.0 - clip_epsilon, 1.0 + clip_epsilon)
    gain = torch.minimum(ratio * trajectory.advantage, bounded * trajectory.advantage)
    clipped = ((ratio.detach() - 1.0).abs() > clip_epsilon).float().mean()
    return -trajectory.mean(gain + entropy_scale * policy.entropy()), {"ppo/clipped": clipped}


def policy_drift(actor: nn.Module, before: Tensor, after: Tensor, weight: Tensor) -> Tensor:
    """Compute how much the policy changes because the world model's latents do; trains the world model, not the actor.

    As the world model learns, the latents of a record change, and with them the policy there: for an actor with small
    standard deviations by a nat and more between two visits of a record. The loss is KL(stored ‖ current) of the policy
    at a record's stored and current latents, so the latents may still change in directions that the actor ignores. It
    is meant for deterministic latents, because sampled ones differ by their noise anyway.

    Args:
        actor: The policy.
        before: Features of the stored latents, ``(..., F)``.
        after: Features of the current latents, which carry gradient, ``(..., F)``.
        weight: Weight of each record, ``(..., 1)``.

    Returns:
        The divergence, nats, a scalar: the sum of weighted divergences divided by the number of records, so that the
        average over processes is that of the joint batch.

    Reference: Cobbe et al. 2021, "Phasic policy gradient", the cloning term of Eq. 4, where the policy's own network
    changes, too.
    """
    with torch.no_grad():
        old = actor(before)
    with frozen(actor):
        drift = old.divergence(actor(after))
    return (weight * drift).mean()


def normalized(advantage: Tensor) -> Tensor:
    """Normalise advantages ``(..., 1)`` to mean 0 and standard deviation 1 over all processes."""
    share = 1.0 / parallel.total(advantage.new_full((), float(advantage.numel())))
    mean = parallel.total((share * advantage).sum())
    deviation = parallel.total((share * (advantage - mean).square()).sum()).sqrt()
    return (advantage - mean) / (deviation + 1e-8)


def gradient_of_actions(objective: Objective, *others: nn.Module) -> AbstractContextManager:
    """Return the gradient context in which a rollout is imagined for an objective.

    Args:
        objective: Unless it is marked by `through_dynamics`, the context is ``torch.no_grad()``.
        others: Networks that gradients may flow through, but not into their parameters.
    """
    return frozen(*others) if getattr(objective, "through_dynamics", False) else torch.no_grad()


OBJECTIVES: dict[str, Objective] = {"reinforce": reinforce, "dynamics": dynamics, "clipped": clipped_surrogate}
"""Objectives by their names."""
ON_POLICY = ("clipped",)
"""Objectives of collected steps; the others are of imagined steps."""


def find_objective(name: str, collected: bool | None = None) -> Objective:
    """Return an objective by its name, or import your own, given as ``module:function``.

    Args:
        name: Name of the objective.
        collected: Whether it must be an objective of collected (True) or imagined (False) steps; None accepts both.

    Raises:
        ValueError: If there is no such objective, or it needs the other kind of steps.
    """
    if ":" in name:
        found = import_own(name, f"Objective {name!r}")
        if not callable(found):
            raise ValueError(f"Objective {name!r} is not a function of a Trajectory.")
        if collected and getattr(found, "through_dynamics", False):
            raise ValueError(f"loss.actor={name} needs imagination's gradient: use it with recipes/dreamer_v3.py.")
        return found
    if name not in OBJECTIVES:
        raise ValueError(
            f"Unknown objective {name!r}{suggestion(name, OBJECTIVES)}. Known objectives: {', '.join(OBJECTIVES)}. "
            "Give your own as module:function."
        )
    if collected is not None and collected is not (name in ON_POLICY):
        steps, takes = ("imagined", "dreamer_v3") if collected else ("collected", "latent_ppo")
        raise ValueError(f"loss.actor={name} learns from {steps} steps: use it with recipes/{takes}.py.")
    return OBJECTIVES[name]
