"""The race as a dm_control task: `load("kidney")` is a `control.Environment` like those of the Control Suite.

Physics, rules, rewards and start poses are those of the batched environments, for one drone. Observations:

| name | shape | meaning |
|---|---|---|
| `position` | (3,) | m, world |
| `attitude` | (4,) | quaternion wxyz, body → world |
| `linear_velocity` | (3,) | m/s, world |
| `body_rates` | (3,) | rad/s, body frame |
| `target_gate` | (1,) int64 | the gate to pass next |
| `imu` | (6,) | body rates, rad/s, and specific force, m/s², body frame, only with `imu=` |
| `vector` | (V,) | user-defined, only with `vector=` |
| `pixels` | (height, width, 3) uint8 | nose camera, 64 × 64 by default, only with `from_pixels=True` |

A crash ends the episode with discount 0; the time limit (and the last lap in evaluation) with discount 1. A non-finite
physics state or action is a crash too, never an exception.

Shapes: P physics steps per control step. SI units.
"""

import collections
import math
from dataclasses import replace
from typing import Any

from dreamer_racing.envs.dm_control_gl import open_camera  # before dm_control

# isort: split
import mujoco as mujoco_bindings
import numpy as np
import torch
from dm_control import mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters, at_control_rate, load_preset
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.imu import Imu, ImuErrors, load_imu
from dreamer_racing.envs.own import CustomFunction, RaceState, RewardFunction, Transition, VectorFunction
from dreamer_racing.envs.race.race import EPISODE_TIME, EVALUATION_TIME, Race, RaceStep, RaceVector, RewardWeights
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.envs.simulator.scene import (
    CAMERA_NAME,
    HALL_GROUP,
    Camera,
    build_scene,
    frame_interval,
    load_camera,
)
from dreamer_racing.envs.simulator.simulators import DroneState
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.envs.worlds import ACTION_SIZE, check_action
from dreamer_racing.settings import check_flags, check_numbers, without_none

FRAMEBUFFER = (1280, 960)  # width and height of the largest image that `physics.render` can return
MOST_STEPS = 2**31 - 1  # of an episode without a time limit: more than a year


def load(
    track: str | Track = "kidney",
    preset: str | QuadrotorParameters = "easy",
    *,
    random: int | np.random.RandomState | None = None,
    time_limit: float | None = None,
    evaluation: bool = False,
    from_pixels: bool = False,
    camera: Camera | None = None,
    weights: RewardWeights | None = None,
    control_rate: float | None = None,
    camera_rate: float | None = None,
    imu: str | ImuErrors | None = None,
    reward: str | RewardFunction | None = None,
    vector: str | VectorFunction | None = None,
    environment_kwargs: dict[str, Any] | None = None,
) -> control.Environment:
    """Make the race of one drone as a dm_control environment.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        preset: physics preset (`easy`, `faithful`, `betaflight`) or parameters.
        random: seed or `RandomState` of start poses and physics randomisation; None for a random seed.
        time_limit: duration after which an episode is truncated, s; None for 20, in evaluation 30.
        evaluation: start at the start pose, at rest, without noise, and finish after the track's laps.
        from_pixels: whether there is an observation `pixels`; needs OpenGL (EGL, OSMesa or a display).
        camera: the nose camera.
        weights: reward weights of Eq. 1 of the paper.
        control_rate: actions per second, Hz; None for the preset's, 50.
        camera_rate: frames per second, Hz: `control_rate` divided by a whole number. The image is repeated until the
            next frame; None for the camera's rate, by default a frame per control step.
        imu: IMU of the observation `imu`: `exact`, `noisy` (see `IMUS`), or an error model; None for none.
        reward: function of a `Transition` in place of Eq. 1, or `module:function`; see `RaceWorlds`.
        vector: function of a `RaceState` that returns the observation `vector`, or `module:function`; None for none.
        environment_kwargs: further arguments of `control.Environment`, e.g. `flat_observation`.

    Raises:
        ValueError: invalid argument; the message says which and what is allowed.
        TrackError: unknown or invalid track.

    Example:
        >>> env = load("circle", random=0)
        >>> time_step = env.reset()
        >>> env.step(env.action_spec().generate_value()).discount
        1.0
    """
    check_numbers({}, without_none(time_limit=time_limit))
    check_flags(evaluation=evaluation, from_pixels=from_pixels)
    camera, errors = load_camera(camera, camera_rate, from_pixels), load_imu(imu)
    track, parameters = load_track(track), at_control_rate(load_preset(preset), control_rate)
    default_time = EVALUATION_TIME if evaluation else EPISODE_TIME
    episode_steps = _steps_of(default_time if time_limit is None else time_limit, parameters.control_dt)
    generator = torch.Generator()
    physics = make_physics(track, parameters, camera, generator)
    task = DroneRace(
        track,
        parameters,
        generator,
        random=random,
        episode_steps=episode_steps,
        evaluation=evaluation,
        camera=camera if from_pixels else None,
        imu=errors,
        weights=weights,
        reward=reward,
        vector=vector,
    )
    # no time_limit here: control.Environment would give a crash in the last step discount 1, as of a truncation
    return control.Environment(physics, task, control_timestep=parameters.control_dt, **(environment_kwargs or {}))


