"""Choice of dm_control's OpenGL backend. dm_control fixes it on import, so import this module before dm_control."""

import os
import sys

from dreamer_racing.envs.gl_variables import imports_with_variable
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, RendererUnavailableError, loads

RENDERING = "dm_control._render"


def choose_backend() -> None:
    """Set `MUJOCO_GL` to a headless OpenGL library if there is no display.

    dm_control decides on import, and takes GLFW even if GLFW cannot open a window. A `MUJOCO_GL` that is already set
    is not changed.
    """
    if os.environ.get("MUJOCO_GL") or not sys.platform.startswith("linux"):
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    usable = (name for name, libraries in GL_LIBRARIES.items() if any(loads(library) for library in libraries))
    os.environ["MUJOCO_GL"] = next(usable, "disable")


def import_dm_control() -> None:
    """Import dm_control with the OpenGL backend set by the user, else with an available one, else without any."""
    for _ in range(3):  # the user's variables, then one of the two unset, then an available backend
        choose_backend()
        if imports_with_variable(RENDERING):
            return
    os.environ["MUJOCO_GL"] = "disable"


import_dm_control()

from dm_control import _render, mujoco  # noqa: E402 - after the choice of backend

BACKEND: str | None = _render.BACKEND
"""The OpenGL backend that dm_control chose; None if it cannot render."""


def open_camera(physics: mujoco.Physics, height: int, width: int, camera: int | str) -> mujoco.Camera:
    """Make a camera (number or name in the model) that renders images of height × width pixels.

    Raises:
        RendererUnavailableError: dm_control has no OpenGL that works here.
    """
    try:
        return mujoco.Camera(physics, height, width, camera)
    except Exception as error:  # GLFW, PyOpenGL and MuJoCo each raise their own types
        raise RendererUnavailableError(
            f"dm_control cannot draw with {BACKEND or 'no OpenGL library'}, which it chose when it was "
            f"imported ({type(error).__name__}: {error}). Without a display it needs EGL (Debian: apt-get install "
            "libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6), and, where dm_control is imported before "
            "dreamer_racing, MUJOCO_GL=egl or MUJOCO_GL=osmesa in the environment. Without images: "
            "from_pixels=False; DroneRacingEnv and the Gymnasium environments can draw without OpenGL."
        ) from error
