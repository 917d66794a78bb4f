"""The same flight of one drone by every interface."""

from typing import Any

import gymnasium
import numpy as np
import torch
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs.gym_env import row_of
from dreamer_racing.envs.gym_vector_env import DroneRaceVectorEnv
from dreamer_racing.envs.sb3_env import DroneRaceVecEnv
from dreamer_racing.envs.torchrl_env import DroneRacingEnv


def flights(
    action: np.ndarray, steps: int, key: str, observation: str = "pixels", **options: Any
) -> dict[str, list[np.ndarray]]:
    """An entry of the observations of a flight on the circle: after a reset, and after each step of the same action.

    TorchRL's checker has found nothing.
    """
    seed, of_arrays = options["seed"], {**options, "observation": observation}
    single = gymnasium.make("dreamer_racing/Circle-v0", **of_arrays)
    vector = DroneRaceVectorEnv(1, "circle", **of_arrays)
    several = DroneRaceVecEnv("circle", 1, **of_arrays)
    several.seed(seed)
    torchrl = DroneRacingEnv("circle", 1, **options)
    check_env_specs(torchrl)
    torchrl.set_seed(seed)
    data = [torchrl.reset()]
    for _ in range(steps):
        data.append(torchrl.step(data[-1].set("action", torch.from_numpy(action)[None]))["next"])
    seen = {
        "single": [single.reset(seed=seed)[0], *(single.step(action)[0] for _ in range(steps))],
        "vector": [vector.reset(seed=seed)[0], *(vector.step(action[None])[0] for _ in range(steps))],
        "several": [several.reset(), *(several.step(action[None])[0] for _ in range(steps))],
    }
    assert all(each in single.observation_space for each in seen["single"])
    for env in (single, vector, several, torchrl):
        env.close()
    rows = {name: each if name == "single" else [row_of(batch, 0) for batch in each] for name, each in seen.items()}
    found = {name: [row[key] if isinstance(row, dict) else row for row in each] for name, each in rows.items()}
    return {**found, "torchrl": [each[key][0].numpy() for each in data]}
