"""Recurrent state-space model: belief h, categorical state z, and their dynamics.

Shape legend: B batch, T time, N any one-dimensional batch, A action, E embedding, D belief, L latents, K classes,
S state = L·K, U hidden. Everything here is plain tensors, so that a time loop costs a few kernels a step.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dreamer_racing.modules.layers import NORMS, BlockLinear, NormedLinear, SplitNormedLinear, linear, unrolled
from dreamer_racing.modules.stored_latents import LatentFormat


class Posterior(NamedTuple):
    """What observing a sequence gives.

    Attributes:
        belief: h, ``(B, T, D)``.
        state: z, a straight-through sample as flattened one-hots, ``(B, T, S)``.
        posterior_logits: Logits of q(z | h, o), ``(B, T, L, K)``.
        prior_logits: Logits of p(z | h), ``(B, T, L, K)``.
    """

    belief: Tensor
    state: Tensor
    posterior_logits: Tensor
    prior_logits: Tensor


def mix_uniform(logits: Tensor, unimix: float) -> Tensor:
    """Return the probabilities ``(1 − unimix)·softmax(logits) + unimix / K``, shape as ``logits``."""
    probabilities = torch.softmax(logits, -1)
    return torch.add(probabilities * (1.0 - unimix), unimix / logits.shape[-1])


def sample_one_hot(probabilities: Tensor, noise: Tensor | None) -> Tensor:
    """Choose one class of each latent.

    Args:
        probabilities: ``(..., L, K)``.
        noise: Uniform numbers in [0, 1), ``(..., L, 1)``, at which the distribution function is inverted (one number a
            latent, where Gumbel noise needs one a class); None takes the mode.

    Returns:
        One-hots ``(..., L, K)`` whose gradient is that of ``probabilities`` (straight-through).
    """
    fixed = probabilities.detach()
    if noise is None:
        index = fixed.argmax(-1, keepdim=True)
    else:
        # Rounding may leave the last sum just below 1, and the number above it.
        index = torch.searchsorted(fixed.cumsum(-1), noise, right=True).clamp_max_(fixed.shape[-1] - 1)
    one_hot = torch.zeros_like(fixed).scatter_(-1, index, 1.0)
    if not probabilities.requires_grad:
        return one_hot
    return one_hot + (probabilities - fixed)


def _gated_update(reset: Tensor, candidate: Tensor, update: Tensor, belief: Tensor) -> Tensor:
    """Return the next belief from the gates before activation and the belief, each float32 ``(N, D)``."""
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    # The shift of -1 makes a fresh cell remember rather than overwrite.
    return torch.lerp(belief, candidate, torch.sigmoid(update - 1.0))


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

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor) -> Tensor:
        """Return the next belief.

        Args:
            belief: ``(N, D)``.
            state: ``(N, S)``.
            projected_action: From ``project_action``, ``(N, U)``.

        Returns:
            ``(N, D)``.
        """
        inputs = self.inputs(state, projected_action)
        gates = self.gates_norm(self.gates(torch.cat((inputs, belief), -1))).float()
        reset, candidate, update = gates.chunk(3, -1)
        return _gated_update(reset, candidate, update, belief)


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

    def project_action(self, action: Tensor) -> Tensor:
        """Map actions ``(..., A)`` to their hidden layer ``(..., U)``."""
        return self.from_action(action)

    def forward(self, belief: Tensor, state: Tensor, projected_action: Tensor) -> Tensor:
        """Return the next belief; arguments as in ``DenseGRUCell.forward``."""
        inputs = torch.cat((self.from_belief(belief), self.from_state(state), projected_action), -1)
        hidden = F.silu(self.hidden_norm(self.hidden_shared(inputs) + self.hidden_blocks(belief)))
        # Each block holds its reset, candidate and update gates: (N, 3D) -> three of (N, D)
        gates = self.gates(hidden).float().unflatten(-1, (self.blocks, 3, -1)).unbind(-2)
        reset, candidate, update = (gate.flatten(1) for gate in gates)
        return _gated_update(reset, candidate, update, belief)


class RSSM(nn.Module):
    """World model's dynamics: ``h_t = f(h_{t−1}, z_{t−1}, a_{t−1})``, ``z_t ~ q(z | h_t, o_t)`` or ``p(z | h_t)``.

    Where ``is_init``, the previous belief and state are the initial ones and the previous action is zero. Actions are
    clipped to [−1, 1], as the environment does.

    Args:
        embedding: E.
        action: A.
        belief: D.
        latents: L.
        classes: K.
        hidden: U.
        recurrence: Key of ``cells``; default the first.
        blocks: Blocks of the block GRU.
        prior_layers: Hidden layers from h to the prior's logits.
        norm: ``"rms"`` or ``"layer"``.
        learned_initial: Whether the initial belief is learned (then the initial state is the prior's mode) or zero.
        unimix: Share of the uniform distribution in every categorical.
        sampled: Whether a state is a sample of its categoricals, as in DreamerV3, or their probabilities themselves:
            then nothing is drawn, in acting, training and imagination alike.

    Raises:
        ValueError: If there is no cell of that name.

    Example:
        >>> import torch
        >>> rssm = RSSM(embedding=8, action=4, belief=16, latents=2, classes=4, hidden=8)
        >>> posterior = rssm.observe(torch.zeros(2, 5, 8), torch.zeros(2, 5, 4), torch.zeros(2, 5, dtype=torch.bool))
        >>> posterior.state.shape
        torch.Size([2, 5, 8])

    Reference: danijar/dreamerv3, ``rssm.RSSM``; DreamerV3, Eq. 3.
    """

    cells: ClassVar[dict[str, Any]] = {"block": BlockGRUCell, "dense": DenseGRUCell}
    """Recurrent cells by the name that a ``ModelSize`` gives."""
    posterior_layer: ClassVar[Any] = SplitNormedLinear
    """Hidden layer of the posterior, of belief and embedding."""

    def __init__(
        self,
        embedding: int,
        action: int,
        belief: int,
        latents: int,
        classes: int,
        hidden: int,
        recurrence: str | None = None,
        blocks: int = 8,
        prior_layers: int = 2,
        norm: str = "rms",
        learned_initial: bool = False,
        unimix: float = 0.01,
        sampled: bool = True,
    ) -> None:
        super().__init__()
        recurrence = recurrence or next(iter(self.cells))
        if recurrence not in self.cells:
            raise ValueError(f"{type(self).__name__}: recurrence={recurrence!r}, known here: {', '.join(self.cells)}.")
        self.latents, self.classes, self.unimix, self.sampled = latents, classes, unimix, sampled
        state = latents * classes
        self.cell = self.cells[recurrence](belief, state, action, hidden, norm, blocks)
        widths = [belief] + [hidden] * prior_layers
        self.prior = nn.Sequential(
            *(NormedLinear(before, after, norm) for before, after in pairwise(widths)),
            linear(hidden, state),
        )
        self.posterior_hidden = self.posterior_layer(belief, embedding, hidden, norm)
        self.posterior_output = linear(hidden, state)
        self.learned_initial = learned_initial
        self.initial_belief = nn.Parameter(torch.zeros(1, belief), requires_grad=learned_initial)

    def initial(self) -> tuple[Tensor, Tensor]:
        """Return the belief ``(1, D)`` and state ``(1, S)`` before an episode's first observation."""
        belief = torch.tanh(self.initial_belief)
        if not self.learned_initial:
            return belief, belief.new_zeros(1, self.latents * self.classes)
        return belief, self._sample(self.prior_logits(belief), None)

    @property
    def latent_format(self) -> LatentFormat:
        """How a replay keeps its latents."""
        return LatentFormat(self.initial_belief.shape[-1], self.latents, self.classes, self.sampled)

    def prior_logits(self, belief: Tensor) -> Tensor:
        """Map beliefs ``(..., D)`` to the prior's logits ``(..., L, K)``."""
        return self.prior(belief).float().unflatten(-1, (self.latents, self.classes))

    def draw_noise(self, *batch: int) -> Tensor:
        """Draw the noise that samples states of a batch, ``(*batch, L, 1)``."""
        return torch.rand(*batch, self.latents, 1, device=self.initial_belief.device)

    def observe(
        self,
        embedding: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        initial: tuple[Tensor, Tensor] | None = None,
        deterministic: bool = False,
    ) -> Posterior:
        """Unroll over a sequence of observations.

        Args:
            embedding: ``(B, T, E)``.
            previous_action: The action that led to each observation, ``(B, T, A)``.
            is_init: Whether each observation is its episode's first, bool ``(B, T)``.
            initial: Belief ``(B, D)`` and state ``(B, S)`` before the sequence; default an episode's start.
            deterministic: Take the posterior's mode instead of a sample.

        Returns:
            Belief, state and logits of every step.
        """
        batch, time = is_init.shape
        start = self.initial()
        belief, state = initial or (value.expand(batch, -1) for value in start)
        resets = is_init.unsqueeze(-1)
        actions = self._project_action(previous_action, resets).unbind(1)
        embeddings = self.posterior_hidden.project(embedding).unbind(1)
        noises = [None] * time if deterministic else self.draw_noise(time, batch).unbind(0)
        beliefs, states, logits = [], [], []
        with unrolled(self.cell, self.posterior_hidden, self.posterior_output):
            for reset, action, embedded, noise in zip(resets.unbind(1), actions, embeddings, noises, strict=True):
                belief, state, logit = self._observe(belief, state, start, reset, action, embedded, noise)
                beliefs.append(belief)
                states.append(state)
                logits.append(logit)
        belief = torch.stack(beliefs, 1)
        return Posterior(belief, torch.stack(states, 1), torch.stack(logits, 1), self.prior_logits(belief))

    def observe_step(
        self,
        embedding: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        belief: Tensor,
        state: Tensor,
        deterministic: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Take in one observation, for acting; the same maths as one step of ``observe``.

        Args:
            embedding: ``(N, E)``.
            previous_action: ``(N, A)``.
            is_init: bool ``(N,)``.
            belief: The previous belief, ``(N, D)``.
            state: The previous state, ``(N, S)``.
            deterministic: Take the posterior's mode instead of a sample.

        Returns:
            Belief ``(N, D)`` and state ``(N, S)``.
        """
        reset = is_init.unsqueeze(-1)
        action = self._project_action(previous_action, reset)
        embedded = self.posterior_hidden.project(embedding)
        noise = None if deterministic else self.draw_noise(len(is_init))
        return self._observe(belief, state, self.initial(), reset, action, embedded, noise)[:2]

    def imagine_step(
        self, belief: Tensor, state: Tensor, action: Tensor, deterministic: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Predict one step without an observation.

        Args:
            belief: ``(N, D)``.
            state: ``(N, S)``.
            action: The action taken there, ``(N, A)``.
            deterministic: Take the prior's mode instead of a sample.

        Returns:
            The next belief ``(N, D)`` and state ``(N, S)``.
        """
        belief = self.cell(belief, state, self.cell.project_action(action.clamp(-1.0, 1.0)))
        noise = None if deterministic else self.draw_noise(len(belief))
        return belief, self._sample(self.prior_logits(belief), noise)

    def _project_action(self, previous_action: Tensor, reset: Tensor) -> Tensor:
        """Clip, zero where ``reset`` and project actions ``(..., A)``."""
        return self.cell.project_action(previous_action.clamp(-1.0, 1.0).masked_fill(reset, 0.0))

    def _observe(
        self,
        belief: Tensor,
        state: Tensor,
        start: tuple[Tensor, Tensor],
        reset: Tensor,
        projected_action: Tensor,
        embedded: Tensor,
        noise: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Step belief ``(N, D)`` and state ``(N, S)``, and return them with the posterior's logits ``(N, L, K)``."""
        belief = torch.where(reset, start[0], belief)
        state = torch.where(reset, start[1], state)
        belief = self.cell(belief, state, projected_action)
        logits = self._posterior_logits(belief, embedded)
        return belief, self._sample(logits, noise), logits

    def _posterior_logits(self, belief: Tensor, embedded: Tensor) -> Tensor:
        """Map beliefs ``(..., D)`` and projected embeddings ``(..., U)`` to the posterior's logits ``(..., L, K)``."""
        logits = self.posterior_output(self.posterior_hidden(belief, embedded))
        return logits.float().unflatten(-1, (self.latents, self.classes))

    def _sample(self, logits: Tensor, noise: Tensor | None) -> Tensor:
        """Return states ``(..., S)`` by logits ``(..., L, K)``."""
        probabilities = mix_uniform(logits, self.unimix)
        return (sample_one_hot(probabilities, noise) if self.sampled else probabilities).flatten(-2)
