"""Configuration of a world-model learner's update."""

from __future__ import annotations

from dataclasses import dataclass

from dreamer_racing.losses.config import HORIZON
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, setting


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
            gains and biases after the loop over T, with ``reinforce`` draw imagination's noise in advance. Rounding and
            samples differ. None turns it on for CUDA devices, where launching a small kernel takes longer than running
            it.
        mixed_precision: Compute the losses under bfloat16 autocast; parameters, logits and losses stay float32. The
            recipes replace None by whether the device gains by it; otherwise None means False.
        learning_rate: Learning rate. The reference's 4e-5 suits large models; small ones learn faster at 1e-4 to 3e-4.
        behavior_learning_rate: Learning rate of actor and critic, in latent PPO only of the critic that shapes the
            latents; None for the same. A lower one gives the world model a lead over a policy that exploits its errors;
            the 2023 code had 3e-5 beside 1e-4.
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
