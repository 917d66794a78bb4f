"""Drone racing from pixels: environments for TorchRL, dm_control and Gymnasium, and world-model agents for them.

Importing the package registers its Gymnasium environments, `dreamer_racing/Kidney-v0` and the other tracks; it loads
neither torch nor MuJoCo.
"""

from gymnasium.envs.registration import register

GYM_ENVIRONMENTS = {"Circle": "circle", "Kidney": "kidney", "Figure8": "figure8", "SplitS": "split_s"}

for _name, _track in GYM_ENVIRONMENTS.items():
    register(
        id=f"dreamer_racing/{_name}-v0",
        entry_point="dreamer_racing.envs.gym_env:DroneRaceGymEnv",
        vector_entry_point="dreamer_racing.envs.gym_vector_env:DroneRaceVectorEnv",
        kwargs={"track": _track},
    )
