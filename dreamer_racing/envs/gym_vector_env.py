"""The race for Gymnasium, N drones in one process: `gymnasium.make_vec("dreamer_racing/Kidney-v0", num_envs=16)`.

Spaces and the entries of `info` are those of `dreamer_racing.envs.gym_env`, batched. Shapes: N environments.
"""

from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.gym_env import GymWorlds, Observation, row_of, with_rows
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import WorldOptions, check_options
from dreamer_racing.settings import check_numbers, without_none


class DroneRaceVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """N drones racing in parallel in one process, much faster than N single environments.

    Ended episodes are reset in one of Gymnasium's modes. NEXT_STEP: the step in which an episode ends returns its last
    observation; the next step ignores that environment's action and returns the first observation of the next episode
    with reward 0. SAME_STEP: the step itself returns the first observation of the next episode, and `info` the last
    one of the old (`final_obs`, an array of objects, and `final_info`). DISABLED: the caller resets, by
    `reset(options={"reset_mask": ended})`, as TorchRL's `GymWrapper` does. `final_obs` and `final_info` are present
    only for environments whose episode ended; all other entries of `info` for every environment
    (`info["_" + name]` is all true), with the values after the reset where there was one.

    Args:
        num_envs: N.
        max_episode_steps: control steps until an episode is truncated; Gymnasium's name for `episode_steps`.
        autoreset_mode: `NextStep`, `SameStep` or `Disabled`.
        worlds: further arguments of `RaceWorlds`; see `WorldOptions`. All other arguments and the errors are those of
            `DroneRaceGymEnv`.

    Example:
        >>> envs = gymnasium.make_vec("dreamer_racing/Kidney-v0", num_envs=16, observation="state")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["position"].shape
        (16, 3)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        track: str | Track = "kidney",
        observation: str = "pixels",
        render_mode: str | None = None,
        privileged: bool = False,
        body_rate_weight: float | None = None,
        preset: str | QuadrotorParameters = "easy",
        render_view: str = "chase",
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **worlds: Unpack[WorldOptions],
    ) -> None:
        check_options(DroneRaceVectorEnv, worlds, WorldOptions)
        self.autoreset_mode = _mode(autoreset_mode)
        if max_episode_steps is not None:
            steps = worlds.get("episode_steps")
            check_numbers(whole=without_none(max_episode_steps=max_episode_steps, episode_steps=steps), real={})
            worlds["episode_steps"] = max_episode_steps if steps is None else min(max_episode_steps, steps)
        self.race = GymWorlds(
            track, num_envs, observation, privileged, body_rate_weight, render_mode, preset, render_view, worlds
        )
        own = {"render_fps": self.race.frames_per_second, "autoreset_mode": self.autoreset_mode}
        self.metadata = {**self.metadata, **own}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_action_space = self.race.action_space()
        self.single_observation_space = self.race.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in all or the masked environments; a seed makes all that follows reproducible.

        Args:
            seed: one seed for all environments.
            options: `reset_mask`, (N,) bool: environments to reset; the others fly on.

        Raises:
            ResetNeeded: a partial reset before the first reset of all environments.
            ValueError: the seed is a list, but all environments share one generator; or the mask is invalid.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise ValueError(f"seed={seed!r}: must be one number, for all {self.num_envs} environments together.")
        mask = self._reset_mask(options)
        super().reset(seed=seed)
        if seed is not None:
            self.race.worlds.seed(int(seed))
        self.race.begin(None if mask.all() else mask)
        self._ended &= ~mask
        return self.race.observe(), self._masked(self.race.info(None), mask)

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Simulate one control step, or begin the next episode where one has ended.

        Args:
            actions: (N, 4); values beyond [-1, 1] are clipped, a non-finite value is a crash of its drone.

        Raises:
            ResetNeeded: in mode DISABLED, an ended episode has not been reset.
            ValueError: wrong shape.
        """
        reset_now = self._ended
        if reset_now.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            where = reset_now.nonzero()[0].tolist()
            raise gymnasium.error.ResetNeeded(f"Episodes {where} have ended: reset them by a reset_mask before step().")
        outcome, reward = self.race.step(actions)
        if reset_now.any():
            self.race.begin(reset_now)
        terminated = outcome.terminated.numpy() & ~reset_now
        truncated = outcome.truncated.numpy() & ~reset_now
        ended = terminated | truncated
        step_info = self.race.info(outcome, reset_now)
        info = self._masked(step_info)
        observation = self.race.observe()
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            info |= self._final(observation, ended)
            info |= {"final_info": self._masked(step_info, ended), "_final_info": ended}
            self.race.begin(ended)
            info |= self._masked(self.race.info(outcome, ended))
            observation = with_rows(observation, ended, self.race.observe(ended))
            ended = np.zeros_like(ended)
        self._ended = ended
        return observation, np.where(reset_now, 0.0, reward), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return the chase or onboard views, N images uint8 (256, 256, 3); None without a render mode."""
        return tuple(self.race.frames()) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Free rendering contexts and threads."""
        self.race.close()

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if getattr(mask, "dtype", None) != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask={mask!r}: must be an array of {self.num_envs} bool, with at least one true.")
        return mask

    def _final(self, observation: Observation, ended: np.ndarray) -> dict[str, np.ndarray]:
        """Return the last observation of each episode that ended, None elsewhere, in Gymnasium's format."""
        final = np.full(self.num_envs, None, dtype=object)
        for index in ended.nonzero()[0]:
            final[index] = row_of(observation, int(index))
        return {"final_obs": final, "_final_obs": ended}

    def _masked(self, info: dict[str, Any], mask: np.ndarray | None = None) -> dict[str, Any]:
        """Add Gymnasium's masks of the environments that have an entry: all, or those of the mask (N,) bool."""
        there = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        entries = {
            name: self._masked(value, mask) if isinstance(value, dict) else value for name, value in info.items()
        }
        return entries | {f"_{name}": there.copy() for name in info}


def _mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(repr(known.value) for known in AutoresetMode)
        raise ValueError(f"autoreset_mode={mode!r}: choose one of {known}.") from error
