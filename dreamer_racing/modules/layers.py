"""Building blocks of all networks: initialisation, normalisation, linear layers, and what makes time loops cheaper.

Ordinary backpropagation through T steps adds T products of thin matrices to a gradient as large as the weight, so
memory traffic takes more time than arithmetic. Here (`unrolled`) each step of a time loop only stores its input and the
gradient of its output, and one matrix product after the loop computes the weight's gradient.

On a CUDA device the launch of a kernel takes some microseconds, however little it computes, and autocast casts a weight
at every use: imagination alone launches one cast for every weight in each step. `cast_once` casts all weights with one
kernel, and their gradients back with another. The learner turns it and the modules' ``few_kernels`` on
(`LearnerConfig.few_kernels`); they compute the same with different rounding, and gain nothing on a CPU.

Shape legend: N any batch (in a loop, that of one step), I input features, O output features, G blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

NORM_EPS = 1e-4
"""Epsilon of every normalisation layer. Reference: danijar/dreamerv3, ``nets.Norm``."""

_TRUNCATED_NORMAL_STD = 0.87962566103423978
"""Standard deviation of a unit normal truncated at ±2; initial weights are divided by it."""


def autocast(device: torch.device, enabled: bool) -> torch.autocast:
    """Return the autocast context in which a device computes in bfloat16, or in float32 if not ``enabled``.

    A device type without autocast (``meta``, on which FLOPs are counted) gets the context of the CPU.
    """
    kind = device.type if torch.amp.is_autocast_available(device.type) else "cpu"
    return torch.autocast(kind, torch.bfloat16, enabled=enabled, cache_enabled=False)


@contextmanager
def replaced(held: Sequence[tuple[nn.Module, str, nn.Parameter]], others: Sequence[Tensor]) -> Iterator[None]:
    """Put other tensors in the place of parameters, each given with its module and name; put these back at the end."""
    # Not by attribute assignment, which accepts only parameters in place of a parameter.
    for (layer, name, _), other in zip(held, others, strict=True):
        layer._parameters[name] = other  # type: ignore[assignment]
    try:
        yield
    finally:
        for layer, name, parameter in held:
            layer._parameters[name] = parameter


def initialize(weight: Tensor, fan_in: int, scale: float = 1.0) -> None:
    """Fill a weight in place from a normal truncated at two standard deviations, with variance ``scale² / fan_in``.

    Args:
        weight: Parameter to fill, any shape.
        fan_in: Inputs that each output sums over.
        scale: Multiplier of the standard deviation; 0 makes the layer output its bias.

    Reference: danijar/dreamerv3, initialiser ``trunc_normal_in``.
    """
    if scale == 0.0:
        nn.init.zeros_(weight)
        return
    std = scale / math.sqrt(fan_in) / _TRUNCATED_NORMAL_STD
    nn.init.trunc_normal_(weight, std=std, a=-2 * std, b=2 * std)


class Linear(nn.Linear):
    """Linear layer whose weight gradient can be deferred until after a time loop; see ``unrolled``."""

    deferred: DeferredWeight | None = None

    def defer(self, with_bias: bool) -> DeferredWeight:
        """Return weight and bias for the steps of one loop; the bias costs no kernel, so it is always included."""
        return DeferredWeight(self.weight.mT, self.bias)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(..., I)`` to ``(..., O)``."""
        return super().forward(inputs) if self.deferred is None else self.deferred.product(inputs)

    def plus(self, base: Tensor, inputs: Tensor) -> Tensor:
        """Map ``(N, I)`` to ``(N, O)`` without the layer's bias, and add a base ``(N, O)``, in one kernel."""
        if self.deferred is None:
            return torch.addmm(base, inputs, self.weight.mT)
        return self.deferred.product(inputs, base)


def linear(in_features: int, out_features: int, bias: bool = True, scale: float = 1.0) -> Linear:
    """Make a linear layer with the reference's initial weights, times ``scale``, and a zero bias."""
    layer = Linear(in_features, out_features, bias=bias)
    initialize(layer.weight, in_features, scale)
    if bias:
        nn.init.zeros_(layer.bias)
    return layer


class RMSNorm(nn.Module):
    """Divide features by their root mean square, then scale them (no shift).

    Reference: Zhang & Sennrich 2019; used by the 2025 DreamerV3.
    """

    shifts = False
    of_steps: dict[str, Iterator[Tensor]] | None = None  # see ``unrolled``

    def __init__(self, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(features))

    def forward(self, inputs: Tensor) -> Tensor:
        """Normalise ``(..., features)`` over its last dimension."""
        weight = self.weight if self.of_steps is None else next(self.of_steps["weight"])
        # Under autocast, the cast avoids mixed types, which the fused kernel does not support.
        with in_own_type(inputs):
            return F.rms_norm(inputs, weight.shape, weight.to(inputs.dtype), NORM_EPS)


