"""Protocols of learners and policies, and the settings that world-model learners share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from dreamer_racing.losses.config import HORIZON
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, setting

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


@dataclass
class LearnerConfig:
    """Settings of an update, without those of its losses.

    Attributes:
        imagination_horizon: H, imagined actions from each start; also the horizon at which the world model's
            predictions are evaluated.
        imagination_starts: Number of random records of the batch from which imagination starts; None for all of them.
        imagination_every: Actor and critic learn in imagination in every n-th update; in the others the world model
            learns, and the critic from replayed returns. The reference has 1.
        average_rate: Rate of the exponential moving average of the weights, which evaluations and exports use; None
            keeps no average.
        slow_critic_rate: Fraction by which the slow critic moves towards the critic at each update.
        cuda_graph: Replay forward and backward pass as one CUDA graph. The recipes replace None by whether the run
            supports it; otherwise None means False.
        few_kernels: Launch fewer kernels: cast weights once per update (with ``mixed_precision``), sum the gradients of
            gains and biases after the loop over T, draw imagination's noise in advance. Rounding and samples differ.
            None turns it on for CUDA devices, where launching a small kernel takes longer than running it.
        mixed_precision: Compute the losses under bfloat16 autocast; parameters, logits and losses stay float32. The
            recipes replace None by whether the device gains by it; otherwise None means False.
        learning_rate: Learning rate. The reference's 4e-5 suits large models; small ones learn faster at 1e-4 to 3e-4.
        behavior_learning_rate: Learning rate of actor and critic; None for the same. A lower one gives the world model
            a lead over a policy that exploits its errors; the 2023 code had 3e-5 beside 1e-4.
        warmup_updates: Updates over which the learning rate rises from zero.

    Reference: danijar/dreamerv3, ``configs.yaml``.
    """

    imagination_horizon: int = setting(HORIZON, COUNT)
    imagination_starts: int | None = setting(None, COUNT)
    imagination_every: int = setting(1, COUNT)
    average_rate: float | None = setting(None, POSITIVE_SHARE)
    slow_critic_rate: float = setting(0.02, SHARE)
    cuda_graph: bool | None = None
    few_kernels: bool | None = None
    mixed_precision: bool | None = None
    learning_rate: float = setting(4e-5, POSITIVE)
    behavior_learning_rate: float | None = setting(None, POSITIVE)
    warmup_updates: int = setting(1000, NOT_NEGATIVE)


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
