"""Numbers of an update with a world model, beside those of the losses."""

from __future__ import annotations

from dataclasses import dataclass

from dreamer_racing.losses.config import HORIZON
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, setting


@dataclass
class LearnerConfig:
    """Numbers of an update, beside those of its losses.

    Attributes:
        imagination_horizon: H, imagined actions from each start; also how far ahead the world model is measured.
        imagination_starts: Imagine from a random subset of so many records of the batch; None from all of them.
        average_rate: Fraction by which the averaged weights, which fly evaluations and exports, move at each update;
            None keeps none.
        slow_critic_rate: Fraction by which the slow critic moves at each update.
        cuda_graph: On a CUDA device, replay forward and backward as one CUDA graph. None, which the recipes replace by
            whether the run can, is False.
        few_kernels: Save kernels: weights are cast once an update instead of at every use (with ``mixed_precision``),
            gradients of gains and biases are summed after the loop over T, the noise of imagination is drawn ahead of
            it. That rounds elsewhere and imagines other samples. None: on a CUDA device, where a small kernel's launch
            takes longer than its work.
        mixed_precision: Compute the losses under bfloat16 autocast; parameters, logits and losses stay float32. None,
            which the recipes replace by what the device does well, is False.
        learning_rate: The reference's 4e-5 suits large models, small ones learn faster at 1e-4 to 3e-4.
        behavior_learning_rate: Of actor and critic; None for the same. A lower one lets the world model get ahead of
            the policy that exploits its mistakes; the 2023 code had 1e-4 and 3e-5.
        warmup_updates: Updates over which the learning rate rises from zero.

    Reference: danijar/dreamerv3, ``configs.yaml``.
    """

    imagination_horizon: int = setting(HORIZON, COUNT)
    imagination_starts: int | None = setting(None, COUNT)
    average_rate: float | None = setting(None, POSITIVE_SHARE)
    slow_critic_rate: float = setting(0.02, SHARE)
    cuda_graph: bool | None = None
    few_kernels: bool | None = None
    mixed_precision: bool | None = None
    learning_rate: float = setting(4e-5, POSITIVE)
    behavior_learning_rate: float | None = setting(None, POSITIVE)
    warmup_updates: int = setting(1000, NOT_NEGATIVE)
