"""RSSM without a loop over time: a diagonal state-space model, computed over a window by a parallel scan.

Shape legend: B batch, T time, N any one-dimensional batch, A action, E embedding, D belief, S state, U hidden,
W = D / LAYERS channels of a layer.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from dreamer_racing.modules.layers import NormedLinear, linear
from dreamer_racing.modules.linear_recurrence import linear_recurrence
from dreamer_racing.modules.recurrent_cells import SplitInputCell
from dreamer_racing.modules.rssm import RSSM, Posterior

LAYERS = 2
"""Layers of the recurrence; channels of one layer do not see each other's past, those of the next layer see all."""
TIME_CONSTANTS = (2.0, 64.0)
"""Shortest and longest initial time constant of a layer's channels, control steps; the others are spaced evenly in
the logarithm. The project's own choice."""


class DiagonalSSM(SplitInputCell):
    """Layers of a selective diagonal state-space model; the belief is their states side by side.

    ``ḣ = −h + x`` in each channel, discretised by zero-order hold over a step whose length depends on the inputs:
    ``h_t = α_t · h_{t−1} + (1 − α_t) · tanh(x_t)``. α and x depend on the previous state and action and on the layers
    below, never on the layer's own past, so h_t is linear in h_{t−1}, and a scan computes a whole window. As a weighted
    mean of numbers in [−1, 1], the belief stays in that range, as in a GRU.

    Args:
        belief: D, divisible by ``LAYERS``.
        state: S.
        action: A.
        hidden: U.
        norm: ``"rms"`` or ``"layer"``.
        blocks: Ignored; exists so that all cells have the same arguments.

    Raises:
        ValueError: If the belief cannot be divided among the layers.

    Reference: Gu & Dao 2023, "Mamba", Theorem 1; Feng et al. 2024, "Were RNNs All We Needed?" (minGRU: the same but for
    the tanh); Tallec & Ollivier 2018, "Can Recurrent Neural Networks Warp Time?" (initial decays by time constants).
    """

    def __init__(self, belief: int, state: int, action: int, hidden: int, norm: str, blocks: int = 1) -> None:
        super().__init__(state, action, hidden, norm)
        if belief % LAYERS:
            raise ValueError(f"DiagonalSSM: belief={belief} must divide into {LAYERS} layers: choose a multiple.")
        width = belief // LAYERS
        gates = [linear(hidden, 2 * width) for _ in range(LAYERS)]
        shortest, longest = map(math.log10, TIME_CONSTANTS)
        for layer in gates:
            # σ(ln(τ − 1)) = 1 − 1/τ
            layer.bias.data[:width] = (torch.logspace(shortest, longest, width) - 1.0).log()
        self.gates = nn.ModuleList(gates)
        self.mixes = nn.ModuleList(NormedLinear(width, hidden, norm) for _ in range(LAYERS - 1))

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor, low: Tensor | None = None) -> Tensor:
        """Return the next belief; arguments as in ``DenseGRUCell.forward``, but ``low`` is ignored."""
        return self._run(belief, state, projected_action, None)

    def scan(self, belief: Tensor, state: Tensor, projected_action: Tensor, begins: Tensor) -> Tensor:
        """Return the next belief of every step of a window.

        Args:
            belief: Given previous belief at the steps that start from one, else zero, ``(B, T, D)``.
            state: State before each step, ``(B, T, S)``.
            projected_action: ``(B, T, U)``.
            begins: Whether a step starts from ``belief`` instead of the step before it, bool ``(B, T, 1)``; the first
                step always does.

        Returns:
            ``(B, T, D)``.
        """
        return self._run(belief, state, projected_action, begins)

    def _run(self, belief: Tensor, state: Tensor, projected_action: Tensor, begins: Tensor | None) -> Tensor:
        hidden = self.inputs(state, projected_action)
        after: list[Tensor] = []
        for index, (gates, before) in enumerate(zip(self.gates, belief.chunk(LAYERS, -1), strict=True)):
            if index:
                hidden = hidden + self.mixes[index - 1](after[-1])
            # In float32, also under autocast: just below 1, bfloat16 numbers are 0.004 apart.
            decay, candidate = gates(hidden).float().chunk(2, -1)
            decay = torch.sigmoid(decay)
            drive = torch.lerp(torch.tanh(candidate), before, decay)
            after.append(drive if begins is None else linear_recurrence(decay.masked_fill(begins, 0.0), drive))
        return torch.cat(after, -1)