class LayerNorm(nn.LayerNorm):
    """Layer normalisation of the 2023 DreamerV3; on CPU one fused kernel, 4-9 times faster than RMS backward."""

    shifts = True
    of_steps: dict[str, Iterator[Tensor]] | None = None  # see ``unrolled``

    def __init__(self, features: int) -> None:
        super().__init__(features, eps=NORM_EPS)

    def forward(self, inputs: Tensor) -> Tensor:
        """Normalise ``(..., features)`` over its last dimension."""
        weight: Tensor = self.weight
        bias: Tensor = self.bias
        if self.of_steps is not None:
            weight, bias = (next(self.of_steps[name]) for name in ("weight", "bias"))
        if inputs.device.type != "cpu":  # the CPU's kernel accepts float32 with bfloat16
            weight, bias = weight.to(inputs.dtype), bias.to(inputs.dtype)
        with in_own_type(inputs):
            return F.layer_norm(inputs, self.normalized_shape, weight, bias, self.eps)


def in_own_type(inputs: Tensor) -> Any:
    """Return the context in which norms and upsampling keep the type of their inputs.

    CUDA's autocast, unlike the CPU's, would compute them in float32. They gain nothing by it, because they compute
    their statistics in float32 anyway, and their outputs would have to be cast back.
    """
    return nullcontext() if inputs.device.type == "cpu" else autocast(inputs.device, enabled=False)


NORMS: dict[str, type[RMSNorm] | type[LayerNorm]] = {"rms": RMSNorm, "layer": LayerNorm}
"""Normalisation classes by ``ModelSize.norm``."""


class NormedLinear(nn.Module):
    """Linear layer, which has a bias only if the normalisation has no shift; normalisation (key of `NORMS`); SiLU."""

    def __init__(self, in_features: int, out_features: int, norm: str) -> None:
        super().__init__()
        self.norm = NORMS[norm](out_features)
        self.linear = linear(in_features, out_features, bias=not self.norm.shifts)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(..., I)`` to ``(..., O)``."""
        return F.silu(self.norm(self.linear(inputs)))


class SplitNormedLinear(nn.Module):
    """``NormedLinear`` of two concatenated inputs, whose second product can be computed before a time loop.

    W·[a, b] = W_a·a + W_b·b: ``project`` returns W_b·b (plus bias) for a whole sequence at once.
    """

    def __init__(self, first_features: int, second_features: int, out_features: int, norm: str) -> None:
        super().__init__()
        self.norm = NORMS[norm](out_features)
        fan_in = first_features + second_features
        self.few_kernels = False
        self.first = linear(first_features, out_features, False, (first_features / fan_in) ** 0.5)
        self.second = linear(second_features, out_features, not self.norm.shifts, (second_features / fan_in) ** 0.5)

    def project(self, second: Tensor) -> Tensor:
        """Map the second input ``(..., second_features)`` to its part of the sum ``(..., O)``."""
        return self.second(second)

    def forward(self, first: Tensor, projected: Tensor) -> Tensor:
        """Map the first input ``(..., first_features)`` and the projected second one to ``(..., O)``."""
        if self.few_kernels and first.ndim == 2:
            return F.silu(self.norm(self.first.plus(projected, first)))
        return F.silu(self.norm(self.first(first) + projected))


class BlockLinear(nn.Module):
    """Linear layer with a block-diagonal weight: output block g depends on input block g only.

    Args:
        in_features: I, divisible by ``blocks``.
        out_features: O, divisible by ``blocks``.
        blocks: G.
        fan_in: Inputs that each output sums over, if other layers add to this layer's output; default I / G.
        bias: Whether there is one.

    Raises:
        ValueError: If a size is not divisible by ``blocks``.
    """

    deferred: DeferredWeight | None = None

    def __init__(
        self, in_features: int, out_features: int, blocks: int, fan_in: int | None = None, bias: bool = True
    ) -> None:
        super().__init__()
        if in_features % blocks or out_features % blocks:
            raise ValueError(f"BlockLinear: {in_features} and {out_features} features must divide into {blocks} blocks")
        self.blocks = blocks
        self.weight = nn.Parameter(torch.empty(blocks, in_features // blocks, out_features // blocks))
        self.bias = nn.Parameter(torch.zeros(out_features)) if bias else None
        initialize(self.weight, fan_in or in_features // blocks)

    def defer(self, with_bias: bool) -> DeferredWeight:
        """Return the weight for the steps of one loop, and the bias if ``with_bias``."""
        bias = self.bias.view(self.blocks, 1, -1) if with_bias and self.bias is not None else None
        return DeferredWeight(self.weight, bias)

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(N, I)`` to ``(N, O)``."""
        # (N, I) -> (G, N, I/G), multiplied, -> (N, O)
        blocked = inputs.unflatten(-1, (self.blocks, -1)).transpose(0, 1)
        product = torch.bmm(blocked, self.weight) if self.deferred is None else self.deferred.product(blocked)
        outputs = product.transpose(0, 1).flatten(1)
        has_bias = self.deferred is not None and self.deferred.has_bias
        return outputs if self.bias is None or has_bias else outputs + self.bias


