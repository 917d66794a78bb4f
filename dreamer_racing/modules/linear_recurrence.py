"""Linear recurrence as a parallel scan: all T steps in log2(T) rounds of whole-tensor operations.

Shape legend: B batch, T time, D channels.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import FunctionCtx


def linear_recurrence(decay: Tensor, drive: Tensor) -> Tensor:
    """Compute ``h_t = decay_t · h_{t−1} + drive_t``, with h = 0 before the first step.

    Gradients equal those of the loop over T, and are computed by the same scan in reverse from decays and results only.

    Args:
        decay: In [0, 1], so that products of decays cannot overflow; 0 forgets the past. Float32 ``(B, T, D)``; the
            first step's decay has no effect.
        drive: Float32 ``(B, T, D)``.

    Returns:
        h of every step, ``(B, T, D)``.

    Example:
        >>> import torch
        >>> linear_recurrence(torch.tensor([[[0.5], [0.5], [0.0]]]), torch.ones(1, 3, 1)).flatten().tolist()
        [1.0, 1.5, 1.0]

    Reference: Blelloch 1990, "Prefix Sums and Their Applications" (recurrences as scans); Hillis & Steele 1986, "Data
    Parallel Algorithms" (the scan itself); Martin & Cundy 2018 (its gradient).
    """
    return _LinearRecurrence.apply(decay, drive)


def _scan(decay: Tensor, drive: Tensor) -> Tensor:
    """Return h of every step; each round doubles the number of steps that a drive and a decay cover."""
    decay, drive = decay.clone(), drive.clone()
    time, span = decay.shape[1], 1
    while span < time:
        drive[:, span:] += decay[:, span:] * drive[:, :-span]
        decay[:, span:] = decay[:, span:] * decay[:, :-span]
        span *= 2
    return drive


class _LinearRecurrence(Function):
    @staticmethod
    def forward(ctx: FunctionCtx, decay: Tensor, drive: Tensor) -> Tensor:
        result = _scan(decay, drive)
        ctx.save_for_backward(decay, result)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        decay, result = ctx.saved_tensors
        # Gradient of drive: g_t = gradient_t + decay_{t+1} · g_{t+1}, the same recurrence from the last step backwards.
        later = torch.cat((decay[:, 1:], torch.zeros_like(decay[:, :1])), 1)
        of_drive = _scan(later.flip(1), gradient.flip(1)).flip(1)
        before = torch.cat((torch.zeros_like(result[:, :1]), result[:, :-1]), 1)
        return of_drive * before, of_drive
