"""Protocols of learners and policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

Timer = Callable[[str], AbstractContextManager]
"""Function from the name of an activity to a context manager that times it, such as ``RunClock.timed``."""


ValueFunction = Callable[[TensorDictBase], Tensor]
"""Function from records [N] that the evaluation policy has acted on to the critic's expected returns, (N, 1)."""


class Policy(Protocol):
    """Policy: a module on tensordicts of batch size [N] that writes ``action``, such as `BaselinePolicy`."""

    deterministic: bool
    """Whether it acts without sampling; may be set at any time, and evaluations set it."""

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the policy's recurrent state."""

    def make_primer(self) -> Transform:
        """Make the transform that adds the policy's recurrent state to an environment; an empty ``Compose`` if none."""


class Evaluable(Protocol):
    """Protocol of what can be evaluated: every learner, and a `ShippedAgent`."""

    device: torch.device
    """Where its networks are."""

    def evaluation_policy(self) -> Policy:
        """Return the policy to evaluate, which may have averaged weights."""

    def value_function(self) -> ValueFunction | None:
        """Return the value function of the critic that the actor learns from; None without one."""


class Learner(Evaluable, Protocol):
    """Protocol of learners: `DreamerV3`, `LatentPPO`, `PPOLearner` and `SACLearner`."""

    updates: int
    """Number of updates so far."""

    def policy(self) -> Policy:
        """Return the policy that is trained, which shares the learner's parameters."""

    def update(self, batch: TensorDictBase, /, timed: Timer = ...) -> dict[str, Tensor]:
        """Learn from replayed records or a rollout; return losses and metrics, scalar tensors by their names."""

    def check_finite(self) -> None:
        """Raise ``NonFiniteLossError`` if an update was not finite."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, except the global random generators."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""


def untimed(activity: str) -> AbstractContextManager:
    """Return a context that measures nothing, the default ``Timer``."""
    return nullcontext()


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Seed the CPU's random generator, and restore its state afterwards; None leaves the generator alone."""
    with torch.random.fork_rng(devices=[], enabled=seed is not None):
        if seed is not None:
            torch.default_generator.manual_seed(seed)  # initial weights are drawn on the CPU; not CUDA's generators
        yield