@contextmanager
def unrolled(*modules: nn.Module, steps: int | None = None) -> Iterator[None]:
    """Defer the weight gradients of linear layers that a time loop calls until after the loop.

    Gradients differ only by rounding. It does nothing if gradients are disabled.

    Args:
        modules: Modules that the loop calls, with each layer once per step.
        steps: Length of the loop, to defer the gradients of gains and biases, too (fewer kernels); None does not.
    """
    inside = [layer for module in modules for layer in module.modules()] if torch.is_grad_enabled() else []
    layers = [layer for layer in inside if isinstance(layer, (Linear, BlockLinear))]
    norms = [layer for layer in inside if steps and isinstance(layer, (RMSNorm, LayerNorm))]
    for layer in layers:
        layer.deferred = layer.defer(with_bias=steps is not None) if layer.weight.requires_grad else None
    for norm in norms:  # gains and biases are expanded, so that their gradients are summed once
        norm.of_steps = {
            name: iter(gain.expand(steps or 0, *gain.shape).unbind(0))
            for name, gain in norm._parameters.items()
            if gain is not None
        }
    try:
        yield
    finally:
        for layer in layers:
            layer.deferred = None
        for norm in norms:
            norm.of_steps = None


class Tape:
    """Stores input ``(..., N, I)`` and output gradient ``(..., N, O)`` of every step in a backward pass."""

    def __init__(self) -> None:
        self._steps: list[tuple[Tensor, Tensor]] = []
        self._backward_pass = -1

    def add(self, inputs: Tensor, gradient: Tensor) -> None:
        """Store one step; drop those of an earlier backward pass that did not need the weight's gradient."""
        backward_pass = torch._C._current_graph_task_id()
        if backward_pass != self._backward_pass:
            self._steps.clear()
            self._backward_pass = backward_pass
        self._steps.append((inputs, gradient))

    def take(self) -> tuple[Tensor, Tensor] | None:
        """Return all inputs ``(..., T·N, I)`` and all gradients ``(..., T·N, O)``, and clear the tape."""
        if not self._steps:
            return None
        inputs, gradients = (torch.cat(tensors, -2) for tensors in zip(*self._steps, strict=True))
        self._steps.clear()
        return inputs, gradients


class DeferredWeight:
    """Weight for the steps of one loop, whose gradient is computed after the backward pass of all steps.

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
        """Map ``(..., N, I)`` to ``(..., N, O)``, plus the bias or a given base ``(N, O)``."""
        base = None if base is None else base.to(self._dtype)
        return _Product.apply(inputs.to(self._dtype), self._weight, self._bias, base, self._tape)


def autocast_type(device_type: str) -> torch.dtype | None:
    """Return autocast's type on a device type; None if autocast is off."""
    if not torch.amp.is_autocast_available(device_type) or not torch.is_autocast_enabled(device_type):
        return None
    return torch.get_autocast_dtype(device_type)


class _Collect(Function):
    """Passes the weight to the steps; its backward multiplies the inputs and gradients on the tape."""

    @staticmethod
    def forward(ctx: FunctionCtx, weight: Tensor, bias: Tensor | None, tape: Tape) -> tuple[Tensor, Tensor | None]:
        ctx.set_materialize_grads(False)
        ctx.tape = tape  # type: ignore[attr-defined]  # torch lets a context hold anything
        return weight.view_as(weight), None if bias is None else bias.view_as(bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        # The steps return no gradient for the weight, but autograd calls this after the last of them.
        taken = ctx.tape.take()
        if taken is None:
            return None, None, None
        inputs, outputs = taken
        of_bias = outputs.sum(-2, keepdim=outputs.ndim == 3) if ctx.needs_input_grad[1] else None
        return inputs.mT @ outputs, of_bias, None


class _Product(Function):
    """Product of one step, plus the bias, whose gradient `_Collect` computes, or a base, whose gradient goes on."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, inputs: Tensor, weight: Tensor, bias: Tensor | None, base: Tensor | None, tape: Tape
    ) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        ctx.tape = tape  # type: ignore[attr-defined]  # torch lets a context hold anything
        added = bias if base is None else base
        if added is None:
            return inputs @ weight
        return (torch.addmm if weight.ndim == 2 else torch.baddbmm)(added, inputs, weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, weight = ctx.saved_tensors
        ctx.tape.add(inputs, gradient)
        of_inputs = gradient @ weight.mT if ctx.needs_input_grad[0] else None
        return of_inputs, None, None, gradient if ctx.needs_input_grad[3] else None, None


LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, BlockLinear, LayerNorm, RMSNorm)
"""Layers whose weights, biases and gains are cast; all other parameters stay in float32."""


def use_few_kernels(module: nn.Module, on: bool = True) -> None:
    """Turn ``few_kernels`` on or off in all submodules that have it."""
    for part in module.modules():
        if hasattr(part, "few_kernels"):
            part.few_kernels = on  # type: ignore[assignment]  # no tensor, nor a module


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
