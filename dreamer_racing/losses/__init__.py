"""Losses of the world model, the policy and the critic: pure functions and small modules.

``find_targets`` and ``find_objective`` also import a user's own ones; ``docs/losses.md`` says how to write them.
"""

from dreamer_racing.losses.config import HORIZON, DreamerV3Losses, LatentPPOLosses, LossConfig, PPOUpdateConfig
from dreamer_racing.losses.imagination import Imagination, Starts, choose_starts, imagine
from dreamer_racing.losses.policy import (
    OBJECTIVES,
    Objective,
    Trajectory,
    clipped_surrogate,
    dynamics,
    find_objective,
    gradient_of_actions,
    normalized,
    policy_drift,
    reinforce,
    through_dynamics,
)
from dreamer_racing.losses.returns import critic_loss, lambda_return, replay_critic_loss, replay_return, rollout_return
from dreamer_racing.losses.world_model import (
    TARGETS,
    Barlow,
    Image,
    Latents,
    State,
    Target,
    Vector,
    WorldModelLoss,
    find_targets,
    joined,
    kl_losses,
    open_loop_loss,
)

__all__ = [
    "HORIZON",
    "OBJECTIVES",
    "TARGETS",
    "Barlow",
    "DreamerV3Losses",
    "Image",
    "Imagination",
    "LatentPPOLosses",
    "Latents",
    "LossConfig",
    "Objective",
    "PPOUpdateConfig",
    "Starts",
    "State",
    "Target",
    "Trajectory",
    "Vector",
    "WorldModelLoss",
    "choose_starts",
    "clipped_surrogate",
    "critic_loss",
    "dynamics",
    "find_objective",
    "find_targets",
    "gradient_of_actions",
    "imagine",
    "joined",
    "kl_losses",
    "lambda_return",
    "normalized",
    "open_loop_loss",
    "policy_drift",
    "reinforce",
    "replay_critic_loss",
    "replay_return",
    "rollout_return",
    "through_dynamics",
]
