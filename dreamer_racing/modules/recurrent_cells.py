"""Recurrent cells of an RSSM: the next belief from the belief, state and action before it.

Shape legend: N any one-dimensional batch, A action, D belief, S state, U hidden.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dreamer_racing.modules.few_kernels import UPDATE_SHIFT, GatedUpdate, gate_shift
from dreamer_racing.modules.layers import NORMS, BlockLinear, NormedLinear, SplitNormedLinear, linear


def gated_update(reset: Tensor, candidate: Tensor, update: Tensor, belief: Tensor) -> Tensor:
    """Return the next belief from the gates before activation and the belief, each float32 ``(N, D)``."""
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    return torch.lerp(belief, candidate, torch.sigmoid(update - UPDATE_SHIFT))


class SplitInputCell(nn.Module):
    """Recurrent cell that reads the state and the action through one normalised layer, the action's part ahead of time.

    Args:
        state: S.
        action: A.
        hidden: U.
        norm: ``"rms"`` or ``"layer"``.
    """

    def __init__(self, state: int, action: int, hidden: int, norm: str) -> None:
        super().__init__()
        self.action_dim = action
        self.inputs = SplitNormedLinear(state, action, hidden, norm)

    def project_action(self, action: Tensor) -> Tensor:
        """Map actions ``(..., A)`` to their part of the input layer ``(..., U)``."""
        return self.inputs.project(action)


class DenseGRUCell(SplitInputCell):
    """GRU of the 2023 DreamerV3: one dense layer before it, one normalised dense layer for its three gates.

    Args:
        belief: D.
        state: S.
        action: A.
        hidden: U.
        norm: ``"rms"`` or ``"layer"``.
        blocks: Ignored; here so that both cells are made alike.
    """

    def __init__(self, belief: int, state: int, action: int, hidden: int, norm: str, blocks: int = 1) -> None:
        super().__init__(state, action, hidden, norm)
        self.gates_norm = NORMS[norm](3 * belief)
        self.gates = linear(hidden + belief, 3 * belief, bias=not self.gates_norm.shifts)
        self.few_kernels = False
        self.shift = nn.Buffer(gate_shift(), persistent=False)

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor, low: Tensor | None = None) -> Tensor:
        """Return the next belief.

        Args:
            belief: ``(N, D)``.
            state: ``(N, S)``.
            projected_action: From ``project_action``, ``(N, U)``.
            low: The belief in the type that autocast computes in, where it is there already.

        Returns:
            ``(N, D)``.
        """
        inputs = self.inputs(state, projected_action)
        low = belief.to(inputs.dtype) if low is None else low
        gates = self.gates_norm(self.gates(torch.cat((inputs, low), -1)))
        if self.few_kernels:
            return GatedUpdate.apply(gates.unflatten(-1, (1, 3, -1)), self.shift, belief)
        reset, candidate, update = gates.float().chunk(3, -1)
        return gated_update(reset, candidate, update, belief)


class BlockGRUCell(nn.Module):
    """GRU of the 2025 DreamerV3: block-diagonal in the belief, so that a wide belief costs few weights.

    The reference feeds every block the same 3·U inputs beside its own part of the belief. The product is the sum of a
    dense layer of those inputs and a block-diagonal layer of the belief, which is how it is computed here.

    Args:
        belief: D, divisible by ``blocks``.
        state: S.
        action: A.
        hidden: U.
        norm: ``"rms"`` or ``"layer"``.
        blocks: G.

    Reference: danijar/dreamerv3, ``rssm.RSSM._core``.
    """

    def __init__(self, belief: int, state: int, action: int, hidden: int, norm: str, blocks: int = 8) -> None:
        super().__init__()
        self.action_dim = action
        self.blocks = blocks
        self.from_belief = NormedLinear(belief, hidden, norm)
        self.from_state = NormedLinear(state, hidden, norm)
        self.from_action = NormedLinear(action, hidden, norm)
        fan_in = belief // blocks + 3 * hidden
        self.hidden_shared = linear(3 * hidden, belief, scale=(3 * hidden / fan_in) ** 0.5)
        self.hidden_blocks = BlockLinear(belief, belief, blocks, fan_in=fan_in, bias=False)
        self.hidden_norm = NORMS[norm](belief)
        self.gates = BlockLinear(belief, 3 * belief, blocks)
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
        # Each block holds its reset, candidate and update gates: (N, 3D) -> three of (N, D)
        gates = self.gates(hidden)
        if self.few_kernels:
            return GatedUpdate.apply(gates.unflatten(-1, (self.blocks, 3, -1)), self.shift, belief)
        parts = gates.float().unflatten(-1, (self.blocks, 3, -1)).unbind(-2)
        reset, candidate, update = (gate.flatten(1) for gate in parts)
        return gated_update(reset, candidate, update, belief)
