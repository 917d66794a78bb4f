"""The optimiser of a world model and what learns beside it: what is trained, at which rate, how large gradients are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn


def make_optimizer(groups: list[dict[str, Any]], warmup_updates: int) -> torch.optim.Optimizer:
    """Make the 2025 reference's optimiser, LaProp with adaptive gradient clipping.

    Args:
        groups: Parameters with their learning rates: ``[{"params": [...], "lr": ...}, ...]``.
        warmup_updates: Updates over which the rates rise from zero.
    """
    from torchrl.trainers.algorithms import DreamerV3Optimizer

    return DreamerV3Optimizer(groups, lr=groups[0]["lr"], warmup_steps=warmup_updates)


def gradient_norms(networks: Mapping[str, list[nn.Parameter]]) -> dict[str, Tensor]:
    """Return the global norm of each network's gradient, a scalar, as ``gradient_norm/<network>``; none without one.

    Args:
        networks: Parameters of each, by its name.
    """
    gradients = {name: [p.grad for p in parameters if p.grad is not None] for name, parameters in networks.items()}
    return {f"gradient_norm/{name}": nn.utils.get_total_norm(found) for name, found in gradients.items() if found}


def restore(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimiser's state, but not its settings: a run may go on with other rates, or on another device."""
    names = {"lr", "warmup_steps", "fused"}
    own = [{name: value for name, value in group.items() if name in names} for group in optimizer.param_groups]
    groups = [{**group, **settings} for group, settings in zip(state["param_groups"], own, strict=True)]
    optimizer.load_state_dict({**state, "param_groups": groups})
