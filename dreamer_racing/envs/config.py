"""Settings of the worlds that an agent trains in, and what is refused of them before any are made."""

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
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Range, setting

SUITES = ("race", "dmc")
EVERYWHERE = ("suite", "num_envs", "device", "episode_steps", "from_pixels", "image_size")
"""Settings that are not for races alone."""
MISSING = "???"  # OmegaConf's word for what must be given, which this package does not import for it
IN_TRAINING = (
    "episode_steps", "start_beyond_gate", "start_at_gate", "start_on_line", "miss_radius", "action_change_weight",
    "looks",
)  # fmt: skip
"""What is set of a race to train in, and not of one to be evaluated in."""


@dataclass
class EnvConfig:
    """Where the agent acts: the race, or a task of the DeepMind Control Suite to compare with published curves."""

    suite: str = "race"  # race | dmc
    preset: str = "easy"  # physics: easy | faithful | betaflight
    num_envs: int = setting(MISSING, COUNT)  # worlds flown side by side; missing: the recipe's own number
    control_rate: float = setting(50.0, Range(MIN_CONTROL_RATE))  # actions a second, Hz
    # frames a second, Hz, control_rate divided by a whole number; null: one at every control step
    camera_rate: float | None = setting(None, POSITIVE)
    # gyro and accelerometer, seen beside the images: none | exact | noisy
    imu: str = "none"
    # module:function of your own in place of Eq. 1 of the paper (docs/own_rewards.md); null: that
    reward: str | None = None
    # module:function of your own, whose numbers the agent sees, too (docs/own_rewards.md); null: none beside images
    vector: str | None = None
    # control steps of a training episode; null: those of 20 s, with env=dmc those of the task
    episode_steps: int | None = setting(None, COUNT)
    # share of training episodes, but for those on a line, that begin behind a gate, to practise turns
    start_beyond_gate: float = setting(0.0, SHARE)
    # share of those that begin neither there nor on a line, that begin in flight before a gate instead of at the start
    start_at_gate: float = setting(0.5, SHARE)
    # share of training episodes that begin in flight on a planned racing line
    start_on_line: float = setting(0.0, SHARE)
    # m; training episodes end where a gate is missed by less than this; 0: they go on
    miss_radius: float = setting(0.0, NOT_NEGATIVE)
    # b3, penalty in training for each unit of |a_t - a_t-1|^2; 0: none, as in the paper; 1e-4 in champion-level racing
    action_change_weight: float = setting(0.0, NOT_NEGATIVE)
    # of the worlds, to train and to be evaluated in: cpu | cuda | auto, which takes the learner's where it can
    device: str = "auto"
    renderer: str = "auto"  # auto | egl | osmesa | warp | warp_cuda; on cuda auto | warp
    looks: str = "nominal"  # in training: nominal | randomised (light, colours, camera tilt, lens, noise)
    from_pixels: bool = True  # false: the agent sees the numbers of `vector` instead of images
    image_size: int = 64  # pixels, side of the images: a multiple of 16, by which the networks divide it
    camera_tilt: float = 25.0  # degrees upwards

    @property
    def camera(self) -> Camera:
        """The nose camera of a race."""
        return Camera(self.image_size, self.image_size, tilt=self.camera_tilt, rate=self.camera_rate)

    @property
    def measured(self) -> str | None:
        """Inertial measurements, as `DroneRacingEnv` takes them."""
        return None if self.imu == "none" else self.imu

    def arguments(self) -> dict[str, Any]:
        """Return what every `DroneRacingEnv` is given, to train in and to be evaluated in, but for the track."""
        same = ("preset", "renderer", "control_rate", "from_pixels", "reward", "vector", "device")
        return {"camera": self.camera, "imu": self.measured, **{name: getattr(self, name) for name in same}}

    def training_arguments(self) -> dict[str, Any]:
        """Return what one to train in is given besides."""
        return {name: getattr(self, name) for name in IN_TRAINING}

    def check(self) -> None:
        """Refuse worlds that cannot be where they are to be, and what is not for their suite.

        Raises:
            ValueError: the message names the setting.
        """
        if self.suite not in SUITES:
            raise ValueError(f"env.suite={self.suite}: there are {', '.join(SUITES)}.")
        race, on_cuda = self.suite == "race", self.device.partition(":")[0] == "cuda"
        if not on_cuda and self.device != "cpu":
            raise ValueError(f"env.device={self.device}: worlds live on cpu, cuda or cuda:1 ..., or auto.")
        if on_cuda and not race:
            raise ValueError(f"env.device={self.device} is for races: env.suite={self.suite} runs on cpu.")
        if self.looks != "nominal" and not (race and self.from_pixels):
            raise ValueError(f"env.looks={self.looks} is for races seen in images: leave it at nominal.")
        if race:
            return
        for name, usual in vars(EnvConfig()).items():
            if name not in EVERYWHERE and (value := getattr(self, name)) != usual:
                raise ValueError(f"env.{name}={value} is for races, and env.suite={self.suite}: leave it at {usual}.")

    def check_race(self, track: Track) -> None:
        """Refuse what the parts of a race on a track would refuse later.

        Raises:
            ValueError: the message names the setting.
        """
        if self.camera_rate is not None and not self.from_pixels:
            raise ValueError(f"env.camera_rate={self.camera_rate:g} is of images: leave it out of a run from numbers.")
        try:
            at_control_rate(load_preset(self.preset), self.control_rate)
            frame_interval(Camera(rate=self.camera_rate), self.control_rate)
            load_imu(self.measured, self.from_pixels)
            self.try_own(track)
            GateSweeper(track, miss_radius=self.miss_radius)
        except ValueError as error:
            raise ValueError(f"env.{error}") from error

    def try_own(self, track: Track) -> None:
        """Refuse a reward or numbers of a user's own that are not as they should be: fly a step by them."""
        if self.reward is None and self.vector is None:
            return
        if self.vector is not None and self.measured:
            raise ValueError("vector and env.imu: agents see one set of numbers, leave one of them out.")
        own: dict[str, Any] = {name: getattr(self, name) for name in ("control_rate", "device", "reward", "vector")}
        worlds = RaceWorlds(track, 2, self.preset, from_pixels=False, **own)
        worlds.reset()
        worlds.step(torch.zeros(2, ACTION_SIZE, device=self.device))
        worlds.observed_vector()
        worlds.close()
