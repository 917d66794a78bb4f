"""Worlds for workers of tests, which import this file by its name."""

from __future__ import annotations

from torchrl.envs import TensorDictPrimer, TransformedEnv

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.torchrl_env import DroneRacingEnv


def small_race(num_envs: int) -> DroneRacingEnv:
    """Worlds with short episodes and no images."""
    return DroneRacingEnv(
        "circle", num_envs, from_pixels=False, privileged=False, seed=0, episode_steps=12, num_threads=1
    )


def worlds_of_worker(num_envs: int, primer: TensorDictPrimer) -> TransformedEnv:
    """The same, with the keys of a policy's memory."""
    return with_memory(small_race(num_envs), primer)
