"""Prediction heads and the two-hot distribution.

Shape legend: N any batch, F features, K bins.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from dreamer_racing.modules.layers import NormedLinear, linear


def symlog(values: Tensor) -> Tensor:
    """Return sign(x)·ln(1 + |x|)."""
    return values.sign() * values.abs().log1p()


def symexp(values: Tensor) -> Tensor:
    """Return sign(x)·(exp|x| − 1), the inverse of ``symlog``."""
    return values.sign() * values.abs().expm1()


class MLP(nn.Module):
    """Hidden layers with normalisation and SiLU, then a linear output.

    Args:
        in_features: F.
        out_features: Width of the output.
        layers: Number of hidden layers.
        units: Width of the hidden layers.
        norm: ``"rms"`` or ``"layer"``.
        output_scale: Multiplier of the output layer's initial weights; 0 makes the first outputs zero.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        layers: int,
        units: int,
        norm: str = "rms",
        output_scale: float = 1.0,
    ) -> None:
        super().__init__()
        widths = [in_features] + [units] * layers
        self.hidden = nn.Sequential(*(NormedLinear(before, after, norm) for before, after in pairwise(widths)))
        self.output = linear(widths[-1], out_features, scale=output_scale)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(..., F)`` to ``(..., out_features)``."""
        return self.output(self.hidden(inputs))


class TwoHot(nn.Module):
    """Categorical distribution over exponentially spaced values, for rewards and returns of any scale.

    The bins are symexp of an even grid on [−20, 20]. A number is encoded as weights on its two neighbouring bins whose
    mean is the number; logits are decoded to the mean of the bins.

    Args:
        bins: K, odd, so that the middle bin is 0.

    Example:
        >>> import torch
        >>> two_hot = TwoHot(255)
        >>> two_hot.decode(torch.zeros(1, 255))
        tensor([[0.]])

    Reference: DreamerV3, Eq. 8-10; danijar/dreamerv3, ``outs.TwoHot``.
    """

    limit = 20.0

    def __init__(self, bins: int = 255) -> None:
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"TwoHot needs an odd number of at least 3 bins, got {bins}")
        positive = symexp(torch.linspace(0.0, self.limit, bins // 2 + 1))
        # Mirrored rather than computed, so that the bins are exactly antisymmetric.
        self.values: Tensor
        self.register_buffer("values", torch.cat((-positive[1:].flip(0), positive)), persistent=False)

    def encode(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """Find the two bins around each number and their weights.

        Args:
            target: Numbers, ``(..., 1)``; those beyond the outermost bins are clamped to them.

        Returns:
            Bin indices, int64 ``(..., 2)``, and weights that sum to 1, ``(..., 2)``.
        """
        target = target.clamp(self.values[0], self.values[-1])
        upper = torch.searchsorted(self.values, target.contiguous()).clamp_(1, len(self.values) - 1)
        index = torch.cat((upper - 1, upper), -1)
        below, above = self.values[index].split(1, -1)
        weight = (target - below) / (above - below)
        return index, torch.cat((1 - weight, weight), -1)

    def decode(self, logits: Tensor) -> Tensor:
        """Return the distribution's mean ``(..., 1)`` from logits ``(..., K)``."""
        probabilities = logits.softmax(-1)
        half = self.values.shape[0] // 2
        # Mirrored bins are subtracted first: the bins reach 5e8, and uniform logits must still give exactly zero.
        difference = probabilities[..., half + 1 :] - probabilities[..., :half].flip(-1)
        # Not a matrix product, which autocast would round to bfloat16, and with it every return.
        return (difference * self.values[half + 1 :]).sum(-1, keepdim=True)

    def cross_entropy(self, log_probabilities: Tensor, target: Tensor) -> Tensor:
        """Return −Σ two_hot(target)·log p.

        Args:
            log_probabilities: Log-softmax of the logits, ``(..., K)``.
            target: Numbers, ``(..., 1)``.

        Returns:
            Loss, nats, ``(..., 1)``.
        """
        index, weight = self.encode(target)
        return -(log_probabilities.gather(-1, index) * weight).sum(-1, keepdim=True)


class TwoHotHead(nn.Module):
    """MLP whose output is a two-hot distribution; its first prediction is zero.

    Args:
        in_features: F.
        layers: Number of hidden layers.
        units: Width of the hidden layers.
        norm: ``"rms"`` or ``"layer"``.
        bins: K.
    """

    def __init__(self, in_features: int, layers: int, units: int, norm: str = "rms", bins: int = 255) -> None:
        super().__init__()
        self.mlp = MLP(in_features, bins, layers, units, norm, output_scale=0.0)
        self.two_hot = TwoHot(bins)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to logits ``(..., K)``."""
        return self.mlp(features).float()

    def mean(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to the mean ``(..., 1)``."""
        return self.two_hot.decode(self(features))


class ContinueHead(nn.Module):
    """MLP whose output is the logit of "the episode goes on after this record"."""

    def __init__(self, in_features: int, layers: int, units: int, norm: str = "rms") -> None:
        super().__init__()
        self.mlp = MLP(in_features, 1, layers, units, norm)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to a logit ``(..., 1)``."""
        return self.mlp(features).float()

    def probability(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to the probability ``(..., 1)``."""
        return torch.sigmoid(self(features))