class EmbeddingLayer(NormedLinear):
    """Hidden layer of a posterior that depends on the embedding alone, with the interface of ``SplitNormedLinear``.

    Args:
        first_features: Ignored, like the belief.
        second_features: E.
        out_features: U.
        norm: Key of ``NORMS``.
    """

    def __init__(self, first_features: int, second_features: int, out_features: int, norm: str) -> None:
        super().__init__(second_features, out_features, norm)

    def project(self, second: Tensor) -> Tensor:
        """Map embeddings ``(..., E)`` to the layer's output ``(..., U)``."""
        return super().forward(second)

    def forward(self, first: Tensor, projected: Tensor) -> Tensor:  # type: ignore[override]  # as SplitNormedLinear's
        """Return ``projected`` as it is, ``(..., U)``."""
        return projected


class ParallelRSSM(RSSM):
    """RSSM with a posterior of the observation alone: ``z_t ~ q(z | o_t)``, ``h_t = f(h_{t−1}, z_{t−1}, a_{t−1})``.

    All z of a window are computed before the first h, and h_t is linear in h_{t−1}, so ``observe`` needs no loop over
    T. ``observe_step`` and ``imagine_step`` are inherited, and compute the same function step by step.

    Arguments as for ``RSSM``; the recurrence is ``"ssm"``.

    Example:
        >>> import torch
        >>> rssm = ParallelRSSM(embedding=8, action=4, belief=16, latents=2, classes=4, hidden=8)
        >>> posterior = rssm.observe(torch.zeros(2, 5, 8), torch.zeros(2, 5, 4), torch.zeros(2, 5, dtype=torch.bool))
        >>> posterior.belief.shape
        torch.Size([2, 5, 16])

    Reference: Krinner et al. 2025, "Accelerating Model-Based Reinforcement Learning with State-Space World Models";
    Samsami et al. 2024, "Mastering Memory Tasks with World Models" (R2I).
    """

    cells: ClassVar[dict[str, Any]] = {"ssm": DiagonalSSM}
    posterior_layer: ClassVar[Any] = EmbeddingLayer

    def observe(
        self,
        embedding: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        initial: tuple[Tensor, Tensor] | None = None,
        deterministic: bool = False,
    ) -> Posterior:
        """Infer the latents of a sequence, all records at once; arguments and result as in ``RSSM.observe``."""
        batch, time = is_init.shape
        start = self.initial()
        belief, state = initial or (value.expand(batch, -1) for value in start)
        resets = is_init.unsqueeze(-1)
        actions = self._project_action(previous_action, resets)
        logits = self._posterior_logits(belief, self.posterior_hidden.project(embedding))
        noise = None if deterministic else self.draw_noise(time, batch).transpose(0, 1).contiguous()
        states = self._sample(logits, noise)
        # State and belief before each step: those of the step before, or of an episode's start.
        before = torch.cat((state.unsqueeze(1), states[:, :-1]), 1)
        before = torch.where(resets, start[1], before)
        given = torch.cat((belief.unsqueeze(1), belief.new_zeros(batch, time - 1, belief.shape[-1])), 1)
        given = torch.where(resets, start[0], given)
        beliefs = self.cell.scan(given, before, actions, resets)
        return Posterior(beliefs, states, logits, self.prior_logits(beliefs))
