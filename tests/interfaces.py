"""The same flight of one drone by every interface that is made of NumPy's arrays."""

from typing import Any

import gymnasium
import numpy as np

from dreamer_racing.envs.gym_env import row_of
from dreamer_racing.envs.gym_vector_env import DroneRaceVectorEnv
from dreamer_racing.envs.sb3_env import DroneRaceVecEnv


def flights(action: np.ndarray, steps: int, **options: Any) -> dict[str, list[Any]]:
    """Observations of a flight on the circle by interface: after a reset, and after each step of the same action."""
    seed = options["seed"]
    single = gymnasium.make("dreamer_racing/Circle-v0", **options)
    vector = DroneRaceVectorEnv(1, "circle", **options)
    several = DroneRaceVecEnv("circle", 1, **options)
    several.seed(seed)
    seen = {
        "single": [single.reset(seed=seed)[0], *(single.step(action)[0] for _ in range(steps))],
        "vector": [vector.reset(seed=seed)[0], *(vector.step(action[None])[0] for _ in range(steps))],
        "several": [several.reset(), *(several.step(action[None])[0] for _ in range(steps))],
    }
    assert all(each in single.observation_space for each in seen["single"])
    for env in (single, vector, several):
        env.close()
    return {name: each if name == "single" else [row_of(rows, 0) for rows in each] for name, each in seen.items()}
