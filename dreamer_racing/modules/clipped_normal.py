"""Normal distributions of actions whose samples the race clips to [−1, 1].

Shape legend: A action.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def clipped_mean(mean: Tensor, std: Tensor) -> Tensor:
    """Return the mean of what the race gets: of the samples of a normal, each clipped to [−1, 1].

    A policy whose samples are clipped may put its own mean far beyond a bound, where it tells little: noise keeps what
    is flown below the bound. Clipped samples have their mean where the policy flies, and inside the bounds.

    Args:
        mean: of the normal, ``(..., A)``.
        std: its standard deviation, ``(..., A)`` or what goes with it, positive.

    Returns:
        ``(..., A)``, in [−1, 1].

    Example:
        >>> clipped_mean(torch.tensor([0.0, 1.0, 9.0]), torch.tensor(0.5))
        tensor([0.0000, 0.8005, 1.0000])
    """
    low, high = (-1.0 - mean) / std, (1.0 - mean) / std
    below, above = _share_below(low), _share_below(-high)
    return mean * (1.0 - below - above) + std * (_density(low) - _density(high)) + above - below


def _share_below(deviation: Tensor) -> Tensor:
    return 0.5 + 0.5 * torch.erf(deviation / math.sqrt(2.0))  # ONNX has no ndtr


def _density(deviation: Tensor) -> Tensor:
    return torch.exp(-0.5 * deviation.square()) / math.sqrt(2.0 * math.pi)
