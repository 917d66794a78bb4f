"""What every learner offers, and every policy that is flown."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

Timer = Callable[[str], AbstractContextManager]
"""Context manager by the name of an activity, as ``RunClock.timed``."""


ValueFunction = Callable[[TensorDictBase], Tensor]
"""What a critic expects: of records [N] that the evaluation's policy has acted on, the return from there, (N, 1)."""


class Policy(Protocol):
    """The acting step: a module on tensordicts of batch size [N] that writes ``action``, as `BaselinePolicy` is."""

    deterministic: bool
    """Whether it takes modes instead of samples; may be set at any time, and evaluations do."""

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, and what the policy remembers."""
        ...

    def make_primer(self) -> Transform:
        """Make the transform that adds what the policy remembers to an environment; an empty ``Compose`` if nothing."""
        ...


class Evaluable(Protocol):
    """What can be evaluated: every learner, and a `ShippedAgent`.

    Attributes:
        device: Where it acts, and learns if it does.
    """

    device: torch.device

    def evaluation_policy(self) -> Policy:
        """Return the acting step to evaluate, which may be one of averaged weights."""
        ...

    def value_function(self) -> ValueFunction | None:
        """Return what the critic that teaches the actor makes of a state; None without one."""
        ...


class Learner(Evaluable, Protocol):
    """What every learner offers to recipes and evaluations: `DreamerV3`, `LatentPPO`, `PPOLearner` and `SACLearner` do.

    Attributes:
        updates: Those made so far.
    """

    updates: int

    def policy(self) -> Policy:
        """Return the acting step that is trained, which shares the learner's parameters."""
        ...

    def update(self, batch: TensorDictBase, /, timed: Timer = ...) -> dict[str, Tensor]:
        """Learn from replayed records or a rollout; return losses and metrics, scalar tensors by their names."""
        ...

    def check_finite(self) -> None:
        """Raise ``NonFiniteLossError`` if an update was not finite."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, but for the global random generators."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        ...


def untimed(activity: str) -> AbstractContextManager:
    """Measure nothing."""
    return nullcontext()


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw initial weights by a seed, without a trace in the global generator; None draws them from that."""
    with torch.random.fork_rng(devices=[], enabled=seed is not None):
        if seed is not None:
            torch.default_generator.manual_seed(seed)  # of weights drawn on the CPU; CUDA's generators stay as they are
        yield
