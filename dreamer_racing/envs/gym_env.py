"""The race for Gymnasium: `gymnasium.make("dreamer_racing/Kidney-v0")`; `gym_vector_env` has the vector environment.

Action: `Box(-1, 1, (4,), float32)`: collective thrust, body rates x, y, z. The argument `observation` chooses:

| `observation` | space |
|---|---|
| `"pixels"` | `Box(0, 255, (height, width, 3), uint8)`, the nose camera, 64 × 64 by default |
| `"pixels_imu"` | `Dict` of `pixels` and `imu`, `Box(-inf, inf, (6,), float32)`: body rates and specific force |
| `"vector"` | `Box(-inf, inf, (21,), float32)`, see `RaceVector`, or user-defined by `vector=` |
| `"pixels_vector"` | `Dict` of `pixels` and `vector` |
| `"state"` | `Dict` of `position`, `attitude` (wxyz), `linear_velocity` (world), `body_rates` (body), `target_gate` |
| `"both"` | the same `Dict` with `pixels` |

`render` returns 256 × 256 pixels (`render_mode="rgb_array"`). The argument `render_view` chooses the view: `"chase"`,
the drone from outside, which needs OpenGL, or `"onboard"`, an enlarged nose camera image. All in SI units.

`info` has `gates_passed`, `gate_offset` m, `lap_time` s, `crash` (a `CrashCause`, 0 while flying), `finished`,
`reward_base` and `body_rate_norm` rad/s (`reward = reward_base − b₂ · body_rate_norm`), which are zero after a reset,
and with `privileged=True` a dictionary `privileged` of the state.

Importing `dreamer_racing` registers the environments; `gymnasium.make("dreamer_racing:dreamer_racing/Kidney-v0")` does
both. Shapes: N environments.
"""

from dataclasses import replace
from typing import Any, Unpack

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.imu import IMU_SIZE
from dreamer_racing.envs.race.race import RaceStep
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.rendering import Renderer, make_renderer
from dreamer_racing.envs.simulator.scene import build_scene
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import ACTION_SIZE, RaceWorlds, WorldOptions, check_action, check_options
from dreamer_racing.settings import FINITE, check_choice, check_flags, check_setting

RENDER_VIEWS = ("chase", "onboard")
STATE = ("position", "attitude", "linear_velocity", "body_rates", "target_gate")
OBSERVATIONS = {
    "pixels": ("pixels",),
    "pixels_imu": ("pixels", "imu"),
    "pixels_vector": ("pixels", "vector"),
    "vector": ("vector",),
    "state": STATE,
    "both": ("pixels", *STATE),
}
"""Entries of the observation by the argument `observation`; a single one is no dictionary."""
INFO = {
    "gates_passed": np.int64,
    "gate_offset": np.float64,
    "lap_time": np.float64,
    "crash": np.int64,
    "finished": np.bool_,
    "reward_base": np.float64,
    "body_rate_norm": np.float64,
}
FRAME_SIZE = 256  # width and height of the images of `render`, pixels

Observation = np.ndarray | dict[str, np.ndarray]


def row_of(batch: Any, index: int) -> Any:
    """Return one environment's row of batched observations or `info`, with NumPy scalars as Python's."""
    if isinstance(batch, dict):
        return {name: row_of(value, index) for name, value in batch.items()}
    row = batch[index]
    return row.item() if isinstance(row, np.generic) else row


def rows_of(batch: dict[str, Any]) -> list[dict[str, Any]]:
    """Return `row_of` of every environment; faster, as it converts column by column."""
    columns = [
        rows_of(value) if isinstance(value, dict) else value.tolist() if value.ndim == 1 else list(value)
        for value in batch.values()
    ]
    return [dict(zip(batch, row, strict=True)) for row in zip(*columns, strict=True)]


def with_rows(batch: Any, mask: np.ndarray, rows: Any) -> Any:
    """Return a copy of the observations of N environments with the masked (N,) bool rows replaced by M new ones."""
    if isinstance(batch, dict):
        return {name: with_rows(values, mask, rows[name]) for name, values in batch.items()}
    merged = batch.copy()  # final observations of episodes are views of the batch
    merged[mask] = rows
    return merged


