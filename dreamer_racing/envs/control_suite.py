"""`ControlSuiteEnv`: tasks of the DeepMind Control Suite, to compare an agent with published learning curves.

Keys, named as in `DroneRacingEnv` where both have them:

| key | shape | meaning |
|---|---|---|
| `pixels` | (N, height, width, 3) uint8 | the task's camera, 64 × 64 by default, only with `from_pixels=True` |
| `vector` | (N, V) float32 | all observations of the task, concatenated, only with `from_pixels=False` |
| `action` | (N, A) float32 | in [-1, 1], scaled to the range of each actuator |
| `reward` | (N, 1) float32 | summed over the action repeat |
| `terminated` | (N, 1) bool | the task ended with discount 0; of the suite's tasks only those of `lqr` do |
| `truncated` | (N, 1) bool | the suite's time limit, 1000 simulator steps, where the discount stays 1; not in `lqr` |
| `done` | (N, 1) bool | either |

Camera, default image size, action repeat and time limit are those of DreamerV3's `dmc_vision`.

Images are dm_control's, with the same shadows, reflections, sky and four samples a pixel, but with a coarser shadow map
and fewer facets on round shapes, which take most of the time of software rendering and do not show in small images.
The mean difference (measured by `benchmarks/control_suite.py` of commit b53e9fa) in 64 × 64 is less than 0.5 of 255 in
19 of 20 tasks, and 1.9 in `quadruped_escape`, whose shadows lie on a whole terrain. In 32 × 32 it is 1.6 in
`reacher_easy`.

Shapes: N worlds, V observation, A action.

Reference: danijar/dreamerv3, embodied/envs/dmc.py and dreamerv3/configs.yaml of 2024 (`repeat: 2`; later versions have
`repeat: 1`), for camera, image size and action repeat; Tassa et al., dm_control, arXiv 2006.12983, for the tasks.
"""

import math
from collections.abc import Mapping
from typing import Any

from dreamer_racing.envs.dm_control_gl import open_camera  # before dm_control

# isort: split
import mujoco as mujoco_bindings
import numpy as np
import torch
from dm_control import mujoco, suite
from dm_control.rl import control
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dreamer_racing.settings import check_numbers, suggestion, without_none

TASKS = {f"{domain}_{name}": (domain, name) for domain, name in suite.ALL_TASKS}
"""Domain and task of the suite, by the name `domain_task`."""
CAMERAS = {"quadruped": 2}  # camera number by domain; 0 for all others
DETAIL = {"shadowsize": 4.0, "numslices": 0.25, "numstacks": 0.125}
"""MuJoCo's `visual/quality` per pixel of the image width: texels of the shadow map along a side, facets around and
along a capsule, a cylinder or a sphere. Limited to the task's own values, and computed for at least 64 pixels."""
PHYSICS_STATE = mujoco_bindings.mjtState.mjSTATE_INTEGRATION  # everything MuJoCo's next step depends on