def _steps_of(time_limit: float, control_dt: float) -> int:
    """Return the control steps of an episode, `MOST_STEPS` for an infinite limit; refuse a limit below one step."""
    if math.isnan(time_limit):
        raise ValueError("time_limit=nan: must be a number, or inf for no limit.")
    episode_steps = round(min(time_limit / control_dt, float(MOST_STEPS)))
    if episode_steps < 1:
        raise ValueError(f"time_limit={time_limit} s: at least one control step of {control_dt} s is needed.")
    return episode_steps


def make_physics(
    track: Track,
    parameters: QuadrotorParameters,
    camera: Camera | None = None,
    generator: torch.Generator | None = None,
) -> "Physics":
    """Compile the scene of a track for one drone, whose physics randomisation is drawn from the generator.

    A second camera, `spectator`, stands in a corner of the hall and is always aimed at the drone.
    """
    spec = build_scene(track, parameters, camera)
    spec.worldbody.add_camera(
        name="spectator",
        pos=(track.bounds_low[0] + 0.3, track.bounds_low[1] + 0.3, track.bounds_high[2] - 0.3),
        mode=mujoco_bindings.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM,
        targetbody="drone",
        fovy=45.0,
    )
    view = spec.visual.global_
    view.offwidth, view.offheight = max(FRAMEBUFFER[0], view.offwidth), max(FRAMEBUFFER[1], view.offheight)
    model = spec.compile()
    # the race must detect a non-finite state and end the episode; an automatic reset would hide it
    model.opt.disableflags |= mujoco_bindings.mjtDisableBit.mjDSBL_AUTORESET
    quadrotor = Quadrotor(parameters, num_drones=1, generator=generator)
    return Physics(wrapper.MjData(wrapper.MjModel(model)), quadrotor)