class GymWorlds:
    """N worlds with Gymnasium's spaces and `info`, always batched: shared by the single and the vector environments.

    Its arguments and errors are those of `DroneRaceGymEnv`.
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
        render_view: str,
        worlds: WorldOptions,
    ) -> None:
        check_flags(privileged=privileged)
        check_choice("observation", observation, OBSERVATIONS)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r}: choose 'rgb_array', or None for no frames.")
        check_choice("render_view", render_view, RENDER_VIEWS)
        if body_rate_weight is not None:
            check_setting("body_rate_weight", body_rate_weight, FINITE)
        device = worlds.get("device", "cpu")
        if str(device).partition(":")[0] == "cuda":  # RaceWorlds refuses other devices
            raise ValueError(
                f"device={device!r}: must be cpu, where Gymnasium's arrays are; DroneRacingEnv keeps tensors on a GPU."
            )
        self._entries = OBSERVATIONS[observation]
        self.privileged = privileged
        self.renderer_name = worlds.get("renderer", "auto")
        if observation == "pixels_imu":
            worlds = worlds.copy()
            worlds["imu"] = worlds.get("imu") or "exact"
        elif worlds.get("imu") is not None:
            raise ValueError(f"imu={worlds.get('imu')!r} is for observation='pixels_imu', not {observation!r}.")
        if worlds.get("vector") is not None and not observation.endswith("vector"):
            raise ValueError(f"vector= is for observation='vector' or 'pixels_vector', not {observation!r}.")
        self.worlds = RaceWorlds(track, num_envs, preset, from_pixels="pixels" in self._entries, **worlds)
        self.body_rate_weight = (
            self.worlds.race.weights.body_rate if body_rate_weight is None else float(body_rate_weight)
        )
        self._render_view = render_view
        self._onboard: Renderer | None = None
        self._chase: ChaseView | None = None
        self._closed = False

    @property
    def frames_per_second(self) -> int:
        """Frame rate of a real-time video: control steps per second."""
        return round(1.0 / self.worlds.parameters.control_dt)

    def action_space(self) -> Box:
        """The action space of one environment."""
        return Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)

    def observation_space(self) -> gymnasium.Space:
        """The observation space of one environment."""
        sizes = {"imu": IMU_SIZE, "position": 3, "attitude": 4, "linear_velocity": 3, "body_rates": 3}
        sizes["vector"], camera = self.worlds.vector_size, self.worlds.camera
        every: dict[str, gymnasium.Space] = {
            "pixels": Box(0, 255, (camera.height, camera.width, 3), np.uint8),
            "target_gate": Discrete(self.worlds.track.num_gates),
            **{name: Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()},
        }
        spaces = {name: every[name] for name in self._entries}
        return Dict(spaces) if len(spaces) > 1 else every[self._entries[0]]

    def begin(self, mask: np.ndarray | None = None) -> None:
        """Begin episodes in all environments, or in the masked ones (N,) bool.

        Raises:
            ResetNeeded: a mask was given before the first reset of all environments.
        """
        if mask is not None and not self.worlds.has_reset:
            raise gymnasium.error.ResetNeeded(
                f"The first reset() covers only {int(mask.sum())} of {len(mask)} episodes: first reset all of them, "
                "without a reset_mask."
            )
        self.worlds.reset(None if mask is None else torch.from_numpy(mask))

    def step(self, actions: Any) -> tuple[RaceStep, np.ndarray]:
        """Simulate one control step; return its outcome and the rewards (N,).

        Raises:
            ResetNeeded: no episode has begun.
            TypeError, ValueError: actions of a wrong type or shape.
        """
        if not self.worlds.has_reset:
            raise gymnasium.error.ResetNeeded("step() before the first reset(): no episode has begun.")
        actions = np.array(actions, order="C")  # torch takes no read-only arrays, nor views that run backwards
        outcome = self.worlds.step(torch.from_numpy(actions))
        return outcome, outcome.reward(self.body_rate_weight).numpy()

    def observe(self, mask: np.ndarray | None = None) -> Observation:
        """Return the observations of all environments, or of the M masked ones (N,) bool in order."""
        worlds, rows = self.worlds, slice(None) if mask is None else mask
        seen: dict[str, np.ndarray] = {}
        if "pixels" in self._entries:
            seen["pixels"] = worlds.render(None if mask is None else torch.from_numpy(mask)).numpy()
        if "imu" in self._entries and worlds.imu is not None:
            seen["imu"] = worlds.imu.sample.numpy()[rows]
        if "vector" in self._entries:
            seen["vector"] = worlds.observed_vector().numpy()[rows]
        if "position" in self._entries:
            seen |= {name: value[rows] for name, value in self.state().items()}
        return seen if len(seen) > 1 else seen[self._entries[0]]

    def state(self) -> dict[str, np.ndarray]:
        """Return the privileged state of all environments; `target_gate` is (N,)."""
        state = {name: value.numpy() for name, value in self.worlds.privileged().items()}
        return {**state, "target_gate": state["target_gate"][:, 0]}

    def info(self, outcome: RaceStep | None, begun: np.ndarray | None = None) -> dict[str, Any]:
        """Return `info` as arrays (N,); zeros where an episode has begun (N,) bool, or if there is no outcome."""
        info: dict[str, Any] = {}
        for name, kind in INFO.items():
            there = np.zeros(self.worlds.num_envs) if outcome is None else getattr(outcome, name).numpy()
            info[name] = np.where(False if begun is None else begun, 0, there).astype(kind)
        if self.privileged:
            info["privileged"] = self.state()
        return info

    def frames(self) -> np.ndarray:
        """Render the chase or onboard view of every drone, uint8 (N, 256, 256, 3), by a renderer made on first use.

        Raises:
            ClosedEnvironmentError: the environment is closed.
            RendererUnavailableError: the chase view is chosen and there is no OpenGL.
        """
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError("render() after close(): the renderer is closed.")
        return self._seen_from_outside() if self._render_view == "chase" else self._seen_on_board()

    def _seen_from_outside(self) -> np.ndarray:
        worlds = self.worlds
        if self._chase is None:
            try:
                self._chase = ChaseView(worlds.track, worlds.parameters, worlds.num_envs, FRAME_SIZE)
            except RendererUnavailableError as error:
                raise RendererUnavailableError(
                    f"{error} render_view='onboard' draws what the drone sees, and needs no OpenGL."
                ) from error
        state, race = worlds.simulator.state, worlds.race
        return self._chase.draw(
            state.position.double().numpy(),
            state.attitude.double().numpy(),
            race.target_gate.numpy(),
            race.step_count.numpy() * worlds.parameters.control_dt,
        )

    def _seen_on_board(self) -> np.ndarray:
        """Render the nose camera of each drone, without camera noise."""
        worlds, looks = self.worlds, self.worlds.simulator.looks
        if self._onboard is None:
            camera = replace(worlds.camera, width=FRAME_SIZE, height=FRAME_SIZE)
            scene = build_scene(worlds.track, worlds.parameters, camera).compile()
            self._onboard = make_renderer(
                self.renderer_name, scene, camera, worlds.num_envs, num_workers=1, varied_looks=looks is not None
            )
        state = worlds.simulator.state
        return self._onboard.render(state.position, state.attitude, None if looks is None else looks.looks).numpy()

    def close(self) -> None:
        """Free rendering contexts and threads."""
        self._closed = True
        self.worlds.close()
        for renderer in (self._onboard, self._chase):
            if renderer is not None:
                renderer.close()
        self._onboard = self._chase = None


class DroneRaceGymEnv(gymnasium.Env[Observation, np.ndarray]):
    """One drone on one track; spaces and `info` are in the module's tables.

    The episode is truncated after `episode_steps`. `gymnasium.make(..., max_episode_steps=...)` can only make it
    shorter; to make it longer, pass `episode_steps`.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        observation: `pixels`, `pixels_imu`, `pixels_vector`, `vector`, `state` or `both`.
        render_mode: `rgb_array` for frames of 256×256 pixels, or None.
        privileged: whether `info` has the state.
        body_rate_weight: b₂ of paper Eq. 1; that of `RewardWeights` if None.
        preset: physics preset (`easy`, `faithful`, `betaflight`) or parameters.
        render_view: view of rendered frames: `chase`, the drone from outside, or `onboard`, its nose camera.
        worlds: further arguments of `RaceWorlds`; see `WorldOptions`.

    Raises:
        ValueError: invalid argument; the message says which and what is allowed.
        TrackError: unknown or invalid track.

    Example:
        >>> env = gymnasium.make("dreamer_racing/Kidney-v0", observation="state")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["crash"]
        0
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
        render_view: str = "chase",
        **worlds: Unpack[WorldOptions],
    ) -> None:
        check_options(DroneRaceGymEnv, worlds, WorldOptions)
        self.race = GymWorlds(
            track, 1, observation, privileged, body_rate_weight, render_mode, preset, render_view, worlds
        )
        self.metadata = {**self.metadata, "render_fps": self.race.frames_per_second}
        self.render_mode = render_mode
        self.action_space = self.race.action_space()
        self.observation_space = self.race.observation_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; a seed makes this and all later episodes reproducible. `options` is ignored."""
        super().reset(seed=seed)
        if seed is not None:
            self.race.worlds.seed(seed)
        self.race.begin()
        return row_of(self.race.observe(), 0), row_of(self.race.info(None), 0)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Simulate one control step.

        Args:
            action: (4,); values beyond [-1, 1] are clipped, a non-finite value is a crash.

        Raises:
            ResetNeeded: no episode has begun.
            TypeError, ValueError: an action of a wrong type or shape.
        """
        action = np.asarray(action)
        check_action(action)
        outcome, reward = self.race.step(action[None])
        return (
            row_of(self.race.observe(), 0),
            float(reward[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            row_of(self.race.info(outcome), 0),
        )

    def render(self) -> np.ndarray | None:
        """Return the chase or onboard view, uint8 (256, 256, 3); None without a render mode."""
        return self.race.frames()[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free rendering contexts and threads."""
        self.race.close()
