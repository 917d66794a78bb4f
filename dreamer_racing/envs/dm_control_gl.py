"""dm_control's OpenGL. It is chosen as dm_control is imported, so whoever draws with that imports this before it."""

import os
import sys

from dreamer_racing.envs.gl_variables import imports_with_variable
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, RendererUnavailableError, loads

RENDERING = "dm_control._render"


def choose_backend() -> None:
    """Without a display, point dm_control to a headless OpenGL library before it settles for a windowing one.

    dm_control decides when it is imported, and takes GLFW even where GLFW cannot open a window. A `MUJOCO_GL` that
    is set already is left alone.
    """
    if os.environ.get("MUJOCO_GL") or not sys.platform.startswith("linux"):
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    usable = (name for name, libraries in GL_LIBRARIES.items() if any(loads(library) for library in libraries))
    os.environ["MUJOCO_GL"] = next(usable, "disable")


def import_dm_control() -> None:
    """Import dm_control with the OpenGL that the user names, else with one that is there, else without any."""
    for _ in range(3):  # what the user set, without one of two variables, and one of those that are there
        choose_backend()
        if imports_with_variable(RENDERING):
            return
    os.environ["MUJOCO_GL"] = "disable"


import_dm_control()

from dm_control import _render, mujoco  # noqa: E402 - after the choice

BACKEND: str | None = _render.BACKEND
"""What dm_control settled for; None: nothing that draws."""


def open_camera(physics: mujoco.Physics, height: int, width: int, camera: int | str) -> mujoco.Camera:
    """Make a camera that draws.

    Args:
        physics: what it sees.
        height: of its images, pixels.
        width: likewise.
        camera: number or name in the model.

    Raises:
        RendererUnavailableError: dm_control has no OpenGL that works here.
    """
    try:
        return mujoco.Camera(physics, height, width, camera)
    except Exception as error:  # GLFW, PyOpenGL and MuJoCo each raise their own
        raise RendererUnavailableError(
            f"dm_control cannot draw with {BACKEND or 'no OpenGL library'}, which it chose when it was "
            f"imported ({type(error).__name__}: {error}). Without a display it needs EGL (Debian: apt-get install "
            "libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6), and, where dm_control is imported before "
            "dreamer_racing, MUJOCO_GL=egl or MUJOCO_GL=osmesa in the environment. Without images: "
            "from_pixels=False; DroneRacingEnv and the Gymnasium environments can draw without OpenGL."
        ) from error
