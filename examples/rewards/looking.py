"""Eq. 1 and a reward for looking at the next gate; from this folder: `env.reward=looking:looking`.

The rewards of this project do not say where to look; others' do (Geles et al., "Demonstrating agile flight from pixels
without state estimation", RSS 2024). What it did for Kidney from images alone: docs/kidney_from_images.md.
"""

import math

import torch

from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.own import Transition

WEIGHT = 0.3  # a control step, if the gate is in the middle of the image; this project's choice
TILT = math.radians(25.0)  # of the camera, upwards


def looking(step: Transition) -> torch.Tensor:
    """Return (N,) the default reward, and the weighted cosine of the angle between camera and target gate."""
    drone = step.after
    forward = torch.tensor([math.cos(TILT), 0.0, math.sin(TILT)]).to(drone.position).expand_as(drone.position)
    way = drone.gate_position - drone.position
    cosine = (rotate(drone.attitude, forward) * way).sum(-1) / way.norm(dim=-1).clamp_min(1e-3)
    return step.default_reward + WEIGHT * cosine.to(step.default_reward)
