"""Where a run acts: the environment that its configuration names, and what comes with it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import torch

from composing.schema import EnvConfig, LatentPPORunConfig, RunConfig, WorldModelRunConfig, is_race
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Track, describe_track, load_track, read_track, with_decoys
from dreamer_racing.figures.report import EvaluationReport, ReturnReport
from dreamer_racing.learners.learner import Evaluable
from dreamer_racing.losses import find_targets
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.training.session import Evaluator

if TYPE_CHECKING:
    from dreamer_racing.envs.control_suite import ControlSuiteEnv

Environment: TypeAlias = "DroneRacingEnv | ControlSuiteEnv"


def describe_file(track: str) -> str | None:
    """Return what a run notes of its track: of a file all that it says, as JSON; None of a built-in one."""
    if track in BUILTIN_TRACKS:
        return None
    return json.dumps(describe_track(load_track(track))).replace("$", "\\u0024")  # which OmegaConf would read


def track_as_begun(config: RunConfig) -> Track:
    """Return the track of a run: of a file as it was when the run was begun, whatever became of that."""
    noted = config.track_description
    track = config.track if noted is None else read_track(json.loads(noted), f"track_description of {config.track}")
    return with_decoys(track, config.decoys)


def worlds_device(device: torch.device, env: EnvConfig) -> str:
    """The device for worlds: the learner's, where they have a simulator and the renderer asked for, else the CPU."""
    fits = env.suite == "race" and env.renderer in ("auto", "warp")
    return str(device) if device.type == "cuda" and fits else "cpu"


def imu_of(config: RunConfig) -> str | None:
    """The inertial measurements that the agent sees, as `DroneRacingEnv` takes them."""
    return None if config.env.imu == "none" else config.env.imu


def worlds_of(config: RunConfig) -> dict[str, Any]:
    """Arguments of every `DroneRacingEnv` of the run: where it trains, and where it is evaluated."""
    env = config.env
    same = ("preset", "renderer", "control_rate", "from_pixels", "reward", "vector", "device")
    return {
        "track": track_as_begun(config),
        "camera": Camera(env.image_size, env.image_size, tilt=env.camera_tilt, rate=env.camera_rate),
        "imu": imu_of(config),
        **{name: getattr(env, name) for name in same},
    }


def make_env(config: RunConfig, num_envs: int | None = None, num_threads: int | None = None) -> Environment:
    """Make the environment to train in, with `env.num_envs` worlds or another number.

    Args:
        config: resolved.
        num_envs: worlds; those of the configuration if None.
        num_threads: that step and draw a race's worlds on a CPU; if None one a CPU, at most `OMP_NUM_THREADS`.
    """
    env = config.env
    num_envs = num_envs or env.num_envs
    readers = privileged_losses(config) if isinstance(config, WorldModelRunConfig) else []
    if is_race(config):
        training = (
            "episode_steps", "start_beyond_gate", "start_at_gate", "start_on_line", "miss_radius",
            "action_change_weight", "looks",
        )  # fmt: skip
        return DroneRacingEnv(
            num_envs=num_envs,
            privileged=bool(readers),
            seed=config.seed,
            num_threads=num_threads,
            **{name: getattr(env, name) for name in training},
            **worlds_of(config),
        )
    if readers:
        raise ValueError(
            f"{' and '.join(readers)}: read the race's privileged state, which env=dmc does not have. Choose other "
            "losses, e.g. loss=reconstruction, and of recipes/latent_ppo.py loss.critic=latent."
        )
    return make_suite(config, num_envs, config.seed, env.episode_steps)


def privileged_losses(config: WorldModelRunConfig) -> list[str]:
    """Return what of a run reads the simulator's state in training, as on the command line."""
    model = config.loss.world_model
    readers = {f"loss.world_model={model}": any(PRIVILEGED in target.reads for target in find_targets(model))}
    if isinstance(config, LatentPPORunConfig):
        readers[f"loss.critic={config.loss.critic}"] = config.loss.critic == "state"
    return [words for words, reads in readers.items() if reads]


def make_suite(config: RunConfig, num_envs: int, seed: int, episode_steps: int | None = None) -> ControlSuiteEnv:
    """Make worlds of the Control Suite: to evaluate, or to train in episodes of so many control steps."""
    from dreamer_racing.envs.control_suite import ControlSuiteEnv  # opens a display where it is imported

    env = config.env
    return ControlSuiteEnv(
        config.task,
        num_envs,
        from_pixels=env.from_pixels,
        image_size=env.image_size,
        seed=seed,
        episode_steps=episode_steps,
    )


def make_evaluator(
    config: RunConfig,
    directory: Path,
    learner: Evaluable,
    episodes: int,
    video_steps: int,
    start_noise: float = 0.0,
    **options: Any,
) -> Evaluator:
    """Make the evaluation that fits the environment; options are those of `EvaluationReport`."""
    if is_race(config):
        worlds = {**worlds_of(config), "start_noise": start_noise}
        return EvaluationReport(directory, learner, worlds, episodes, video_steps, **options)
    seed = config.seed + 1
    env = make_suite(config, min(8, episodes), seed)
    return ReturnReport(directory, learner, env, episodes, video_steps, seed)
