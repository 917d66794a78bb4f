"""Heads on the latents: reward and continue heads, the two-hot distribution, the critic with its slow copy, the actor.

Shape legend: N any batch, F features, K bins, A action.
"""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dreamer_racing.modules.layers import NormedLinear, linear

_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
STD_SHIFT = 2.0
"""Shift of the network's raw output for a large initial standard deviation. Reference: ``heads.bounded_normal``."""
MIN_STD, MAX_STD = 0.1, 1.0
"""Bounds of the standard deviation. Reference: danijar/dreamerv3, ``configs.yaml``."""
FIRST_STD = 0.6
"""Initial standard deviation if it does not depend on the state, as in the PPO baseline [choice]."""


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
        layers: Number of hidden layers, as in all heads.
        units: Their width.
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
    """Categorical distribution over exponentially spaced bins, for rewards and returns of any scale.

    The bins are symexp of an even grid on [−20, 20]. A number is encoded as weights on its two neighbouring bins, whose
    weighted mean is the number; logits are decoded to the mean of the bins.

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
        """Map numbers ``(..., 1)`` to the indices of the two bins around each and their weights, ``(..., 2)`` each.

        Numbers beyond the outermost bins are clamped to them.
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
        # Subtract mirrored bins first: the bins reach 5e8, and uniform logits must still give exactly zero.
        difference = probabilities[..., half + 1 :] - probabilities[..., :half].flip(-1)
        # Not a matrix product: autocast would compute it in bfloat16, and so round every return.
        return (difference * self.values[half + 1 :]).sum(-1, keepdim=True)

    def cross_entropy(self, log_probabilities: Tensor, target: Tensor) -> Tensor:
        """Map log-softmaxes ``(..., K)`` and numbers ``(..., 1)`` to −Σ two_hot(target)·log p, nats ``(..., 1)``."""
        index, weight = self.encode(target)
        return -(log_probabilities.gather(-1, index) * weight).sum(-1, keepdim=True)


class TwoHotHead(nn.Module):
    """MLP whose output is a two-hot distribution over K ``bins``; its initial prediction is zero."""

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
    """MLP that predicts the logit of the probability that the episode continues after a record."""

    def __init__(self, in_features: int, layers: int, units: int, norm: str = "rms") -> None:
        super().__init__()
        self.mlp = MLP(in_features, 1, layers, units, norm)

    def forward(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to a logit ``(..., 1)``."""
        return self.mlp(features).float()

    def probability(self, features: Tensor) -> Tensor:
        """Map ``(..., F)`` to the probability ``(..., 1)``."""
        return torch.sigmoid(self(features))


class Critic(nn.Module):
    """Critic: predicts the distribution of the return, and has a slow copy, an exponential average of its weights.

    Reference: DreamerV3, "Critic learning"; the slow copy regularises the critic and does not compute its targets.
    """

    def __init__(self, in_features: int, layers: int, units: int, norm: str = "rms", bins: int = 255) -> None:
        super().__init__()
        self.head = TwoHotHead(in_features, layers, units, norm, bins)
        self.slow_head = copy.deepcopy(self.head).requires_grad_(False)

    @property
    def two_hot(self) -> TwoHot:
        """Distribution that the logits parametrise."""
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
        """Move the slow copy towards the critic: slow ← (1 − rate)·slow + rate·fast."""
        torch._foreach_lerp_(list(self.slow_head.parameters()), list(self.head.parameters()), rate)


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


class ActionDistribution(NamedTuple):
    """Independent normal distributions over the action's dimensions.

    Samples may leave [−1, 1]; the environment and the RSSM clip them. `log_prob` is that of the unclipped normal.

    Attributes:
        mean: ``(..., A)``, in [−1, 1].
        std: ``(..., A)``, in [min_std, max_std].
    """

    mean: Tensor
    std: Tensor

    def sample(self, noise: Tensor | None = None) -> Tensor:
        """Sample an action ``(..., A)``, differentiable in mean and std, from normal noise ``(..., A)`` if given."""
        return torch.addcmul(self.mean, self.std, torch.randn_like(self.mean) if noise is None else noise)

    def clipped_mean(self) -> Tensor:
        """Return the mean ``(..., A)`` of the samples clipped to [−1, 1], which is the deterministic policy's action.

        Near a bound, the average action in training is smaller than ``mean``, by 0.06 at a mean of 1 and a standard
        deviation of 0.15; an agent that has learned to fly close to a gate's frame depends on that difference
        (docs/what_we_know.md).
        """
        return clipped_mean(self.mean, self.std)

    def log_prob(self, action: Tensor) -> Tensor:
        """Return the log-density of an action ``(..., A)``, nats, ``(..., 1)``."""
        deviation = (action - self.mean) / self.std
        return -(0.5 * deviation.square() + self.std.log() + _LOG_SQRT_2PI).sum(-1, keepdim=True)

    def log_prob_clipped(self, action: Tensor) -> Tensor:
        """Return the log-probability of an action ``(..., A)`` after clipping to [−1, 1], nats, ``(..., 1)``.

        Between the bounds it is the normal's log-density, at a bound the log-probability of the tail beyond it.

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
    """Policy π(a | h, z): a normal distribution with mean tanh(·) and a bounded standard deviation.

    Args:
        in_features: F.
        action_dim: A.
        layers: As of `MLP`, like ``units`` and ``norm``.
        min_std: Smallest standard deviation; a buffer that may change during training.
        max_std: Largest standard deviation; likewise.
        state_std: Whether the standard deviation depends on the state; if not, it is one learned number for each
            dimension of the action, initially ``FIRST_STD``.

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
        self.shift = nn.Buffer(shift, persistent=False)  # added to the network's output by ``few_kernels``
        self.min_std = nn.Buffer(torch.tensor(float(min_std)))
        self.max_std = nn.Buffer(torch.tensor(float(max_std)))

    def forward(self, features: Tensor) -> ActionDistribution:
        """Map ``(..., F)`` to a distribution over actions ``(..., A)``."""
        output = self.mlp(features)
        output = output + self.shift if self.few_kernels else output.float()  # in float32
        if self.raw_std is None:
            mean, shifted = output.chunk(2, -1)
            shifted = shifted if self.few_kernels else shifted + STD_SHIFT
        else:
            mean, shifted = output, (self.raw_std + STD_SHIFT).expand_as(output)
        low, high, share = self.min_std, self.max_std, torch.sigmoid(shifted)
        std = torch.lerp(low, high, share) if self.few_kernels else (high - low) * share + low
        return ActionDistribution(torch.tanh(mean), std)
