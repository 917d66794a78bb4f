"""Ways to launch fewer kernels in loops over time: the same functions with different rounding.

On a CUDA device the launch of a kernel takes some microseconds, however little it computes. The learner turns these
variants on (`LearnerConfig.few_kernels`); by default they are off on a CPU, where they gain nothing.

Autocast casts a weight at every use: imagination alone launches one cast for every weight in each step. Here one kernel
casts all weights, and another casts their gradients back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

from dreamer_racing.modules.layers import BlockLinear, LayerNorm, RMSNorm, replaced

LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, BlockLinear, LayerNorm, RMSNorm)
"""Layers whose weights, biases and gains are cast; all other parameters stay in float32."""


def use_few_kernels(module: nn.Module) -> None:
    """Turn on ``few_kernels`` in all submodules that have it."""
    for part in module.modules():
        if hasattr(part, "few_kernels"):
            part.few_kernels = True  # type: ignore[assignment]  # no tensor, nor a module


@contextmanager
def cast_once(module: nn.Module, dtype: torch.dtype) -> Iterator[None]:
    """Make the layers of a module use casted copies of their parameters; gradients flow to the originals.

    Autocast then only has to cast activations. If a parameter is used several times, its gradients are summed in the
    type of the copies.
    """
    layers = {layer: None for layer in module.modules() if isinstance(layer, LAYERS)}
    held = [(layer, name, p) for layer in layers for name, p in layer._parameters.items() if p is not None]
    with replaced(held, _Cast.apply(dtype, *(parameter for _, _, parameter in held))):
        yield


class _Cast(Function):
    """Casts many tensors with one kernel."""

    @staticmethod
    def forward(ctx: FunctionCtx, dtype: torch.dtype, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        return tuple(_cast(tensors, dtype))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        there = [gradient for gradient in gradients if gradient is not None]
        cast = iter(_cast(there, torch.float32))
        return None, *(None if gradient is None else next(cast) for gradient in gradients)


def _cast(tensors: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    copies = [torch.empty_like(tensor, dtype=dtype) for tensor in tensors]
    if copies:
        torch._foreach_copy_(copies, list(tensors))
    return copies
