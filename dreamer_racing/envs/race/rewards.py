"""The racing reward, split so that a replayed step can be given today's body-rate weight.

Shape legend: N drones. SI units. Reference: paper, Eq. 1.
"""

from __future__ import annotations

import dataclasses

import torch

from dreamer_racing.settings import FINITE, check_settings, setting


@dataclasses.dataclass(frozen=True)
class RewardWeights:
    """The weights of Eq. 1.

    Args:
        progress: b₁, reward for each metre nearer to the target gate. Reference: paper, Table of reward parameters.
        body_rate: b₂, penalty for each rad/s of body rate; a curriculum raises it to 0.01.
        gate: reward of a control step in which the target gate was passed, instead of progress.
        collision: reward of a control step that ends in a crash, instead of everything else.

    Raises:
        ValueError: a weight is no finite number.
    """

    progress: float = setting(1.0, FINITE)
    body_rate: float = setting(0.0, FINITE)
    gate: float = setting(10.0, FINITE)
    collision: float = setting(-4.0, FINITE)

    def __post_init__(self) -> None:
        check_settings(self, "RewardWeights.")


def race_reward(
    weights: RewardWeights,
    gate_position: torch.Tensor,
    previous_position: torch.Tensor,
    position: torch.Tensor,
    body_rates: torch.Tensor,
    passes: torch.Tensor,
    crashed: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the two parts of Eq. 1; the reward is ``reward_base - weights.body_rate * body_rate_norm``.

    A crash outweighs a pass of the same step. Both distances are to the gate that was the target during the step, so
    after a pass the next step measures both to the new gate. Values that are not finite are allowed where crashed.

    Args:
        weights: the weights of Eq. 1; ``body_rate`` is left to the caller.
        gate_position: centre of each drone's target gate, (N, 3), m.
        previous_position: position at the last control step, (N, 3), m.
        position: position now, (N, 3), m.
        body_rates: angular velocity, (N, 3), rad/s.
        passes: gates passed in this step, each of which is paid, (N,) int64.
        crashed: the drone crashed in this step, (N,) bool.

    Returns:
        ``reward_base`` (N,), the reward at b₂ = 0, and ``body_rate_norm`` (N,), rad/s: ‖ω‖ where Eq. 1 has a rate term,
        0 on a pass or a crash.

    Reference: paper, Eq. 1.
    """
    progress = (gate_position - previous_position).norm(dim=-1) - (gate_position - position).norm(dim=-1)
    passed = passes > 0
    reward_base = torch.where(passed, weights.gate * passes, weights.progress * progress)
    reward_base = torch.where(crashed, weights.collision, reward_base)
    body_rate_norm = torch.where(passed | crashed, 0.0, body_rates.norm(dim=-1))
    return reward_base, body_rate_norm
