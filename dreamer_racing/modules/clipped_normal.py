"""Normal distributions of actions whose samples the environment clips to [−1, 1].

Shape legend: A action.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def clipped_mean(mean: Tensor, std: Tensor) -> Tensor:
    """Return the mean of normal samples that are clipped to [−1, 1].

    The mean of the unclipped normal may lie far beyond a bound, and then says little about the actions: even near a
    bound, noise keeps the average clipped sample inside it. The clipped mean is the average action in training.

    Args:
        mean: Mean of the normal, ``(..., A)``.
        std: Positive standard deviation, ``(..., A)`` or of a shape that broadcasts with it.

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
