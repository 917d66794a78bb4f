"""Fewer kernels where a loop over time makes them by the thousand: the same functions, rounded elsewhere.

On a CUDA device a kernel takes some microseconds to launch, however little it does. What is here is chosen by the
learner (`LearnerConfig.few_kernels`); on a CPU, where it gains nothing, results stay bit for bit what they were.

Shape legend: N any one-dimensional batch, D belief, G blocks, W = D / G.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

UPDATE_SHIFT = 1.0
"""By which the update gate is lower, so that a fresh cell remembers rather than overwrites."""


def save_kernels(module: nn.Module) -> None:
    """Let all parts of a module that know how to do with fewer kernels do so."""
    for part in module.modules():
        if hasattr(part, "few_kernels"):
            part.few_kernels = True  # type: ignore[assignment]  # no tensor, nor a module


def gate_shift() -> Tensor:
    """Return what is subtracted from reset, candidate and update, ``(3, 1)``."""
    return torch.tensor([[0.0], [0.0], [UPDATE_SHIFT]])


class GatedUpdate(Function):
    """The GRU's step from its gates on: 5 kernels and 9 on the way back, where autograd's own take 7 and 14.

    ``apply(gates, shift, belief)`` takes gates ``(N, G, 3, W)`` in any type, in each block reset, candidate and update;
    ``gate_shift()`` in float32; and the belief, float32 ``(N, D)``. It returns the next belief, float32 ``(N, D)``.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, gates: Tensor, shift: Tensor, belief: Tensor) -> Tensor:
        """Return the next belief."""
        shifted = gates - shift  # in float32
        squashed = torch.sigmoid(shifted)
        candidate = torch.tanh(squashed[:, :, 0] * shifted[:, :, 1])  # (N, G, W)
        before = belief.view_as(candidate)
        ctx.save_for_backward(shifted, squashed, candidate, before)
        ctx.gate_type = gates.dtype  # type: ignore[attr-defined]  # torch lets a context hold anything
        return torch.lerp(before, candidate, squashed[:, :, 2]).flatten(1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, Tensor]:
        """Return the gradients of gates and belief."""
        shifted, squashed, candidate, before = ctx.saved_tensors
        gradient = gradient.view_as(candidate)
        of_candidate = gradient * squashed[:, :, 2]
        of_belief = (gradient - of_candidate).flatten(1)
        of_product = torch.ops.aten.tanh_backward(of_candidate, candidate)
        of_squashed = torch.empty_like(squashed)  # the candidate's place stays empty: it is not squashed
        torch.mul(of_product, shifted[:, :, 1], out=of_squashed[:, :, 0])
        torch.mul(gradient, candidate - before, out=of_squashed[:, :, 2])
        of_gates = torch.ops.aten.sigmoid_backward(of_squashed, squashed)
        torch.mul(of_product, squashed[:, :, 0], out=of_gates[:, :, 1])
        return of_gates.to(ctx.gate_type), None, of_belief
