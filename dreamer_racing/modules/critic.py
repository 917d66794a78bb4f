"""Two-hot critic and its slowly moving copy.

Shape legend: N any batch, F features, K bins.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from dreamer_racing.modules.heads import TwoHot, TwoHotHead


class Critic(nn.Module):
    """Distribution of the return from belief and state, with an exponential moving average of its own weights.

    Args:
        in_features: F.
        layers: Number of hidden layers.
        units: Width of the hidden layers.
        norm: ``"rms"`` or ``"layer"``.
        bins: K.

    Reference: DreamerV3, "Critic learning"; the slow copy regularises the critic, it is not the target.
    """

    def __init__(self, in_features: int, layers: int, units: int, norm: str = "rms", bins: int = 255) -> None:
        super().__init__()
        self.head = TwoHotHead(in_features, layers, units, norm, bins)
        self.slow_head = copy.deepcopy(self.head).requires_grad_(False)

    @property
    def two_hot(self) -> TwoHot:
        """The distribution that the logits describe."""
        return self.head.two_hot

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to logits ``(..., K)``."""
        return self.head(features)

    def value(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to the expected return ``(..., 1)``."""
        return self.head.mean(features)

    @torch.no_grad()
    def slow_value(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to the slow copy's expected return ``(..., 1)``, without gradient."""
        return self.slow_head.mean(features)

    @torch.no_grad()
    def update_slow(self, rate: float) -> None:
        """Move the slow copy towards the critic: slow ← (1 − rate)·slow + rate·fast.

        Args:
            rate: Fraction moved, in (0, 1].
        """
        torch._foreach_lerp_(list(self.slow_head.parameters()), list(self.head.parameters()), rate)
