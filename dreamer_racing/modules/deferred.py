"""Weight gradients of layers inside a time loop: one matrix product after the loop, not one product and sum a step.

Backpropagation through T steps adds T products of thin matrices to a gradient as large as the weight, so that memory
traffic, not arithmetic, takes the time. Here each step only keeps its input and the gradient of its output.

Shape legend: N batch of a step, I input features, O output features.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import FunctionCtx


class Tape:
    """Input ``(..., N, I)`` and gradient of the output ``(..., N, O)`` of every step that a backward pass reaches."""

    def __init__(self) -> None:
        self._steps: list[tuple[Tensor, Tensor]] = []
        self._backward_pass = -1

    def add(self, inputs: Tensor, gradient: Tensor) -> None:
        """Keep one step; forget those of a backward pass that did not ask for the weight's gradient."""
        backward_pass = torch._C._current_graph_task_id()
        if backward_pass != self._backward_pass:
            self._steps.clear()
            self._backward_pass = backward_pass
        self._steps.append((inputs, gradient))

    def take(self) -> tuple[Tensor, Tensor] | None:
        """Return all inputs and all gradients, ``(..., T·N, I)`` and ``(..., T·N, O)``, and forget them."""
        if not self._steps:
            return None
        inputs, gradients = (torch.cat(tensors, -2) for tensors in zip(*self._steps, strict=True))
        self._steps.clear()
        return inputs, gradients


class DeferredWeight:
    """A weight for the steps of one loop; its gradient comes when all of them have passed theirs back.

    Under autocast the weight is cast once, not at every step.

    Args:
        weight: ``(I, O)``, or ``(G, I, O)`` for a batched product.
        bias: ``(O,)`` or ``(G, 1, O)``; or None.
    """

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        self._dtype = autocast_type(weight.device.type) or weight.dtype
        self._tape = Tape()
        self.has_bias = bias is not None
        cast = None if bias is None else bias.to(self._dtype)
        self._weight, self._bias = _Collect.apply(weight.to(self._dtype), cast, self._tape)

    def product(self, inputs: Tensor, base: Tensor | None = None) -> Tensor:
        """Map ``(..., N, I)`` to ``(..., N, O)``; where there is no bias, a base ``(N, O)`` may be added."""
        if base is not None:
            return _Sum.apply(base.to(self._dtype), inputs.to(self._dtype), self._weight, self._tape)
        return _Product.apply(inputs.to(self._dtype), self._weight, self._bias, self._tape)


def autocast_type(device_type: str) -> torch.dtype | None:
    """Return the type that autocast computes in on a kind of device; None where it is off."""
    if not torch.amp.is_autocast_available(device_type) or not torch.is_autocast_enabled(device_type):
        return None
    return torch.get_autocast_dtype(device_type)


class _Collect(Function):
    """Hands out the weight; at the end of the backward pass, multiplies what the steps have kept."""

    @staticmethod
    def forward(ctx: FunctionCtx, weight: Tensor, bias: Tensor | None, tape: Tape) -> tuple[Tensor, Tensor | None]:
        ctx.set_materialize_grads(False)
        ctx.tape = tape  # type: ignore[attr-defined]  # torch lets a context hold anything
        return weight.view_as(weight), None if bias is None else bias.view_as(bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        # The steps pass nothing back to the weight itself, but autograd calls this after the last of them.
        taken = ctx.tape.take()
        if taken is None:
            return None, None, None
        inputs, outputs = taken
        of_bias = outputs.sum(-2, keepdim=outputs.ndim == 3) if ctx.needs_input_grad[1] else None
        return inputs.mT @ outputs, of_bias, None


class _Product(Function):
    """One step."""

    @staticmethod
    def forward(ctx: FunctionCtx, inputs: Tensor, weight: Tensor, bias: Tensor | None, tape: Tape) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        ctx.tape = tape  # type: ignore[attr-defined]  # torch lets a context hold anything
        if bias is None:
            return inputs @ weight
        return (torch.addmm if weight.ndim == 2 else torch.baddbmm)(bias, inputs, weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, weight = ctx.saved_tensors
        ctx.tape.add(inputs, gradient)
        return gradient @ weight.mT if ctx.needs_input_grad[0] else None, None, None, None


class _Sum(Function):
    """One step, added to something."""

    @staticmethod
    def forward(ctx: FunctionCtx, base: Tensor, inputs: Tensor, weight: Tensor, tape: Tape) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        ctx.tape = tape  # type: ignore[attr-defined]  # torch lets a context hold anything
        return torch.addmm(base, inputs, weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, weight = ctx.saved_tensors
        ctx.tape.add(inputs, gradient)
        return gradient, gradient @ weight.mT if ctx.needs_input_grad[1] else None, None, None
