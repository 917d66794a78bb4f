"""Fewer kernels where a loop over time makes them by the thousand: the same functions, rounded elsewhere.

On a CUDA device a kernel takes some microseconds to launch, however little it does. What is here is chosen by the
learner (`LearnerConfig.few_kernels`); on a CPU, where it gains nothing, results stay bit for bit what they were.

Autocast casts a weight each time that a layer uses it: imagination alone makes a kernel for every weight in each of its
steps. Here all weights are cast by one kernel, and their gradients back by another.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

from dreamer_racing.modules.layers import BlockLinear, LayerNorm, RMSNorm

LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, BlockLinear, LayerNorm, RMSNorm)
"""Those whose weights, biases and gains are cast; what else is learned stays in float32."""


def save_kernels(module: nn.Module) -> None:
    """Let all parts of a module that know how to do with fewer kernels do so."""
    for part in module.modules():
        if hasattr(part, "few_kernels"):
            part.few_kernels = True  # type: ignore[assignment]  # no tensor, nor a module


@contextmanager
def cast_once(module: nn.Module, dtype: torch.dtype) -> Iterator[None]:
    """Let the layers of a module compute with copies of their parameters, through which gradients reach these.

    Where a parameter is used several times, its gradients are added up in the type of the copies.

    Args:
        module: Under autocast, which then has nothing left to cast but activations.
        dtype: Of the copies.
    """
    layers = {layer: None for layer in module.modules() if isinstance(layer, LAYERS)}
    held = [(layer, name, p) for layer in layers for name, p in layer._parameters.items() if p is not None]
    copies = _Cast.apply(dtype, *(parameter for _, _, parameter in held))
    # Not by assignment, which takes nothing but parameters in the place of a parameter.
    for (layer, name, _), copy in zip(held, copies, strict=True):
        layer._parameters[name] = copy
    try:
        yield
    finally:
        for layer, name, parameter in held:
            layer._parameters[name] = parameter


class _Cast(Function):
    """Casts many tensors by one kernel."""

    @staticmethod
    def forward(ctx: FunctionCtx, dtype: torch.dtype, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        return tuple(_cast(tensors, dtype))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        there = [gradient for gradient in gradients if gradient is not None]
        cast = iter(_cast(there, torch.float32))
        return None, *(None if gradient is None else next(cast) for gradient in gradients)


def _cast(tensors: list[Tensor] | tuple[Tensor, ...], dtype: torch.dtype) -> list[Tensor]:
    copies = [torch.empty_like(tensor, dtype=dtype) for tensor in tensors]
    if copies:
        torch._foreach_copy_(copies, list(tensors))
    return copies
