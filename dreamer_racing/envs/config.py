"""Configuration of the training and evaluation environments, and its checks before any environment is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from dreamer_racing.envs.drone.parameters import MIN_CONTROL_RATE, at_control_rate, load_preset
from dreamer_racing.envs.imu import load_imu
from dreamer_racing.envs.race.gates import GateSweeper
from dreamer_racing.envs.simulator.scene import Camera, frame_interval
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import ACTION_SIZE, RaceWorlds
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Range, check_choice, setting

SUITES = ("race", "dmc")
ALL_SUITES = ("suite", "num_envs", "device", "episode_steps", "from_pixels", "image_size")
"""Settings that apply to every suite."""
MISSING = "???"  # OmegaConf's marker of a mandatory value; this package does not import OmegaConf
TRAINING_ONLY = (
    "episode_steps", "start_beyond_gate", "start_at_gate", "start_on_line", "miss_radius", "action_change_weight",
    "looks",
)  # fmt: skip
"""Settings of training races that evaluation races do not take."""


@dataclass
class EnvConfig:
    """Environment configuration: the race, or a DeepMind Control Suite task to compare with published curves."""

    suite: str = "race"  # race | dmc
    preset: str = "easy"  # physics: easy | faithful | betaflight
    num_envs: int = setting(MISSING, COUNT)  # parallel environments; missing: the recipe's own number
    control_rate: float = setting(50.0, Range(MIN_CONTROL_RATE))  # actions per second, Hz
    # camera frames per second, Hz: control_rate divided by a whole number; null: one frame per control step
    camera_rate: float | None = setting(None, POSITIVE)
    # gyro and accelerometer, observed beside the images: none | exact | noisy
    imu: str = "none"
    # module:function of a user-defined reward (docs/own_rewards.md); null: Eq. 1 of the paper
    reward: str | None = None
    # module:function of a user-defined vector observation (docs/own_rewards.md); null: none beside images
    vector: str | None = None
    # control steps per training episode; null: 20 s, or with env=dmc the task's time limit
    episode_steps: int | None = setting(None, COUNT)
    # share of the training episodes not on the racing line that begin behind a gate, to practise turns
    start_beyond_gate: float = setting(0.0, SHARE)
    # share of the training episodes neither behind a gate nor on the line that begin before a gate, not at the start
    start_at_gate: float = setting(0.5, SHARE)
    # share of training episodes that begin in flight on a planned racing line
    start_on_line: float = setting(0.0, SHARE)
    # m; a training episode ends if a gate is missed by less than this distance; 0: it goes on
    miss_radius: float = setting(0.0, NOT_NEGATIVE)
    # b3, penalty in training per unit of |a_t - a_t-1|^2; 0: none, as in the paper; 1e-4 in champion-level racing
    action_change_weight: float = setting(0.0, NOT_NEGATIVE)
    # device of the training and evaluation environments: cpu | cuda | auto (the learner's if supported)
    device: str = "auto"
    renderer: str = "auto"  # auto | egl | osmesa | warp | warp_cuda; on cuda auto | warp
    looks: str = "nominal"  # in training: nominal | randomised (light, colours, camera tilt, lens, noise)
    from_pixels: bool = True  # false: the agent observes `vector` instead of images
    image_size: int = 64  # pixels, width and height of the images: a multiple of 16, the networks' stride
    camera_tilt: float = 25.0  # degrees upwards

    @property
    def camera(self) -> Camera:
        """The nose camera of a race."""
        return Camera(self.image_size, self.image_size, tilt=self.camera_tilt, rate=self.camera_rate)

    @property
    def imu_argument(self) -> str | None:
        """The `imu` argument of `DroneRacingEnv`."""
        return None if self.imu == "none" else self.imu

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of every `DroneRacingEnv`, for training and evaluation, without the track."""
        same = ("preset", "renderer", "control_rate", "from_pixels", "reward", "vector", "device")
        return {"camera": self.camera, "imu": self.imu_argument, **{name: getattr(self, name) for name in same}}

    def training_arguments(self) -> dict[str, Any]:
        """Return the further arguments of a training `DroneRacingEnv`."""
        return {name: getattr(self, name) for name in TRAINING_ONLY}

    def check(self) -> None:
        """Refuse an unsupported device and settings that do not apply to the suite.

        Raises:
            ValueError: the message names the setting.
        """
        check_choice("env.suite", self.suite, SUITES)
        race, on_cuda = self.suite == "race", self.device.partition(":")[0] == "cuda"
        if not on_cuda and self.device != "cpu":
            raise ValueError(f"env.device={self.device}: must be cpu, cuda, cuda:1 ..., or auto.")
        if on_cuda and not race:
            raise ValueError(f"env.device={self.device} is for races: env.suite={self.suite} runs on cpu.")
        if self.looks != "nominal" and not (race and self.from_pixels):
            raise ValueError(f"env.looks={self.looks} is for races with images: leave it at nominal.")
        if race:
            return
        for name, usual in vars(EnvConfig()).items():
            if name not in ALL_SUITES and (value := getattr(self, name)) != usual:
                raise ValueError(f"env.{name}={value} is for races, but env.suite={self.suite}: leave it at {usual}.")

    def check_race(self, track: Track) -> None:
        """Refuse race settings that would fail later, when the environment is made.

        Raises:
            ValueError: the message names the setting.
        """
        if self.camera_rate is not None and not self.from_pixels:
            raise ValueError(f"env.camera_rate={self.camera_rate:g} needs images: leave it out of runs without them.")
        try:
            at_control_rate(load_preset(self.preset), self.control_rate)
            frame_interval(Camera(rate=self.camera_rate), self.control_rate)
            load_imu(self.imu_argument, self.from_pixels)
            self.check_custom_functions(track)
            GateSweeper(track, miss_radius=self.miss_radius)
        except ValueError as error:
            raise ValueError(f"env.{error}") from error

    def check_shares(self) -> None:
        """Refuse a share of starts behind gates if all episodes begin on the racing line."""
        if self.start_on_line == 1 and self.start_beyond_gate:
            raise ValueError(
                f"env.start_beyond_gate={self.start_beyond_gate:g} is a share of the episodes that do not begin on the "
                "racing line, and env.start_on_line=1 leaves none: lower that, or set env.start_beyond_gate=0."
            )

    def check_custom_functions(self, track: Track) -> None:
        """Check user-defined reward and vector functions by running them for one step."""
        if self.reward is None and self.vector is None:
            return
        if self.vector is not None and self.imu_argument:
            raise ValueError("vector and env.imu cannot be combined: leave one of them out.")
        own: dict[str, Any] = {name: getattr(self, name) for name in ("control_rate", "device", "reward", "vector")}
        worlds = RaceWorlds(track, 2, self.preset, from_pixels=False, **own)
        worlds.reset()
        worlds.step(torch.zeros(2, ACTION_SIZE, device=self.device))
        worlds.observed_vector()
        worlds.close()
