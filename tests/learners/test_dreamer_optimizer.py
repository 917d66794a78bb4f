"""What a learner's optimiser is told, and what is read off its gradients."""

from __future__ import annotations

import torch
from torch import nn

from dreamer_racing.learners.dreamer_optimizer import gradient_norms


def test_norms_are_of_all_gradients_of_a_network_and_of_none_without():
    stepped, still = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(1))
    stepped.grad = torch.tensor([3.0, 4.0])
    other = nn.Parameter(torch.zeros(1))
    other.grad = torch.tensor([12.0])
    norms = gradient_norms({"world_model": [stepped, still, other], "actor": [still]})
    assert {name: norm.item() for name, norm in norms.items()} == {"gradient_norm/world_model": 13.0}
