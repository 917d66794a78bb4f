"""The race for Gymnasium: `gymnasium.make("dreamer_racing/Kidney-v0")` and `gymnasium.make_vec(..., num_envs=16)`.

Action: `Box(-1, 1, (4,), float32)`: collective thrust, body rates x, y, z. Observation, by the argument `observation`:

| `observation` | space |
|---|---|
| `"pixels"` | `Box(0, 255, (height, width, 3), uint8)`, the nose camera, 64 × 64 by default |
| `"vector"` | `Box(-inf, inf, (21,), float32)`, the race in the drone's own frame, see `RaceVector` |
| `"state"` | `Dict` of `position`, `attitude` (wxyz), `linear_velocity` (world), `body_rates` (body), `target_gate` |
| `"both"` | the same `Dict` with `pixels` |

`render` draws the on-board view, larger (`render_mode="rgb_array"`). All in SI units.

`info` has `gates_passed`, `gate_offset` m, `lap_time` s, `crash` (name of the `CrashCause`, `"none"` while flying),
`finished`, `reward_base` and `body_rate_norm` rad/s (`reward = reward_base − b₂ · body_rate_norm`), and with
`privileged=True` a dictionary `privileged` of the state. Zeros after a reset.

Importing `dreamer_racing` registers the environments; `gymnasium.make("dreamer_racing:dreamer_racing/Kidney-v0")` does
both. Shapes: N environments.
"""

from dataclasses import replace
from typing import Any, Unpack

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import wrong_action_type
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.race import RaceStep
from dreamer_racing.envs.race.race_vector import RACE_VECTOR_SIZE
from dreamer_racing.envs.simulator.rendering import Renderer, make_renderer
from dreamer_racing.envs.simulator.scene import build_scene
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import ACTION_SIZE, RaceWorlds, WorldOptions

OBSERVATIONS = ("pixels", "vector", "state", "both")
FRAME_SIZE = 256  # width and height of the images of `render`, pixels
CRASH_NAMES = np.array([cause.name.lower() for cause in CrashCause], dtype=object)

Observation = np.ndarray | dict[str, np.ndarray]


def row_of(batch: Any, index: int) -> Any:
    """One environment's part of observations or `info` of N, with NumPy's scalars as Python's."""
    if isinstance(batch, dict):
        return {name: row_of(value, index) for name, value in batch.items()}
    row = batch[index]
    return row.item() if isinstance(row, np.generic) else row