class Physics(mujoco.Physics):
    """Physics of one drone in its hall.

    Its flight controller and motors run in every physics step. Their state (rotor speeds, delayed commands) is in
    `quadrotor`, outside MuJoCo's state: `get_state` does not include it, and copying and pickling are refused.

    Args:
        data: the simulation of a scene made by `build_scene`.
        quadrotor: the drone's flight controller and motors, N = 1.
    """

    def __init__(self, data: wrapper.MjData, quadrotor: Quadrotor) -> None:
        super().__init__(data)
        self.quadrotor = quadrotor
        arrays = (data.qpos, data.qvel, data.qfrc_applied)
        qpos, qvel, force = (torch.from_numpy(array).unsqueeze(0) for array in arrays)
        self._flight = FusedFlight(quadrotor, qpos, qvel, force, self._integrate)
        self._start_path()

    def copy(self, share_model: bool = False) -> "Physics":
        """Refuse to be copied: the copy would have no flight controller, or share this one's.

        Raises:
            TypeError: always; the message says what to do instead.
        """
        raise TypeError(
            "This race cannot be copied or pickled: make another by load() with the same arguments. The same "
            "random= and the same actions give the same flight."
        )

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled."""
        return self.copy()

    def position(self) -> np.ndarray:
        """Position (3,) in the world, m."""
        return self.data.qpos[:3].copy()

    def attitude(self) -> np.ndarray:
        """Attitude (4,), quaternion wxyz, body → world."""
        return self.data.qpos[3:7].copy()

    def linear_velocity(self) -> np.ndarray:
        """Velocity (3,) in the world, m/s."""
        return self.data.qvel[:3].copy()

    def body_rates(self) -> np.ndarray:
        """Angular velocity (3,) in the body frame, rad/s."""
        return self.data.qvel[3:6].copy()

    def ideal_imu(self) -> Tensor:
        """Return what an ideal IMU at the drone's centre measures, (1, 6); see `FusedFlight.ideal_imu`."""
        return self._flight.ideal_imu()

    def path(self) -> Tensor:
        """Positions (P + 1, 1, 3) at the start of the control step and after each of its physics steps, m."""
        return torch.from_numpy(np.stack(self._path)).unsqueeze(1)

    def place(self, position: np.ndarray, attitude: np.ndarray, linear_velocity: np.ndarray) -> None:
        """Set position (3,), attitude (4,) and velocity (3,), with no rotation, hovering rotors and new parameters."""
        self.data.qpos[:3], self.data.qpos[3:7] = position, attitude
        self.data.qvel[:3], self.data.qvel[3:6] = linear_velocity, 0.0
        self._flight.qvel_before.copy_(torch.from_numpy(self.data.qvel))
        self.quadrotor.reset(torch.ones(1, dtype=torch.bool))
        self._start_path()

    def command(self, action: np.ndarray) -> None:
        """Set the finite action (4,) in [-1, 1] of the next control step: collective thrust and body rates."""
        self.quadrotor.command(torch.from_numpy(action).unsqueeze(0))
        self._start_path()

    def step(self, nstep: int = 1) -> None:
        """Simulate physics steps with the current command; the race detects a non-finite state."""
        for _ in range(nstep):
            self._flight.step(self._physics_step)
            self._physics_step += 1
            self._path.append(self.position())
        # update cameras and sensors to the new state: mj_step leaves those of the old one
        mujoco_bindings.mj_step1(self.model.ptr, self.data.ptr)

    def _integrate(self) -> None:
        mujoco_bindings.mj_step(self.model.ptr, self.data.ptr)

    def _start_path(self) -> None:
        self._physics_step = 0  # within the control step
        steps = self.quadrotor.parameters.physics_steps
        self._path = collections.deque((self.position(),), maxlen=steps + 1)


def open_nose(physics: Physics, camera: Camera) -> mujoco.Camera:
    """Open the nose camera with which the scene was built, with the drone itself hidden.

    Raises:
        RendererUnavailableError: dm_control has no OpenGL that works here.
    """
    view = open_camera(physics, camera.height, camera.width, CAMERA_NAME)
    view.option.geomgroup[:] = 0
    view.option.geomgroup[HALL_GROUP] = 1
    view.option.sitegroup[:] = 0
    return view


