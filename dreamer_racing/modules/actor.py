"""Continuous actor.

Shape legend: N any batch, F features, A action.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dreamer_racing.modules.clipped_normal import clipped_mean
from dreamer_racing.modules.heads import MLP

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
STD_SHIFT = 2.0
"""What is added to the raw deviation, so that a fresh network's is large. Reference: ``heads.bounded_normal``."""
MIN_STD, MAX_STD = 0.1, 1.0
"""Bounds of the deviation. Reference: danijar/dreamerv3, ``configs.yaml``."""
FIRST_STD = 0.6
"""Deviation to begin with where it does not depend on the state, as the PPO baseline's [choice]."""


class ActionDistribution(NamedTuple):
    """Independent normal distributions over the action's dimensions.

    Samples may leave [−1, 1]: the environment and the RSSM clip them, and the log-probability is that of the normal.

    Attributes:
        mean: ``(..., A)``, in [−1, 1].
        std: ``(..., A)``, in [min_std, max_std].
    """

    mean: Tensor
    std: Tensor

    def sample(self, noise: Tensor | None = None) -> Tensor:
        """Draw an action ``(..., A)``, differentiable in mean and std; by normal noise ``(..., A)`` if it is given."""
        return torch.addcmul(self.mean, self.std, torch.randn_like(self.mean) if noise is None else noise)

    def clipped_mean(self) -> Tensor:
        """Return the mean ``(..., A)`` of the actions that an environment gets: of the samples, clipped to [−1, 1].

        It is what the deterministic policy flies. Near a bound, noise keeps what is practised below ``mean``, by 0.06
        at 1 with a deviation of 0.15, and an agent that has learned to fly a gate's width from its frame knows no
        other flight (docs/what_we_know.md).
        """
        return clipped_mean(self.mean, self.std)

    def log_prob(self, action: Tensor) -> Tensor:
        """Return the log-density of an action ``(..., A)``, nats, ``(..., 1)``."""
        deviation = (action - self.mean) / self.std
        return -(0.5 * deviation.square() + self.std.log() + _LOG_SQRT_2PI).sum(-1, keepdim=True)

    def log_prob_clipped(self, action: Tensor) -> Tensor:
        """Return the log-probability of what is left of an action ``(..., A)`` clipped to [−1, 1], nats, ``(..., 1)``.

        Between the bounds it is the density of the normal, at a bound the probability of all that lies beyond it.

        Reference: Fujita & Maeda 2018, "Clipped action policy gradient", Eq. 5.
        """
        deviation = (action - self.mean) / self.std
        inside = -(0.5 * deviation.square() + self.std.log() + _LOG_SQRT_2PI)
        # Below −1 lies Φ((−1 − mean) / std), above 1 Φ((mean − 1) / std).
        beyond = torch.special.log_ndtr(torch.where(action < 0, deviation, -deviation))
        return torch.where(action.abs() < 1.0, inside, beyond).sum(-1, keepdim=True)

    def divergence(self, other: ActionDistribution) -> Tensor:
        """Return KL(self ‖ other), nats, ``(..., 1)``."""
        variances = (self.std.square() + (self.mean - other.mean).square()) / (2.0 * other.std.square())
        return (other.std.log() - self.std.log() + variances - 0.5).sum(-1, keepdim=True)

    def entropy(self) -> Tensor:
        """Return the differential entropy Σ ln(σ√(2πe)), nats, ``(..., 1)``."""
        return (self.std.log() + (0.5 + _LOG_SQRT_2PI)).sum(-1, keepdim=True)


class Actor(nn.Module):
    """Policy π(a | h, z): a normal of mean tanh(·) and of a standard deviation between two bounds.

    Args:
        in_features: F.
        action_dim: A.
        layers: Number of hidden layers.
        units: Width of the hidden layers.
        norm: ``"rms"`` or ``"layer"``.
        min_std: Smallest standard deviation; a scalar that may change while the actor is trained.
        max_std: Largest standard deviation; likewise.
        state_std: Whether the deviation depends on the state; if not, it is a learned number for each dimension of the
            action, ``FIRST_STD`` to begin with.

    Reference: danijar/dreamerv3, ``heads.bounded_normal``: std = lo + (hi − lo)·sigmoid(raw + 2).
    """

    def __init__(
        self,
        in_features: int,
        action_dim: int,
        layers: int,
        units: int,
        norm: str = "rms",
        min_std: float = MIN_STD,
        max_std: float = MAX_STD,
        state_std: bool = True,
    ) -> None:
        super().__init__()
        self.mlp = MLP(in_features, (1 + state_std) * action_dim, layers, units, norm, output_scale=0.01)
        first = torch.tensor((FIRST_STD - min_std) / max(max_std - min_std, 1e-6)).clamp(0.01, 0.99).logit()
        self.raw_std = None if state_std else nn.Parameter((first - STD_SHIFT).repeat(action_dim))
        self.few_kernels = False
        self.action_dim = action_dim
        shift = torch.tensor([0.0, STD_SHIFT] if state_std else [0.0]).repeat_interleave(action_dim)
        self.shift = nn.Buffer(shift, persistent=False)  # of the network's output
        self.min_std = nn.Buffer(torch.tensor(float(min_std)))
        self.max_std = nn.Buffer(torch.tensor(float(max_std)))

    def forward(self, features: Tensor) -> ActionDistribution:
        """Map ``(..., F)`` to a distribution over actions ``(..., A)``."""
        if self.few_kernels:
            return self._with_few_kernels(self.mlp(features))
        output = self.mlp(features).float()
        mean, raw_std = output.chunk(2, -1) if self.raw_std is None else (output, self.raw_std.expand_as(output))
        std = (self.max_std - self.min_std) * torch.sigmoid(raw_std + STD_SHIFT) + self.min_std
        return ActionDistribution(torch.tanh(mean), std)

    def _with_few_kernels(self, output: Tensor) -> ActionDistribution:
        """Do what ``forward`` does behind the network, whose output ``(..., 2·A)`` or ``(..., A)`` is in any type."""
        output = output + self.shift  # in float32
        mean, shifted = output.chunk(2, -1) if self.raw_std is None else (output, self._shifted_std(output))
        return ActionDistribution(torch.tanh(mean), torch.lerp(self.min_std, self.max_std, torch.sigmoid(shifted)))

    def _shifted_std(self, like: Tensor) -> Tensor:
        assert self.raw_std is not None
        return (self.raw_std + STD_SHIFT).expand_as(like)