class ControlSuiteEnv(EnvBase):
    """N worlds of one task, stepped one after the other in one process.

    A world whose episode has ended does not step, with reward 0, until it is reset. Actions beyond [-1, 1] are clipped;
    a non-finite action is an error, as in the reference, because no task of the suite has a rule for it. An OpenGL
    context belongs to the thread that made the environment: step and close it there.

    Args:
        task: `domain_task` of `dm_control.suite`, for example `cartpole_swingup` or `ball_in_cup_catch`; see `TASKS`.
        num_envs: N; the batch size is [N].
        device: device of the tensors; the simulation itself runs on CPU.
        from_pixels: whether to observe `pixels`; if not, `vector` instead.
        action_repeat: simulator steps per action; an episode is 1000 simulator steps.
        episode_steps: actions after which an episode is truncated, if before the task's time limit; None for no limit.
        camera: number or name of the task's camera; None for the reference's.
        image_size: width and height of `pixels`.
        seed: seed of the worlds; None draws one from the operating system.

    Raises:
        ValueError: invalid argument; the message says which and what is allowed.
        RendererUnavailableError: dm_control has no OpenGL that works here.

    Example:
        >>> env = ControlSuiteEnv("cartpole_swingup", num_envs=4, from_pixels=False, seed=0)
        >>> env.rollout(10)["next", "reward"].shape
        torch.Size([4, 10, 1])
    """

    def __init__(
        self,
        task: str = "walker_walk",
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        from_pixels: bool = True,
        action_repeat: int = 2,
        camera: int | str | None = None,
        image_size: int = 64,
        seed: int | None = None,
        episode_steps: int | None = None,
    ) -> None:
        steps = without_none(episode_steps=episode_steps)
        _check_arguments(task, action_repeat, {"num_envs": num_envs, "image_size": image_size, **steps})
        super().__init__(device=device, batch_size=[num_envs])
        self.task = task
        self.from_pixels = from_pixels
        self.action_repeat = action_repeat
        self.episode_steps = episode_steps
        self.image_size = image_size
        self.camera = CAMERAS.get(TASKS[task][0], 0) if camera is None else camera
        self.worlds: list[SuiteWorld] = []
        self._set_seed(seed)
        self._make_specs()
        self.is_closed = False  # by default TorchRL regards an unwrapped environment as closed

    def _make_specs(self) -> None:
        n, world = self.batch_size, self.worlds[0]

        def flag() -> Bounded:
            return Bounded(0, 1, (*n, 1), dtype=torch.bool, device=self.device)

        self.action_spec = Bounded(-1.0, 1.0, (*n, world.action_size), dtype=torch.float32, device=self.device)
        self.reward_spec = Unbounded((*n, 1), dtype=torch.float32, device=self.device)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=n, device=self.device)
        if self.from_pixels:
            shape, dtype = (*n, self.image_size, self.image_size, 3), torch.uint8
            observation = {"pixels": Bounded(0, 255, shape, dtype=dtype, device=self.device)}
        else:
            shape, dtype = (*n, world.vector_size), torch.float32
            observation = {"vector": Unbounded(shape, dtype=dtype, device=self.device)}
        self.observation_spec = Composite(observation, shape=n, device=self.device)
        self._observations = torch.zeros(shape, dtype=dtype)  # (N, ...), the latest observations

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        rows = range(len(self.worlds)) if mask is None else mask.view(-1).nonzero().view(-1).tolist()
        for row in rows:
            self.worlds[row].reset()
            self._observations[row] = torch.from_numpy(self.worlds[row].observe())
        return self._data()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].cpu().double().numpy()
        self._check_actions(actions)
        rewards = torch.zeros(self.batch_size, dtype=torch.float64)
        for row, (world, action) in enumerate(zip(self.worlds, actions, strict=True)):
            if world.ended:
                continue
            rewards[row] = world.step(action, self.action_repeat)
            self._observations[row] = torch.from_numpy(world.observe())
        return self._data().set("reward", rewards.float().unsqueeze(-1).to(self.device))

    def _check_actions(self, actions: np.ndarray) -> None:
        expected = (len(self.worlds), self.worlds[0].action_size)
        if actions.shape != expected:
            raise ValueError(
                f"Action of shape {actions.shape}: must be {expected}, for {expected[0]} world(s) of {self.task}."
            )
        bad = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(bad):
            raise ValueError(
                f"Action of world {bad[0]} of {self.task} is {actions[bad[0]].tolist()}: every number must be finite."
            )

    def _data(self) -> TensorDict:
        """Return the entries common to a reset and a step."""
        terminated = torch.tensor([[world.terminated] for world in self.worlds], device=self.device)
        truncated = torch.tensor([[world.truncated] for world in self.worlds], device=self.device)
        return TensorDict(
            {
                "pixels" if self.from_pixels else "vector": self._observations.to(self.device, copy=True),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
            self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        """Recreate all worlds: some tasks use their seed on construction, not only on reset."""
        seeds = np.random.SeedSequence(seed).generate_state(self.batch_size.numel())
        self._free_worlds()
        for number in seeds:
            self.worlds.append(self._make_world(int(number)))

    def _make_world(self, seed: int) -> "SuiteWorld":
        limit = None if self.episode_steps is None else self.episode_steps * self.action_repeat
        return SuiteWorld(self.task, seed, self.camera if self.from_pixels else None, self.image_size, limit)

    def state_dict(self) -> dict[str, Any]:
        """Return the state with which an environment with the same arguments continues bit for bit like this one.

        It has only tensors and plain Python values, for `torch.save` and `torch.load(weights_only=True)`.
        """
        return {"task": self.task, "worlds": [world.state_dict() for world in self.worlds]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned; takes as long as making and resetting every world.

        Raises:
            ValueError: the state is of another task or number of worlds.
        """
        states = state_dict["worlds"]
        if (state_dict["task"], len(states)) != (self.task, len(self.worlds)):
            raise ValueError(
                f"The saved state has {len(states)} world(s) of {state_dict['task']}, but this environment has "
                f"{len(self.worlds)} of {self.task}: use the same task and num_envs."
            )
        self._free_worlds()
        for row, state in enumerate(states):
            world = self._make_world(state["seed"])
            world.load_state_dict(state)
            self.worlds.append(world)
            self._observations[row] = torch.from_numpy(world.observe())

    def _free_worlds(self) -> None:
        for world in self.worlds:
            world.close()
        self.worlds = []

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free rendering contexts."""
        if not self.is_closed:
            self._free_worlds()
        super().close(raise_if_closed=raise_if_closed)


class SuiteWorld:
    """One task of the suite with its camera, whose state can be saved and restored.

    Args:
        task: a name of `TASKS`.
        seed: seed of the task's model and episodes.
        camera: number or name of the camera; None for no images.
        image_size: width and height of the images.
        limit: simulator steps after which an episode is truncated, if before the task's time limit; None for no limit.
    """

    def __init__(
        self, task: str, seed: int, camera: int | str | None, image_size: int, limit: int | None = None
    ) -> None:
        self.seed = seed
        self._limit = math.inf if limit is None else limit
        self.env: control.Environment = suite.load(*TASKS[task], task_kwargs={"random": seed})
        self.terminated = self.truncated = False  # whether the last step ended the episode: discount 0, or a limit
        self._episode_start = self._random_state()
        self._begun = False
        action = self.env.action_spec()
        self.action_size = action.shape[0]
        self.vector_size = sum(math.prod(spec.shape) for spec in self.env.observation_spec().values())
        limited = np.maximum(abs(action.minimum), abs(action.maximum)) < mujoco_bindings.mjMAXVAL
        # an actuator without limits takes the action unscaled
        self._low, self._high = np.where(limited, action.minimum, -1.0), np.where(limited, action.maximum, 1.0)
        self._camera = None if camera is None else self._make_camera(task, camera, image_size)

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated

    def reset(self) -> None:
        """Begin an episode."""
        self._episode_start = self._random_state()
        self.env.reset()
        self._begun, self.terminated, self.truncated = True, False, False

    def step(self, action: np.ndarray, repeat: int) -> float:
        """Repeat an action (A,) for ``repeat`` simulator steps or until the episode ends; return the summed reward.

        Raises:
            RuntimeError: no episode has begun.
            PhysicsError: the simulation diverged.
        """
        if not self._begun:
            raise RuntimeError("Step before the first reset: call reset() to begin an episode.")
        control_input = self._low + (np.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (self._high - self._low)
        reward = 0.0
        for _ in range(repeat):
            time_step = self.env.step(control_input)
            reward += time_step.reward
            if time_step.last():
                self.terminated = time_step.discount == 0.0
                self.truncated = not self.terminated
                break
            if self.env._step_count >= self._limit:
                self.truncated = True
                break
        return reward

    def observe(self) -> np.ndarray:
        """Return the image uint8 (height, width, 3), or without a camera all observations as float32 (V,)."""
        if self._camera is not None:
            return np.ascontiguousarray(self._camera.render())
        values = self.env.task.get_observation(self.env.physics).values()
        return np.concatenate([np.ravel(value) for value in values]).astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """Return seed, random states at the episode's start and now, physics state, step count and end flags."""
        physics = self.env.physics
        return {
            "seed": self.seed,
            "begun": self._begun,
            "terminated": self.terminated,
            "truncated": self.truncated,
            "episode_start": self._episode_start,
            "random": self._random_state(),
            "step_count": self.env._step_count,
            "physics": torch.from_numpy(physics.get_state(PHYSICS_STATE)),
            "sensors": torch.from_numpy(physics.data.sensordata.copy()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a saved state in a new world of the same seed.

        Tasks write into the model when an episode begins (targets, terrain), so the episode is first begun again with
        the same random numbers.
        """
        if not state["begun"]:
            return
        self._set_random_state(state["episode_start"])
        self.reset()
        physics = self.env.physics
        physics.set_state(state["physics"].numpy(), PHYSICS_STATE)
        mujoco_bindings.mj_step1(physics.model.ptr, physics.data.ptr)  # for all that follows from qpos and qvel
        physics.data.sensordata[:] = state["sensors"].numpy()  # force sensors depend on the previous step
        self._set_random_state(state["random"])
        self.terminated, self.truncated = state["terminated"], state["truncated"]
        self.env._step_count, self.env._reset_next_step = state["step_count"], self.ended

    def close(self) -> None:
        """Free the rendering context."""
        if self._camera is not None:
            self._camera.scene.free()
            self._camera = None
        self.env.physics.free()

    def _make_camera(self, task: str, camera: int | str, image_size: int) -> mujoco.Camera:
        model = self.env.physics.model
        names = [model.id2name(number, "camera") for number in range(model.ncam)]
        if camera not in names and camera not in range(model.ncam):
            raise ValueError(f"camera={camera!r}: {task} has the cameras 0 to {model.ncam - 1}, {', '.join(names)}.")
        view = model.vis.global_
        view.offwidth = view.offheight = image_size  # the same image as from a larger buffer, but faster
        for name, per_pixel in DETAIL.items():
            enough = int(per_pixel * max(image_size, 64))
            setattr(model.vis.quality, name, min(enough, getattr(model.vis.quality, name)))
        return open_camera(self.env.physics, image_size, image_size, camera)

    def _random_state(self) -> dict[str, Any]:
        state = self.env.task.random.get_state(legacy=False)
        twister = state["state"]
        return {**state, "state": {**twister, "key": torch.from_numpy(twister["key"].astype(np.int64))}}

    def _set_random_state(self, state: Mapping[str, Any]) -> None:
        twister = state["state"]
        key = twister["key"].numpy().astype(np.uint32)
        self.env.task.random.set_state({**state, "state": {**twister, "key": key}})


def _check_arguments(task: str, action_repeat: int, counts: Mapping[str, Any]) -> None:
    """Refuse an unknown task, and counts (by name) that are not positive whole numbers."""
    if task not in TASKS:
        raise ValueError(f"Unknown task {task!r}{suggestion(task, TASKS)}. The tasks are {', '.join(TASKS)}.")
    check_numbers(counts, {})
    for name, what in (("num_envs", "world"), ("image_size", "pixel"), ("episode_steps", "action")):
        if counts.get(name, 1) < 1:
            raise ValueError(f"{name}={counts[name]}: at least one {what} is needed.")
    if not isinstance(action_repeat, int) or action_repeat < 1:
        raise ValueError(f"action_repeat={action_repeat!r}: must be a whole number of simulator steps, at least 1.")