class DroneRace(base.Task):
    """One drone racing as a Control Suite task: the rules of `Race` and the reward of Eq. 1.

    For every episode, the torch generator, from which `Physics` draws too, is seeded with a number drawn from
    `task.random`. Arguments as of `load`; a camera or IMU of None is none.

    Attributes:
        body_rate_weight: b₂ of paper Eq. 1, applied to rewards from now on.
        outcome: outcome of the last control step, None before the first.
    """

    def __init__(
        self,
        track: Track,
        parameters: QuadrotorParameters,
        generator: torch.Generator | None = None,
        *,
        random: int | np.random.RandomState | None = None,
        episode_steps: int | None = None,
        evaluation: bool = False,
        camera: Camera | None = None,
        imu: ImuErrors | None = None,
        weights: RewardWeights | None = None,
        reward: str | RewardFunction | None = None,
        vector: str | VectorFunction | None = None,
    ) -> None:
        super().__init__(random=random)
        self.track = track
        self.evaluation = evaluation
        laps = track.laps if evaluation else None
        self.race = Race(track, 1, weights, episode_steps, laps, parameters.control_dt)
        self.body_rate_weight = self.race.weights.body_rate
        self.outcome: RaceStep | None = None
        self._generator = generator or torch.Generator()
        self._starts = StartSampler(track, self._generator, dtype=torch.float64)
        self._invalid_action = False
        cpu = torch.device("cpu")
        self._custom_reward = None if reward is None else CustomFunction("reward", reward, 1, cpu)
        self._custom_vector = None if vector is None else CustomFunction("vector", vector, 1, cpu)
        self._race_vector = RaceVector(track)
        self._action = torch.zeros(1, ACTION_SIZE)  # last applied action
        self._before: RaceState | None = None  # state before the current step
        self._imu_errors = imu
        self._imu: Imu | None = None
        self._camera = camera
        self._view: mujoco.Camera | None = None
        self._frame_interval = 1 if camera is None else frame_interval(camera, 1.0 / parameters.control_dt)
        # held image, and its age in control steps; one is due at once, as specs are read before the first episode
        self._image, self._image_age = np.empty(0), self._frame_interval

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Return the spec of collective thrust and body rates x, y, z, (4,) in [-1, 1]."""
        return specs.BoundedArray((ACTION_SIZE,), np.float32, -1.0, 1.0, name="action")

    def initialize_episode(self, physics: Physics) -> None:
        """Begin an episode; base.Task's method is not called, as it only visualises the reward."""
        self._generator.manual_seed(int(self.random.randint(2**31)))
        start = self._starts.sample(1, self.evaluation)
        physics.place(start.position[0].numpy(), start.attitude[0].numpy(), start.linear_velocity[0].numpy())
        self.race.begin(torch.ones(1, dtype=torch.bool), start.position, start.target_gate)
        self.outcome = None
        self._action = torch.zeros(1, ACTION_SIZE)
        self._image_age = self._frame_interval
        if self._imu_errors is not None:
            self._imu = Imu(self._imu_errors, physics.ideal_imu, self._generator)
            self._imu.begin(torch.ones(1, dtype=torch.bool))

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Pass the action (4,) to the flight controller; values beyond [-1, 1] are clipped.

        Raises:
            TypeError: the action is not of a floating-point type.
            ValueError: wrong shape.
        """
        action = np.asarray(action)
        check_action(action)
        self._invalid_action = not np.isfinite(action).all()
        flown = np.nan_to_num(action.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        if self._custom_reward is not None:
            self._before = self._race_state(physics)
        self._action = torch.from_numpy(flown).float().clamp(-1.0, 1.0).unsqueeze(0)
        physics.command(flown)

    def after_step(self, physics: Physics) -> None:
        """Apply the race rules to the control step."""
        self._image_age += 1
        if self._imu is not None:
            self._imu.step()
        body_rates = torch.from_numpy(physics.body_rates()).unsqueeze(0)
        self.outcome = self.race.step(physics.path(), body_rates, torch.tensor([self._invalid_action]))
        if self._custom_reward is not None and self._before is not None:
            transition = Transition(self._before, self._race_state(physics), self.outcome)
            self.outcome = replace(self.outcome, reward_base=self._custom_reward.rewards(transition))

    def _race_state(self, physics: Physics) -> RaceState:
        """Return the state that user-defined functions are given."""
        parts = (physics.position, physics.attitude, physics.linear_velocity, physics.body_rates)
        state = DroneState(*(torch.from_numpy(part()).unsqueeze(0) for part in parts))
        return RaceState.of(self.race, self._race_vector, state, self._action)

    def get_observation(self, physics: Physics) -> "collections.OrderedDict[str, np.ndarray]":
        """Return the observations of the module's table."""
        observation = collections.OrderedDict(
            position=physics.position(),
            attitude=physics.attitude(),
            linear_velocity=physics.linear_velocity(),
            body_rates=physics.body_rates(),
            target_gate=self.race.target_gate.numpy().copy(),
        )
        if self._imu_errors is not None:  # specs are read before the first episode begins
            self._imu = self._imu or Imu(self._imu_errors, physics.ideal_imu, self._generator)
            observation["imu"] = self._imu.sample[0].numpy()
        if self._custom_vector is not None:
            observation["vector"] = self._custom_vector.vector(self._race_state(physics))[0].numpy()
        if self._camera is not None:
            observation["pixels"] = self._look(physics)
        return observation

    def _look(self, physics: Physics) -> np.ndarray:
        """Return the held image, after taking a new frame if one is due."""
        assert self._camera is not None, "asked"
        self._view = self._view or open_nose(physics, self._camera)
        if self._frame_interval == 1 or self._image_age >= self._frame_interval:
            self._image, self._image_age = np.array(self._view.render()), 0
        return self._image.copy()

    def get_reward(self, physics: Physics) -> float:
        """Return the reward of Eq. 1 with the current b₂."""
        assert self.outcome is not None, "there is no reward before the first step"
        return self.outcome.reward(self.body_rate_weight).item()

    def get_termination(self, physics: Physics) -> float | None:
        """Return the final discount: 0 after a crash, 1 if out of time or finished; None while the episode goes on."""
        assert self.outcome is not None, "there is no end before the first step"
        if self.outcome.terminated.item():
            return 0.0
        return 1.0 if self.outcome.truncated.item() else None
