"""Objectives of the policy: pure functions of the steps that it took, imagined or collected.

An objective takes a `Trajectory` and numbers, and returns a loss, a scalar, with metrics, scalars by name:

    def objective(trajectory, **numbers): return loss, {"name": metric}

Shape legend: H steps and N rollouts side by side, or of a shuffled minibatch one dimension M in place of both; F
features, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.modules.heads import ActionDistribution
from dreamer_racing.settings import import_own, suggestion


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


@dataclass(frozen=True)
class Trajectory:
    """Steps that a policy took, and what came of them; each ``(H, N, ...)``, or ``(M, ...)`` of a minibatch.

    Attributes:
        policy: The present policy at each step; its mean and standard deviation ``(H, N, A)`` carry the gradient.
        features: Belief and state that it saw, ``(H, N, F)``; without gradient.
        action: Taken there, ``(H, N, A)``: imagined ones are not clipped, collected ones are, to [−1, 1].
        previous_action: That led there, ``(H, N, A)``, clipped; zero where an episode begins.
        behavior: The policy that took the action; of imagined steps the present one, without gradient.
        lambda_return: From the step on, ``(H, N, 1)``; carries gradient where it comes through the dynamics.
        value: Expected there, ``(H, N, 1)``.
        advantage: λ-return less value, ``(H, N, 1)``: of imagined steps in units of ``scale``, of collected ones with
            mean 0 and standard deviation 1.
        weight: What a step counts for, ``(H, N, 1)``: the discounted probability of getting there.
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
        """Return the mean over the steps ``(H, N, 1)``, by what they count for, a scalar."""
        return (self.weight * values).mean()

    def action_change(self) -> Tensor:
        """Return the mean square ‖μₜ − μₜ₋₁‖² by which the policy's mean changes from step to step, a scalar.

        For steps in order, ``(H, N, ...)``; the first, which follows none here, counts 0. It is of means, not of
        samples: noise shall not be held on to.

        Reference: Mysore et al. 2021, "Regularizing action policies for smooth control with reinforcement learning",
        temporal smoothness; squared here, as changes of action are in the reward (b₃).
        """
        mean, weight = self.policy.mean, self.weight
        change = (mean[1:] - mean[:-1]).square().sum(-1, keepdim=True)
        return (weight[1:] * change).sum() / weight.numel()


Objective = Callable[..., tuple[Tensor, dict[str, Tensor]]]
"""What a policy minimises: ``(trajectory, **numbers)`` to a loss and metrics of it, scalars."""
Function = TypeVar("Function", bound=Callable)


def through_dynamics(objective: Function) -> Function:
    """Mark an objective that needs the gradient of returns through the imagined dynamics."""
    objective.through_dynamics = True  # type: ignore[attr-defined]  # functions take attributes
    return objective


