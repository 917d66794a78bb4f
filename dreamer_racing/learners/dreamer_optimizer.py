"""The optimiser of a `DreamerLearner`: what is trained, at which rate, and how large its gradients are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.objectives import LossModule

from dreamer_racing.learners.dreamer_config import LearnerConfig
from dreamer_racing.losses import ActorLoss
from dreamer_racing.modules.agent import Agent

ParameterGroups = list[dict[str, Any]]
"""Parameters with their learning rates: ``[{"params": [...], "lr": ...}, ...]``."""


def make_optimizer(agent: Agent, losses: Mapping[str, LossModule], config: LearnerConfig) -> torch.optim.Optimizer:
    """Make the 2025 reference's optimiser, LaProp with adaptive gradient clipping.

    Its first group is the world model, its second actor and critic, each with what their losses have of their own; an
    actor that its loss steps is in none.
    """
    from torchrl.trainers.algorithms import DreamerV3Optimizer

    networks = trained_parameters(agent, losses)
    rate = config.learning_rate
    stepped_by_loss = isinstance(loss := losses["actor"], ActorLoss) and loss.optimizer is not None
    actor = [] if stepped_by_loss else networks["actor"]
    groups: ParameterGroups = [
        {"params": networks["world_model"], "lr": rate},
        {"params": actor + networks["critic"], "lr": config.behavior_learning_rate or rate},
    ]
    return DreamerV3Optimizer(groups, lr=rate, warmup_steps=config.warmup_updates)


def trained_parameters(agent: Agent, losses: Mapping[str, LossModule]) -> dict[str, list[nn.Parameter]]:
    """Return the parameters of each network, with those that its loss has of its own."""
    networks = dict(agent.named_children())
    shared = set(agent.parameters())
    own = {name: [p for p in loss.parameters() if p not in shared] for name, loss in losses.items()}
    return {
        name: [p for p in (*network.parameters(), *own[name]) if p.requires_grad] for name, network in networks.items()
    }


def gradient_norms(networks: Mapping[str, list[nn.Parameter]]) -> dict[str, Tensor]:
    """Return the global norm of each network's gradient, a scalar, as ``gradient_norm/<network>``; none without one.

    Args:
        networks: Parameters of each, as `trained_parameters` returns them.
    """
    gradients = {name: [p.grad for p in parameters if p.grad is not None] for name, parameters in networks.items()}
    # A network has none where its loss steps it alone.
    return {f"gradient_norm/{name}": nn.utils.get_total_norm(found) for name, found in gradients.items() if found}


def restore(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimiser's state, but not its settings: a run may go on with other rates, or on another device."""
    names = {"lr", "warmup_steps", "fused"}
    own = [{name: value for name, value in group.items() if name in names} for group in optimizer.param_groups]
    groups = [{**group, **settings} for group, settings in zip(state["param_groups"], own, strict=True)]
    optimizer.load_state_dict({**state, "param_groups": groups})
