"""Recurrent cells of an RSSM, which compute the next belief from belief, state and action.

Shape legend: N any one-dimensional batch, A action, D belief, S state, U hidden, G blocks, W = D / G.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

from dreamer_racing.modules.layers import NORMS, BlockLinear, NormedLinear, SplitNormedLinear, linear
from dreamer_racing.modules.sizes import ModelSize

UPDATE_SHIFT = 1.0
"""Subtracted from the update gate, so that an untrained cell remembers rather than overwrites."""


def gate_shift() -> Tensor:
    """Return the shifts that are subtracted from reset, candidate and update, ``(3, 1)``."""
    return torch.tensor([[0.0], [0.0], [UPDATE_SHIFT]])


class GatedUpdate(Function):
    """GRU update from its gates, with 5 forward and 9 backward kernels instead of autograd's 7 and 14.

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
        of_squashed = torch.empty_like(squashed)  # the candidate's entry stays unset
        torch.mul(of_product, shifted[:, :, 1], out=of_squashed[:, :, 0])
        torch.mul(gradient, candidate - before, out=of_squashed[:, :, 2])
        of_gates = torch.ops.aten.sigmoid_backward(of_squashed, squashed)
        torch.mul(of_product, squashed[:, :, 0], out=of_gates[:, :, 1])
        return of_gates.to(ctx.gate_type), None, of_belief


def next_belief(gates: Tensor, shift: Tensor, belief: Tensor, few_kernels: bool) -> Tensor:
    """Return the next belief ``(N, D)``; arguments as of `GatedUpdate`, which ``few_kernels`` uses."""
    if few_kernels:
        return GatedUpdate.apply(gates, shift, belief)
    reset, candidate, update = (gate.flatten(1) for gate in gates.float().unbind(-2))  # (N, D) each
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    return torch.lerp(belief, candidate, torch.sigmoid(update - UPDATE_SHIFT))


class DenseGRUCell(nn.Module):
    """GRU of the 2023 DreamerV3: one dense layer before it, one normalised dense layer for its three gates.

    State and action enter one normalised layer, whose part for the action is computed beforehand.

    Args:
        size: Sizes of the networks.
        action: A.
    """

    def __init__(self, size: ModelSize, action: int) -> None:
        super().__init__()
        self.action_dim = action
        self.inputs = SplitNormedLinear(size.state, action, size.hidden, size.norm)
        self.gates_norm = NORMS[size.norm](3 * size.belief)
        self.gates = linear(size.hidden + size.belief, 3 * size.belief, bias=not self.gates_norm.shifts)
        self.few_kernels = False
        self.shift = nn.Buffer(gate_shift(), persistent=False)

    def project_action(self, action: Tensor) -> Tensor:
        """Map actions ``(..., A)`` to their part of the input layer ``(..., U)``."""
        return self.inputs.project(action)

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor, low: Tensor | None = None) -> Tensor:
        """Return the next belief ``(N, D)``, from an action ``(N, U)`` of ``project_action``.

        ``low`` is the belief in autocast's type, if it was cast already.
        """
        inputs = self.inputs(state, projected_action)
        low = belief.to(inputs.dtype) if low is None else low
        gates = self.gates_norm(self.gates(torch.cat((inputs, low), -1)))
        return next_belief(gates.unflatten(-1, (1, 3, -1)), self.shift, belief, self.few_kernels)


class BlockGRUCell(nn.Module):
    """GRU of the 2025 DreamerV3: block-diagonal in the belief, so that a wide belief needs few weights.

    The reference feeds every block the same 3·U inputs together with its own part of the belief. This equals the sum of
    a dense layer on those inputs and a block-diagonal layer on the belief, which is computed here.

    Args:
        size: Sizes of the networks; ``belief`` must be divisible by ``blocks``.
        action: A.

    Reference: danijar/dreamerv3, ``rssm.RSSM._core``.
    """

    def __init__(self, size: ModelSize, action: int) -> None:
        super().__init__()
        belief, hidden, norm = size.belief, size.hidden, size.norm
        self.action_dim = action
        self.blocks = size.blocks
        self.from_belief = NormedLinear(belief, hidden, norm)
        self.from_state = NormedLinear(size.state, hidden, norm)
        self.from_action = NormedLinear(action, hidden, norm)
        fan_in = belief // size.blocks + 3 * hidden
        self.hidden_shared = linear(3 * hidden, belief, scale=(3 * hidden / fan_in) ** 0.5)
        self.hidden_blocks = BlockLinear(belief, belief, size.blocks, fan_in=fan_in, bias=False)
        self.hidden_norm = NORMS[norm](belief)
        self.gates = BlockLinear(belief, 3 * belief, size.blocks)
        self.few_kernels = False
        self.shift = nn.Buffer(gate_shift(), persistent=False)

    def project_action(self, action: Tensor) -> Tensor:
        """Map actions ``(..., A)`` to their hidden layer ``(..., U)``."""
        return self.from_action(action)

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor, low: Tensor | None = None) -> Tensor:
        """Return the next belief; arguments as in ``DenseGRUCell.forward``."""
        low = belief if low is None else low
        inputs = torch.cat((self.from_belief(low), self.from_state(state), projected_action), -1)
        hidden = F.silu(self.hidden_norm(self.hidden_shared(inputs) + self.hidden_blocks(low)))
        gates = self.gates(hidden).unflatten(-1, (self.blocks, 3, -1))  # (N, 3D) -> (N, G, 3, W)
        return next_belief(gates, self.shift, belief, self.few_kernels)