def reinforce(trajectory: Trajectory, *, entropy_scale: Tensor, **numbers: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Reinforce the actions that did better than the critic expected.

    ``−weight · (log π(a) · advantage + entropy_scale · H[π])``, without gradient through the advantage.

    Reference: DreamerV3, Eq. 11.
    """
    policy, entropy = trajectory.policy, trajectory.policy.entropy()
    objective = policy.log_prob(trajectory.action) * trajectory.advantage + entropy_scale * entropy
    return -trajectory.mean(objective), {"entropy": entropy.detach().mean()}


@through_dynamics
def dynamics(trajectory: Trajectory, *, entropy_scale: Tensor, **numbers: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Climb the gradient of the λ-returns through the imagined dynamics.

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
    """Make better actions likelier and worse ones less so, as far as the ratio to the policy that took them allows.

    ``−weight · (min(r·advantage, clip(r, 1 ± ε)·advantage) + entropy_scale · H[π])``, where r is the ratio of new to
    old probability of the clipped action.

    Reference: Schulman et al. 2017, "Proximal policy optimization algorithms", Eq. 7.
    """
    policy, behavior, action = trajectory.policy, trajectory.behavior, trajectory.action
    ratio = (policy.log_prob_clipped(action) - behavior.log_prob_clipped(action)).exp()
    bounded = ratio.clamp(1.0 - clip_epsilon, 1.0 + clip_epsilon)
    gain = torch.minimum(ratio * trajectory.advantage, bounded * trajectory.advantage)
    clipped = ((ratio.detach() - 1.0).abs() > clip_epsilon).float().mean()
    return -trajectory.mean(gain + entropy_scale * policy.entropy()), {"ppo/clipped": clipped}


def policy_drift(actor: nn.Module, before: Tensor, after: Tensor, weight: Tensor) -> Tensor:
    """Measure how far the policy moves because the world model's latents do; trains the world model, not the actor.

    To an actor that has become precise, latents that move are another policy: by a nat and more between two visits of
    a record. What is minimised is the divergence of the policy at a record's latents as the model makes them now from
    the policy at those that were stored, so that they may move wherever the actor does not look. Latents that are drawn
    differ by the draw already: it is for those that are not.

    Args:
        actor: The policy.
        before: Features of the stored latents, ``(..., F)``.
        after: Of the model's own, which carry gradient, ``(..., F)``.
        weight: What a record counts for, ``(..., 1)``.

    Returns:
        The divergence, nats, a scalar: the weighted mean over all records, as every loss is, so that several processes
        average to the joint batch's.

    Reference: Cobbe et al. 2021, "Phasic policy gradient", the cloning term of Eq. 4; there the policy's own network
    moves, too.
    """
    with torch.no_grad():
        old = actor(before)
    with frozen(actor):
        drift = old.divergence(actor(after))
    return (weight * drift).mean()


def normalized(advantage: Tensor, weight: Tensor) -> Tensor:
    """Return advantages ``(..., 1)`` with mean 0 and deviation 1, over all processes, under weights ``(..., 1)``."""
    share = weight / parallel.total(weight.sum()).clamp_min(1e-8)
    mean = parallel.total((share * advantage).sum())
    deviation = parallel.total((share * (advantage - mean).square()).sum()).sqrt()
    return (advantage - mean) / (deviation + 1e-8)


def gradient_of_actions(objective: Objective, *others: nn.Module) -> AbstractContextManager:
    """Return the context in which a rollout is imagined for an objective.

    Args:
        objective: Without the mark of `through_dynamics` nothing flows back through the rollout.
        others: Networks that gradient may flow through, but not into.
    """
    return frozen(*others) if getattr(objective, "through_dynamics", False) else torch.no_grad()


OBJECTIVES: dict[str, Objective] = {"reinforce": reinforce, "dynamics": dynamics, "clipped": clipped_surrogate}
"""Objectives by their names."""
OF_COLLECTED = ("clipped",)
"""Those of collected steps; the others are of imagined ones."""

GONE = {
    "ppo": "PPO learns from what was collected, by the algorithm latent_ppo",
    "flown_ppo": "its critic learns from what was collected, too, by the algorithm latent_ppo",
    "latent_ppo": "it is an algorithm of its own now, recipes/latent_ppo.py loss.critic=latent",
    "asymmetric_ppo": "it is an algorithm of its own now, recipes/latent_ppo.py loss.critic=state",
}
"""Actors that there were, and what there is instead."""


def find_objective(name: str, collected: bool | None = None) -> Objective:
    """Return the objective of a name, or one of your own, given as ``module:function``.

    Args:
        name: Of the objective.
        collected: Whether it is to be of collected steps, or else of imagined ones; None: of either.

    Raises:
        ValueError: If there is none, or it is of the other steps; the message lists those that there are, or says where
            a module was looked for, or which algorithm takes it.
    """
    if ":" in name:
        found = import_own(name, f"Objective {name!r}")
        if not callable(found):
            raise ValueError(f"Objective {name!r} is no function of a Trajectory.")
        return found
    if name in GONE:
        raise ValueError(f"The actor {name!r} is gone: {GONE[name]}.")
    if name not in OBJECTIVES:
        raise ValueError(
            f"Unknown objective {name!r}{suggestion(name, OBJECTIVES)}. Known here: {', '.join(OBJECTIVES)}; one of "
            "your own is given as module:function."
        )
    if collected is not None and collected is not (name in OF_COLLECTED):
        steps, takes = ("imagined", "dreamer_v3") if collected else ("collected", "latent_ppo")
        raise ValueError(f"loss.actor={name} learns from {steps} steps: recipes/{takes}.py takes it.")
    return OBJECTIVES[name]
