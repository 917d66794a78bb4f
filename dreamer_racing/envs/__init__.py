"""The race: tracks, quadrotor physics, batched simulation, and the environments built on them.

Names are imported on first use: TorchRL and dm_control take seconds to import, and few programs need both.
"""

import importlib
from typing import TYPE_CHECKING, Any

from dreamer_racing.envs.gl_variables import validate_gl_variables

if TYPE_CHECKING:
    from dreamer_racing.envs.control_suite import ControlSuiteEnv as ControlSuiteEnv
    from dreamer_racing.envs.dm_control_env import load as load
    from dreamer_racing.envs.simulator.scene import Camera as Camera
    from dreamer_racing.envs.torchrl_env import DroneRacingEnv as DroneRacingEnv
    from dreamer_racing.envs.tracks import load_track as load_track
    from dreamer_racing.envs.worlds import RaceWorlds as RaceWorlds

validate_gl_variables()  # before anything here imports MuJoCo

_HOMES = {
    "Camera": "simulator.scene",
    "ControlSuiteEnv": "control_suite",
    "DroneRacingEnv": "torchrl_env",
    "RaceWorlds": "worlds",
    "load": "dm_control_env",
    "load_track": "tracks",
}

__all__ = ["Camera", "ControlSuiteEnv", "DroneRacingEnv", "RaceWorlds", "load", "load_track"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        try:
            return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        except AttributeError as error:  # of a library that is being imported: `from ... import` would hide it
            raise ImportError(f"{name} cannot be imported: {error}") from error
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