class GymWorlds:
    """What the single and the vector environment share: N worlds in Gymnasium's terms, always batched.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        num_envs: N.
        observation: `pixels`, `vector`, `state` or `both`.
        privileged: whether `info` has the state.
        body_rate_weight: b₂ of paper Eq. 1; that of `RewardWeights` if None.
        render_mode: `rgb_array` or None.
        preset: physics preset or parameters.
        worlds: further arguments of `RaceWorlds`, see `WorldOptions`.

    Raises:
        ValueError: bad argument; the message says which and what is allowed.
        TrackError: unknown or broken track.
    """

    def __init__(
        self,
        track: str | Track,
        num_envs: int,
        observation: str,
        privileged: bool,
        body_rate_weight: float | None,
        render_mode: str | None,
        preset: str | QuadrotorParameters,
        worlds: WorldOptions,
    ) -> None:
        if observation not in OBSERVATIONS:
            raise ValueError(f"observation={observation!r}: choose one of {', '.join(OBSERVATIONS)}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r}: choose 'rgb_array', or None for no frames.")
        device = worlds.get("device", "cpu")
        if torch.device(device).type != "cpu":
            raise ValueError(
                f"device={device!r}: Gymnasium's arrays live on cpu; DroneRacingEnv keeps tensors on a GPU."
            )
        self.observation = observation
        self.privileged = privileged
        self.renderer_name = worlds.get("renderer", "auto")
        self.worlds = RaceWorlds(track, num_envs, preset, from_pixels=observation in ("pixels", "both"), **worlds)
        self.body_rate_weight = (
            self.worlds.race.weights.body_rate if body_rate_weight is None else float(body_rate_weight)
        )
        self._onboard: Renderer | None = None
        self._begun = False

    @property
    def frames_per_second(self) -> int:
        """Of a video in real time: control steps a second."""
        return round(1.0 / self.worlds.parameters.control_dt)

    def action_space(self) -> Box:
        """The action space of one environment."""
        return Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)

    def observation_space(self) -> gymnasium.Space:
        """The observation space of one environment."""
        camera = self.worlds.camera
        pixels = Box(0, 255, (camera.height, camera.width, 3), np.uint8)
        if self.observation == "pixels":
            return pixels
        if self.observation == "vector":
            return Box(-np.inf, np.inf, (RACE_VECTOR_SIZE,), np.float32)
        spaces: dict[str, gymnasium.Space] = {
            name: Box(-np.inf, np.inf, (size,), np.float32)
            for name, size in (("position", 3), ("attitude", 4), ("linear_velocity", 3), ("body_rates", 3))
        }
        spaces["target_gate"] = Discrete(self.worlds.track.num_gates)
        return Dict(spaces if self.observation == "state" else {"pixels": pixels, **spaces})

    def begin(self, mask: np.ndarray | None = None) -> None:
        """Begin episodes everywhere, or where masked (N,) bool."""
        self.worlds.reset(None if mask is None else torch.from_numpy(mask))
        self._begun = True

    def step(self, actions: Any) -> tuple[RaceStep, np.ndarray]:
        """Fly one control step; return what it did and the rewards (N,).

        Raises:
            ResetNeeded: no episode has begun.
            TypeError, ValueError: actions of another type or shape.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("step() before the first reset(): no episode has begun.")
        actions = np.asarray(actions)
        if actions.dtype.kind != "f":
            raise wrong_action_type(actions.dtype)
        outcome = self.worlds.step(torch.from_numpy(actions.astype(np.float64)))
        return outcome, outcome.reward(self.body_rate_weight).numpy()

    def observe(self, mask: np.ndarray | None = None) -> Observation:
        """The observations of all environments, or of the M masked ones (N,) bool in order."""
        rows = slice(None) if mask is None else mask
        if self.observation == "vector":
            return self.worlds.vector().numpy()[rows]
        state = {name: value[rows] for name, value in self.state().items()}
        if self.observation == "state":
            return state
        pixels = self.worlds.render(None if mask is None else torch.from_numpy(mask)).numpy()
        return pixels if self.observation == "pixels" else {"pixels": pixels, **state}

    def state(self) -> dict[str, np.ndarray]:
        """The privileged state of all environments; `target_gate` is (N,)."""
        state = {name: value.numpy() for name, value in self.worlds.privileged().items()}
        return {**state, "target_gate": state["target_gate"][:, 0]}

    def info(self, outcome: RaceStep | None, begun: np.ndarray | None = None) -> dict[str, Any]:
        """What happened in the race, arrays (N,); zeros where an episode has begun (N,) bool, or without outcome."""
        num_envs = self.worlds.num_envs

        def values(name: str, kind: type) -> np.ndarray:
            column = np.zeros(num_envs, kind) if outcome is None else getattr(outcome, name).numpy().astype(kind)
            return column if begun is None else np.where(begun, kind(0), column)

        info: dict[str, Any] = {
            "gates_passed": values("gates_passed", np.int64),
            "gate_offset": values("gate_offset", np.float64),
            "lap_time": values("lap_time", np.float64),
            "crash": CRASH_NAMES[values("crash", np.int64)],
            "finished": values("finished", np.bool_),
            "reward_base": values("reward_base", np.float64),
            "body_rate_norm": values("body_rate_norm", np.float64),
        }
        if self.privileged:
            info["privileged"] = self.state()
        return info

    def frames(self) -> np.ndarray:
        """The on-board views, uint8 (N, 256, 256, 3); their renderer is made on first use."""
        worlds = self.worlds
        if self._onboard is None:
            camera = replace(worlds.camera, width=FRAME_SIZE, height=FRAME_SIZE)
            scene = build_scene(worlds.track, worlds.parameters, camera).compile()
            self._onboard = make_renderer(self.renderer_name, scene, camera, worlds.num_envs, num_workers=1)
        state = worlds.simulator.state
        return self._onboard.render(state.position, state.attitude).numpy()

    def close(self) -> None:
        """Free rendering contexts and threads."""
        self.worlds.close()
        if self._onboard is not None:
            self._onboard.close()
            self._onboard = None


class DroneRaceGymEnv(gymnasium.Env[Observation, np.ndarray]):
    """One drone on one track; spaces and `info` are in the module's tables.

    The episode ends by itself after `episode_steps` (truncated). `gymnasium.make(..., max_episode_steps=...)` can make
    it shorter, but not longer: for that, pass `episode_steps`.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        observation: `pixels`, `vector`, `state` or `both`.
        render_mode: `rgb_array` for on-board frames of 256×256 pixels, or None.
        privileged: whether `info` has the state.
        body_rate_weight: b₂ of paper Eq. 1; that of `RewardWeights` if None.
        preset: physics preset (`easy`, `faithful`) or parameters.
        worlds: further arguments of `RaceWorlds`; see `WorldOptions`.

    Raises:
        ValueError: bad argument; the message says which and what is allowed.
        TrackError: unknown or broken track.

    Example:
        >>> env = gymnasium.make("dreamer_racing/Kidney-v0", observation="state")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["crash"]
        'none'
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        track: str | Track = "kidney",
        observation: str = "pixels",
        render_mode: str | None = None,
        privileged: bool = False,
        body_rate_weight: float | None = None,
        preset: str | QuadrotorParameters = "easy",
        **worlds: Unpack[WorldOptions],
    ) -> None:
        self.race = GymWorlds(track, 1, observation, privileged, body_rate_weight, render_mode, preset, worlds)
        self.metadata = {**self.metadata, "render_fps": self.race.frames_per_second}
        self.render_mode = render_mode
        self.action_space = self.race.action_space()
        self.observation_space = self.race.observation_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed makes it and those after it reproducible. There are no options."""
        super().reset(seed=seed)
        if seed is not None:
            self.race.worlds.seed(seed)
        self.race.begin()
        return row_of(self.race.observe(), 0), row_of(self.race.info(None), 0)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly one control step.

        Args:
            action: (4,); values beyond [-1, 1] are clipped, and one that is not finite is a crash.

        Raises:
            ResetNeeded: no episode has begun.
            TypeError, ValueError: an action of another type or shape.
        """
        if np.shape(action) != (ACTION_SIZE,):
            raise ValueError(
                f"Action of shape {np.shape(action)}: this environment takes one of shape ({ACTION_SIZE},): collective "
                "thrust and body rates x, y, z, each in [-1, 1]."
            )
        outcome, reward = self.race.step(np.asarray(action)[None])
        return (
            row_of(self.race.observe(), 0),
            float(reward[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            row_of(self.race.info(outcome), 0),
        )

    def render(self) -> np.ndarray | None:
        """The on-board view, uint8 (256, 256, 3); None without a render mode."""
        return self.race.frames()[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free rendering contexts and threads."""
        self.race.close()


class DroneRaceVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """N drones racing at once in one process, much faster than N single environments.

    Episodes begin anew in one of Gymnasium's modes. NEXT_STEP: the step in which an episode ends returns its last
    observation, and the step after it ignores that environment's action and returns the first observation of the next
    episode with reward 0. SAME_STEP: the step itself returns the first observation of the next episode, and `info` the
    last one of the old (`final_obs`, an array of objects, and `final_info`). DISABLED: whoever steps begins them, by
    `reset(options={"reset_mask": ended})`, as TorchRL's `GymWrapper` does. Every entry of `info` but these two is there
    for every environment (`info["_" + name]` is all true).

    Args:
        num_envs: N.
        track: name of a built-in track, path to a YAML file, or a `Track`.
        observation: `pixels`, `vector`, `state` or `both`.
        render_mode: `rgb_array` for on-board frames of 256×256 pixels, or None.
        privileged: whether `info` has the state.
        body_rate_weight: b₂ of paper Eq. 1; that of `RewardWeights` if None.
        preset: physics preset (`easy`, `faithful`) or parameters.
        max_episode_steps: control steps until an episode is truncated; Gymnasium's name of `episode_steps`.
        autoreset_mode: `NextStep`, `SameStep` or `Disabled`.
        worlds: further arguments of `RaceWorlds`; see `WorldOptions`.

    Raises:
        ValueError: bad argument; the message says which and what is allowed.
        TrackError: unknown or broken track.

    Example:
        >>> envs = gymnasium.make_vec("dreamer_racing/Kidney-v0", num_envs=16, observation="state")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["position"].shape
        (16, 3)
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        track: str | Track = "kidney",
        observation: str = "pixels",
        render_mode: str | None = None,
        privileged: bool = False,
        body_rate_weight: float | None = None,
        preset: str | QuadrotorParameters = "easy",
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **worlds: Unpack[WorldOptions],
    ) -> None:
        self.autoreset_mode = _mode(autoreset_mode)
        if max_episode_steps is not None:
            worlds["episode_steps"] = min(max_episode_steps, worlds.get("episode_steps") or max_episode_steps)
        self.race = GymWorlds(track, num_envs, observation, privileged, body_rate_weight, render_mode, preset, worlds)
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
        """Begin an episode everywhere, or where it is asked for; a seed makes all that follow reproducible.

        Args:
            seed: of all environments together.
            options: `reset_mask`, (N,) bool: where an episode begins; the others fly on.

        Raises:
            ValueError: the seed is a list, for all environments draw from one generator; or the mask is none.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise ValueError(f"seed={seed!r}: one number seeds all {self.num_envs} environments together.")
        mask = self._reset_mask(options)
        super().reset(seed=seed)
        if seed is not None:
            self.race.worlds.seed(int(seed))
        self.race.begin(None if mask.all() else mask)
        self._ended &= ~mask
        return self.race.observe(), self._masked(self.race.info(None), mask)

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one control step, or begin an episode where the last one has ended.

        Args:
            actions: (N, 4); values beyond [-1, 1] are clipped, and one that is not finite is a crash of its drone.

        Raises:
            ResetNeeded: in mode DISABLED, an episode has ended and none has begun since.
            ValueError: wrong shape.
        """
        begun = self._ended
        if begun.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            where = begun.nonzero()[0].tolist()
            raise gymnasium.error.ResetNeeded(f"step() where episodes have ended, {where}: reset them by a reset_mask.")
        outcome, reward = self.race.step(actions)
        if begun.any():
            self.race.begin(begun)
        terminated = outcome.terminated.numpy() & ~begun
        truncated = outcome.truncated.numpy() & ~begun
        ended = terminated | truncated
        info = self._masked(self.race.info(outcome, begun))
        observation = self.race.observe()
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            info |= {**self._final(observation, ended), "final_info": dict(info), "_final_info": ended}
            self.race.begin(ended)
            info |= self._masked(self.race.info(outcome, ended))
            observation, ended = self.race.observe(), np.zeros_like(ended)
        self._ended = ended
        return observation, np.where(begun, 0.0, reward), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The on-board views, N images uint8 (256, 256, 3); None without a render mode."""
        return tuple(self.race.frames()) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Free rendering contexts and threads."""
        self.race.close()

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if getattr(mask, "dtype", None) != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask={mask!r}: an array of {self.num_envs} bool, one of them true at least.")
        return mask

    def _final(self, observation: Observation, ended: np.ndarray) -> dict[str, np.ndarray]:
        """Return the last observation of each episode that ended, None elsewhere, as Gymnasium has them."""
        final = np.full(self.num_envs, None, dtype=object)
        for index in ended.nonzero()[0]:
            final[index] = row_of(observation, int(index))
        return {"final_obs": final, "_final_obs": ended}

    def _masked(self, info: dict[str, Any], mask: np.ndarray | None = None) -> dict[str, Any]:
        """Add Gymnasium's masks of which environments an entry is there for: all of them, unless masked (N,) bool."""
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
