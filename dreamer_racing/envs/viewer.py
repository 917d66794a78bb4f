"""dm_control's interactive viewer on the race: `view("kidney")`.

It needs a display. Where there is none, `launch_viewer` says what is missing instead of failing inside GLFW; record a
video or call `env.physics.render(480, 640, camera_id="spectator")` there. In the window, F1 lists the keys, and `[` and
`]` switch between the free camera, the drone's `nose` and the `spectator`.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

GL_WINDOW_LIBRARIES = ("libGL.so.1", "libGL.so", "libOpenGL.so.0")


class ViewerUnavailableError(RuntimeError):
    """No window can be opened here; the message names what is missing and what would help."""


def view(
    track: Any = "kidney", preset: Any = "easy", policy: Callable[[Any], np.ndarray] | None = None, **arguments: Any
) -> None:
    """Open a window on the race of one drone.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        preset: physics preset (`easy`, `faithful`) or parameters.
        policy: maps a dm_env `TimeStep` to an action (4,); None hovers.
        arguments: further arguments of `envs.load`.

    Raises:
        ViewerUnavailableError: no window can be opened here.
    """
    check_viewer()
    from dreamer_racing.envs.dm_control_env import load

    launch_viewer(load(track, preset, **arguments), policy)


def launch_viewer(env: Any, policy: Callable[[Any], np.ndarray] | None = None) -> None:
    """Open `dm_control.viewer` on an environment made by `envs.load`; return when the window is closed.

    Args:
        env: the environment, or a function without arguments that makes it.
        policy: maps a dm_env `TimeStep` to an action (4,); None hovers.

    Raises:
        ViewerUnavailableError: no window can be opened here.
    """
    check_viewer()
    from dm_control import viewer

    viewer.launch(env, policy=policy or hover)


def hover(time_step: Any) -> np.ndarray:
    """The action (4,) that holds altitude when level, whatever the observation."""
    from dreamer_racing.envs.drone.parameters import QuadrotorParameters

    return np.array([QuadrotorParameters().hover_action, 0.0, 0.0, 0.0], np.float32)


def check_viewer(environment: Mapping[str, str] = os.environ) -> None:
    """Check that a window can be opened, before dm_control tries.

    Args:
        environment: the environment variables to judge.

    Raises:
        ViewerUnavailableError: it cannot; the message is one paragraph that names everything that is missing.
    """
    missing = _missing_display(environment)
    backend = environment.get("MUJOCO_GL", "").lower()
    if backend not in ("", "glfw", "enable", "enabled", "on", "true", "1"):
        missing.append(f"MUJOCO_GL={backend} chooses drawing without a window (unset it, or MUJOCO_GL=glfw)")
    if not missing:
        missing = _missing_glfw()
    if missing:
        raise ViewerUnavailableError(
            f"The viewer cannot open a window here: {'; '.join(missing)}. Without a window, images come from "
            "env.physics.render(480, 640, camera_id='spectator') (EGL or OSMesa) and from the environments' pixels."
        )


def _missing_display(environment: Mapping[str, str]) -> list[str]:
    """What a window needs and this Linux machine lacks; nothing elsewhere, where a desktop is taken for granted."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    if not environment.get("DISPLAY") and not environment.get("WAYLAND_DISPLAY"):
        missing.append("no display (DISPLAY and WAYLAND_DISPLAY are not set; over ssh use ssh -X, or a desktop)")
    if not any(_loads(library) for library in GL_WINDOW_LIBRARIES):
        missing.append(f"no OpenGL library {GL_WINDOW_LIBRARIES[0]} (Debian: apt-get install libgl1)")
    return missing


def _missing_glfw() -> list[str]:
    """What GLFW itself says; asked last, because starting it is what fails without a display."""
    try:
        import glfw
    except (ImportError, OSError) as error:
        return [f"the Python package glfw does not load ({error}; pip install glfw)"]
    try:
        started = glfw.init()
    except glfw.GLFWError as error:
        return [f"GLFW did not start ({error})"]
    return [] if started else ["GLFW did not start: the display named by DISPLAY does not answer"]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
