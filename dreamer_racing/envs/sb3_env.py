"""The race for Stable-Baselines3: N drones in one process as a `VecEnv`.

Spaces and the entries of `info` are those of `dreamer_racing.envs.gym_env`. Stable-Baselines3 is an optional
dependency: `pip install -e '.[sb3]'`. Shapes: N environments.
"""

from collections.abc import Sequence
from typing import Any, Unpack, cast

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.gym_env import GymWorlds, Observation, row_of, rows_of, with_rows
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import WorldOptions, check_options

_ONE_OBJECT = (
    "the drones of DroneRaceVecEnv share one object, so nothing can be set or called for each. Pass arguments to its "
    "constructor; later only `race.body_rate_weight` can be changed, for all drones together."
)


class DroneRaceVecEnv(VecEnv):
    """N drones racing in parallel, much faster than N single environments in a `DummyVecEnv`.

    As in every `VecEnv`, an episode that ends is reset in the same step: `info` then has `terminal_observation`, and
    `TimeLimit.truncated`, true if it was truncated and not a crash. A seed set by `seed` makes all drones
    reproducible from the next `reset` on.

    Args:
        num_envs: N.
        worlds: further arguments of `RaceWorlds`; see `WorldOptions`. All other arguments and the errors are those of
            `DroneRaceGymEnv`.

    Example:
        >>> env = DroneRaceVecEnv("circle", num_envs=16, observation="vector")
        >>> env.reset().shape
        (16, 21)
    """

    def __init__(
        self,
        track: str | Track = "kidney",
        num_envs: int = 16,
        observation: str = "pixels",
        render_mode: str | None = None,
        privileged: bool = False,
        body_rate_weight: float | None = None,
        preset: str | QuadrotorParameters = "easy",
        render_view: str = "chase",
        **worlds: Unpack[WorldOptions],
    ) -> None:
        check_options(DroneRaceVecEnv, worlds, WorldOptions)
        self.race = GymWorlds(
            track, num_envs, observation, privileged, body_rate_weight, render_mode, preset, render_view, worlds
        )
        self.render_mode = render_mode
        self._actions = np.zeros((num_envs, *self.race.action_space().shape), np.float32)
        super().__init__(num_envs, self.race.observation_space(), self.race.action_space())
        cast(dict[str, Any], self.metadata)["render_fps"] = self.race.frames_per_second

    def reset(self) -> Observation:
        """Begin an episode in all environments."""
        if self._seeds[0] is not None:
            self.race.worlds.seed(self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self.race.begin()
        self.reset_infos = rows_of(self.race.info(None))
        return self.race.observe()

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N, 4) that `step_wait` applies; values beyond [-1, 1] are clipped."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Simulate one control step; return observations, rewards (N,), dones (N,) and N `info`.

        Raises:
            ValueError: actions of the wrong shape.
        """
        outcome, rewards = self.race.step(self._actions)
        terminated, truncated = outcome.terminated.numpy(), outcome.truncated.numpy()
        ended = terminated | truncated
        observation, infos = self.race.observe(), rows_of(self.race.info(outcome))
        for index, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncated[index])
            if ended[index]:
                info["terminal_observation"] = row_of(observation, index)
        if ended.any():
            observation = self._begin(ended, observation)
        return observation, rewards.astype(np.float32), ended, infos

    def _begin(self, mask: np.ndarray, observation: Observation) -> Observation:
        """Begin episodes where masked (N,) bool; return the observations with these rows replaced by the first ones."""
        self.race.begin(mask)
        info = self.race.info(None)
        for index in np.flatnonzero(mask).tolist():
            self.reset_infos[index] = row_of(info, index)
        return with_rows(observation, mask, self.race.observe(mask))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return the chase or onboard views, N images uint8 (256, 256, 3); None without a render mode."""
        return list(self.race.frames()) if self.render_mode == "rgb_array" else [None] * self.num_envs

    def close(self) -> None:
        """Free rendering contexts and threads."""
        self.race.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return this object's attribute, once for each selected drone."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise an error: the drones share one object."""
        raise NotImplementedError(f"set_attr({attr_name!r}): {_ONE_OBJECT}")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> Any:
        """Raise an error: the drones share one object."""
        raise NotImplementedError(f"env_method({method_name!r}): {_ONE_OBJECT}")

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each selected drone: none is wrapped individually."""
        return [False for _ in self._get_indices(indices)]
