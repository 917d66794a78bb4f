"""Recurrent state-space model (RSSM): belief h, categorical state z, their dynamics, and their format in a replay.

Shape legend: B batch, T time, N any one-dimensional batch, A action, E embedding, D belief, L latents, K classes,
S state = L·K, F = D + S features, U hidden. The networks use plain tensors, so that a step of a time loop costs few
kernels; only `LatentFormat` uses TensorDict.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx

from dreamer_racing.modules.layers import NormedLinear, SplitNormedLinear, autocast_type, linear, unrolled
from dreamer_racing.modules.recurrent_cells import BlockGRUCell, DenseGRUCell
from dreamer_racing.modules.sizes import ModelSize

StepStart = Callable[[int, Tensor, Tensor], tuple[Tensor, ...]]
"""Function of a step's index and the latents after the step before that returns the latents the step starts from."""
CONTEXT = "context"
"""Key of a record's latents *before* its observation: ``belief`` and ``state``, packed."""


class Posterior(NamedTuple):
    """Latents inferred from a sequence of observations, and their distributions.

    Attributes:
        belief: h, ``(B, T, D)``.
        state: z, ``(B, T, S)``: straight-through samples as flattened one-hots, or probabilities if not ``sampled``.
        posterior_logits: Logits of q(z | h, o), ``(B, T, L, K)``.
        prior_logits: Logits of p(z | h), ``(B, T, L, K)``.
    """

    belief: Tensor
    state: Tensor
    posterior_logits: Tensor
    prior_logits: Tensor


def join_features(belief: Tensor, state: Tensor) -> Tensor:
    """Concatenate belief ``(..., D)`` and state ``(..., S)`` to features ``(..., F)``, the input of all heads."""
    return torch.cat((belief, state), -1)


class LatentFormat(NamedTuple):
    """Packed format of latents: the belief as float16, the state as the class of each latent or as probabilities.

    Attributes:
        belief: D.
        latents: L.
        classes: K.
        sampled: Whether states are one-hots, stored as classes (uint8), or probabilities, stored as float16.

    Example:
        >>> import torch
        >>> keep = LatentFormat(belief=3, latents=1, classes=4)
        >>> packed = keep.pack(torch.zeros(2, 3), torch.eye(4)[:2])
        >>> packed["state"].tolist()
        [[0], [1]]
    """

    belief: int
    latents: int
    classes: int
    sampled: bool = True

    @property
    def bytes(self) -> int:
        """Size of the packed latents of one record."""
        return 2 * self.belief + self.latents * (1 if self.sampled else 2 * self.classes)

    def pack(self, belief: Tensor, state: Tensor) -> TensorDict:
        """Pack belief ``(*N, D)``, in [−1, 1], and state ``(*N, S)`` to a batch ``[*N]``; floats are off by ≤ 5e-4."""
        if self.sampled:
            state = state.unflatten(-1, (self.latents, self.classes)).argmax(-1).to(torch.uint8)
        else:
            state = state.half()
        return TensorDict({"belief": belief.half(), "state": state}, belief.shape[:-1], device=belief.device)

    def unpack(self, packed: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return belief ``(*N, D)`` and state ``(*N, S)``, float32, from packed latents ``[*N]``."""
        belief, state = packed.get("belief").float(), packed.get("state")
        if self.sampled:
            # Not one_hot, which checks the classes first and so waits for the device.
            state = (state.unsqueeze(-1) == torch.arange(self.classes, device=state.device)).flatten(-2)
        return belief, state.float()


def mix_uniform(logits: Tensor, unimix: float) -> Tensor:
    """Return the probabilities ``(1 − unimix)·softmax(logits) + unimix / K``, in the shape of ``logits``."""
    probabilities = torch.softmax(logits, -1)
    return torch.add(probabilities * (1.0 - unimix), unimix / logits.shape[-1])


def sample_one_hot(
    probabilities: Tensor, noise: Tensor | None, blank: Tensor | None = None, dtype: torch.dtype | None = None
) -> Tensor:
    """Choose one class for each latent.

    Args:
        probabilities: ``(..., L, K)``.
        noise: Uniform numbers in [0, 1), ``(..., L, 1)``, at which the cumulative distribution is inverted (one number
            per latent, while Gumbel noise needs one per class); None takes the mode.
        blank: Zeros ``(..., L, K)`` to write the result to; None allocates them.
        dtype: Type of allocated zeros; None for that of the probabilities.

    Returns:
        One-hots ``(..., L, K)`` whose gradient is that of ``probabilities`` (straight-through).
    """
    fixed = probabilities.detach()
    if noise is None:
        index = fixed.argmax(-1, keepdim=True)
    else:
        # Without the last sum, because rounding may leave it just below 1, and below the noise.
        index = torch.searchsorted(fixed[..., :-1].cumsum(-1), noise, right=True)
    one_hot = (torch.zeros_like(fixed, dtype=dtype) if blank is None else blank).scatter_(-1, index, 1.0)
    return _StraightThrough.apply(one_hot, probabilities) if probabilities.requires_grad else one_hot


class _StraightThrough(Function):
    """Returns a sample, and passes its gradient to the probabilities that it was drawn from."""

    @staticmethod
    def forward(ctx: FunctionCtx, sample: Tensor, probabilities: Tensor) -> Tensor:
        return sample.view_as(sample)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[None, Tensor]:
        return None, gradient.float()


class RSSM(nn.Module):
    """World model's dynamics: ``h_t = f(h_{t−1}, z_{t−1}, a_{t−1})``, ``z_t ~ q(z | h_t, o_t)`` or ``p(z | h_t)``.

    If ``is_init`` is set, previous belief and state are the initial ones, and the previous action is zero. Actions are
    clipped to [−1, 1], as in the environment.

    Args:
        size: Sizes of the networks.
        embedding: E.
        action: A.

    Example:
        >>> import torch
        >>> from dreamer_racing.modules import get_size
        >>> rssm = RSSM(get_size("debug"), embedding=8, action=4)
        >>> posterior = rssm.observe(torch.zeros(2, 5, 8), torch.zeros(2, 5, 4), torch.zeros(2, 5, dtype=torch.bool))
        >>> posterior.state.shape
        torch.Size([2, 5, 16])

    Reference: danijar/dreamerv3, ``rssm.RSSM``; DreamerV3, Eq. 3.
    """

    cells: ClassVar[dict[str, Any]] = {"block": BlockGRUCell, "dense": DenseGRUCell}
    """Recurrent cells by ``ModelSize.recurrence``."""
    unimix = 0.01
    """Share of the uniform distribution in every categorical."""

    def __init__(self, size: ModelSize, embedding: int, action: int) -> None:
        super().__init__()
        self.latents, self.classes, self.sampled = size.latents, size.classes, size.sampled
        self.few_kernels = False
        self.uniform = nn.Buffer(torch.tensor(1.0 / size.classes), persistent=False)
        self.cell = self.cells[size.recurrence](size, action)
        widths = [size.belief] + [size.hidden] * size.prior_layers
        self.prior = nn.Sequential(
            *(NormedLinear(before, after, size.norm) for before, after in pairwise(widths)),
            linear(size.hidden, size.state),
        )
        self.posterior_hidden = SplitNormedLinear(size.belief, embedding, size.hidden, size.norm)
        self.posterior_output = linear(size.hidden, size.state)
        self.learned_initial = size.learned_initial
        self.initial_belief = nn.Parameter(torch.zeros(1, size.belief), requires_grad=size.learned_initial)

    def initial(self) -> tuple[Tensor, Tensor]:
        """Return the belief ``(1, D)`` and state ``(1, S)`` before an episode's first observation."""
        belief = torch.tanh(self.initial_belief)
        if not self.learned_initial:
            return belief, belief.new_zeros(1, self.latents * self.classes)
        return belief, self._sample(self.prior_logits(belief), None)

    @property
    def latent_format(self) -> LatentFormat:
        """Format in which a replay buffer stores the latents."""
        return LatentFormat(self.initial_belief.shape[-1], self.latents, self.classes, self.sampled)

    def prior_logits(self, belief: Tensor) -> Tensor:
        """Map beliefs ``(..., D)`` to the prior's logits ``(..., L, K)``."""
        return self.prior(belief).float().unflatten(-1, (self.latents, self.classes))

    def draw_noise(self, *batch: int) -> Tensor:
        """Draw the uniform noise for sampling states of a batch, ``(*batch, L, 1)``."""
        return torch.rand(*batch, self.latents, 1, device=self.initial_belief.device)

    def observe(
        self,
        embedding: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        initial: tuple[Tensor, Tensor] | None = None,
        deterministic: bool = False,
    ) -> Posterior:
        """Infer the latents of a sequence of observations.

        Args:
            embedding: ``(B, T, E)``.
            previous_action: The action that led to each observation, ``(B, T, A)``.
            is_init: Whether each observation is its episode's first, bool ``(B, T)``.
            initial: Belief ``(B, D)`` and state ``(B, S)`` before the sequence; by default those of an episode's start.
            deterministic: Take the posterior's mode instead of a sample.
        """
        batch, time = is_init.shape
        start = self.initial()
        belief, state = initial or (value.expand(batch, -1) for value in start)
        resets = is_init.unsqueeze(-1)
        actions = self._project_action(previous_action, resets).unbind(1)
        embeddings = self.posterior_hidden.project(embedding).unbind(1)
        noises = [None] * time if deterministic else self.draw_noise(time, batch).unbind(0)
        # Autocast's type represents one-hots exactly.
        low = autocast_type(belief.device.type) if self.few_kernels and self.sampled else None
        dtype = low or belief.dtype
        begin = self._begin_steps(resets, (start[0], start[1].to(dtype)))
        beliefs, states, logits = [], [], []
        steps = time if self.few_kernels else None
        with unrolled(self.cell, self.posterior_hidden, self.posterior_output, steps=steps):
            for at, (action, embedded, noise) in enumerate(zip(actions, embeddings, noises, strict=True)):
                belief, state = begin(at, belief, state)
                belief = self.cell(belief, state, action)
                logits.append(self._posterior_logits(belief, embedded))
                state = self._sample(logits[-1], noise, dtype=dtype)
                beliefs.append(belief)
                states.append(state)
        belief = torch.stack(beliefs, 1)
        state = torch.stack(states, 1).float()
        return Posterior(belief, state, torch.stack(logits, 1), self.prior_logits(belief))

    def observe_step(
        self,
        embedding: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        belief: Tensor,
        state: Tensor,
        deterministic: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return belief and state after one more observation, for acting; the same maths as one step of ``observe``.

        Args:
            embedding: ``(N, E)``.
            previous_action: ``(N, A)``.
            is_init: bool ``(N,)``.
            belief: The previous belief, ``(N, D)``.
            state: The previous state, ``(N, S)``.
            deterministic: Take the posterior's mode instead of a sample.
        """
        belief = self.advance(previous_action, is_init, belief, state)
        return belief, self.posterior_state(belief, embedding, deterministic)

    def advance(self, previous_action: Tensor, is_init: Tensor, belief: Tensor, state: Tensor) -> Tensor:
        """Return the next belief ``(N, D)``, which needs no observation; arguments as in ``observe_step``."""
        reset, start = is_init.unsqueeze(-1), self.initial()
        action = self._project_action(previous_action, reset)
        return self.cell(torch.where(reset, start[0], belief), torch.where(reset, start[1], state), action)

    def posterior_state(self, belief: Tensor, embedding: Tensor, deterministic: bool = False) -> Tensor:
        """Return the posterior state ``(N, S)`` for the next belief and an embedding, as in ``observe_step``."""
        noise = None if deterministic else self.draw_noise(len(belief))
        return self._sample(self.posterior_logits(belief, embedding), noise)

    def posterior_logits(self, belief: Tensor, embedding: Tensor) -> Tensor:
        """Map beliefs ``(..., D)`` and embeddings ``(..., E)`` to the posterior's logits ``(..., L, K)``."""
        return self._posterior_logits(belief, self.posterior_hidden.project(embedding))

    def imagine_step(
        self, belief: Tensor, state: Tensor, action: Tensor, deterministic: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Predict belief ``(N, D)`` and state ``(N, S)`` of the next step without an observation.

        Args:
            belief: ``(N, D)``.
            state: ``(N, S)``.
            action: ``(N, A)``.
            deterministic: Take the prior's mode instead of a sample.
        """
        belief = self.cell(belief, state, self.cell.project_action(action.clamp(-1.0, 1.0)))
        noise = None if deterministic else self.draw_noise(len(belief))
        return belief, self._sample(self.prior_logits(belief), noise)

    def _begin_steps(self, resets: Tensor, start: tuple[Tensor, Tensor]) -> StepStart:
        """Return the function that replaces the latents before a step by an episode's start where it is reset.

        ``torch.where`` takes one kernel forward and four backward, which make the zero gradients of the other choice;
        ``few_kernels`` uses a multiplication, with one and one. ``resets`` is ``(B, T, 1)``.
        """
        if not self.few_kernels:
            choices = resets.unbind(1)
            return lambda at, *latents: tuple(map(partial(torch.where, choices[at]), start, latents))
        starts = [(value.unsqueeze(1) * resets).unbind(1) for value in start]
        stays = ~resets
        kept = [stays.to(value.dtype).unbind(1) for value in start]
        return lambda at, *latents: tuple(
            torch.addcmul(begins[at], before.to(begins[at].dtype), goes_on[at])
            for begins, goes_on, before in zip(starts, kept, latents, strict=True)
        )

    def imagine_few_kernels(
        self, belief: Tensor, features: Tensor, action: Tensor, noise: Tensor, following: Tensor
    ) -> Tensor:
        """Do the same as ``imagine_step``, but cast latents only once, and write the next ones into a given tensor.

        Args:
            belief: ``(N, D)``.
            features: Belief and state in autocast's type, ``(N, F)``.
            action: ``(N, A)``.
            noise: ``(N, L, 1)``.
            following: Zeros of that type, ``(N, F)``, to which the next belief and state are written.

        Returns:
            The next belief, in the type of ``belief``.
        """
        width = belief.shape[-1]
        action = self.cell.project_action(action.clamp(-1.0, 1.0))
        belief = self.cell(belief, features[:, width:], action, features[:, :width])
        low, state = following[:, :width], following[:, width:]
        logits = self.prior_logits(low.copy_(belief))
        sample = self._sample(logits, noise, state.unflatten(-1, (self.latents, self.classes)))
        if not self.sampled:
            state.copy_(sample)
        return belief

    def _project_action(self, previous_action: Tensor, reset: Tensor) -> Tensor:
        """Clip actions ``(..., A)``, set them to zero where ``reset``, and project them."""
        return self.cell.project_action(previous_action.clamp(-1.0, 1.0).masked_fill(reset, 0.0))

    def _posterior_logits(self, belief: Tensor, embedded: Tensor) -> Tensor:
        """Map beliefs ``(..., D)`` and projected embeddings ``(..., U)`` to the posterior's logits ``(..., L, K)``."""
        logits = self.posterior_output(self.posterior_hidden(belief, embedded))
        return logits.float().unflatten(-1, (self.latents, self.classes))

    def _sample(
        self, logits: Tensor, noise: Tensor | None, blank: Tensor | None = None, dtype: torch.dtype | None = None
    ) -> Tensor:
        """Return states ``(..., S)`` for logits ``(..., L, K)``; other arguments as in ``sample_one_hot``."""
        if self.few_kernels:
            probabilities = torch.lerp(torch.softmax(logits, -1), self.uniform, self.unimix)
        else:
            probabilities = mix_uniform(logits, self.unimix)
        return (sample_one_hot(probabilities, noise, blank, dtype) if self.sampled else probabilities).flatten(-2)
