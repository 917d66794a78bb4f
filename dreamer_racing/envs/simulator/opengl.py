"""MuJoCo's OpenGL renderer for a static scene and a freely placed camera.

No torch here: flight with an exported actor renders with this too (`dreamer_racing.hil`).
"""

import atexit
import ctypes
import importlib
import math
import os
from typing import Any

import mujoco
import numpy as np

from dreamer_racing.envs.gl_variables import describe_conflicts
from dreamer_racing.envs.simulator.scene import CAMERA_NAME, HALL_GROUP, Camera

MAX_GEOMS = 1000  # capacity of MuJoCo's list of visible geoms
GL_LIBRARIES = {"egl": ("libEGL.so.1", "libEGL.so"), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}
_open_contexts: set[Any] = set()  # keeps contexts from being collected in another thread than their own


class RendererUnavailableError(RuntimeError):
    """A renderer does not work on this machine; the message says why and how to fix it."""


class OpenGLScene:
    """A compiled scene in its own OpenGL context; must be used in the thread that made it.

    Args:
        backend: `egl` or `osmesa`.
    """

    def __init__(self, backend: str, model: mujoco.MjModel, camera: Camera) -> None:
        gl = importlib.import_module(f"mujoco.{backend}")
        self._gl: Any = gl.GLContext(camera.width, camera.height)
        if backend == "egl":
            # MuJoCo and dm_control share EGL's display: if one's exit hook terminated it while contexts of the other
            # still existed, they would print tracebacks
            atexit.unregister(importlib.import_module("OpenGL.EGL").eglTerminate)
        _open_contexts.add(self._gl)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._viewport = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.show(model, data, HALL_GROUP)
        self._eyes = tuple(self._scene.camera)  # MuJoCo renders from the mean of its two stereo eyes
        self._buffer = np.empty((camera.height, camera.width, 3), np.uint8)
        self._upright = self._buffer[::-1]  # OpenGL's first row is the lowest

    def show(self, model: mujoco.MjModel, data: mujoco.MjData, *groups: int) -> None:
        """Update the scene with the geoms of these groups, at their poses in the data."""
        option = mujoco.MjvOption()
        option.geomgroup[:] = 0
        option.geomgroup[list(groups)] = 1
        option.sitegroup[:] = 0  # the drone's site would remain visible as a ball in mid-air
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = model.camera(CAMERA_NAME).id
        mujoco.mjv_updateScene(model, data, option, mujoco.MjvPerturb(), view, mujoco.mjtCatBit.mjCAT_ALL, self._scene)

    def draw(self, position: np.ndarray, up: np.ndarray, forward: np.ndarray, out: np.ndarray) -> None:
        """Render into ``out``, uint8 RGB (height, width, 3), first row at the top.

        The camera's position is in m, its up and viewing directions are in the world, (3,) each.
        """
        for eye in self._eyes:
            eye.pos, eye.up, eye.forward = position, up, forward
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(self._buffer, None, self._viewport, self._context)
        out[:] = self._upright

    def set_looks(self, colors: np.ndarray, field_of_view: float) -> None:
        """Set the colours of the scene's materials (K, 3), and the camera's vertical field of view, degrees."""
        for geom in self._scene.geoms[: self._scene.ngeom]:
            geom.rgba[:3] = colors[geom.matid]
        for eye in self._eyes:
            eye.frustum_top = eye.frustum_near * math.tan(math.radians(field_of_view) / 2)
            eye.frustum_bottom = -eye.frustum_top

    def close(self) -> None:
        """Free the OpenGL context."""
        self._context.free()
        self._gl.free()
        _open_contexts.discard(self._gl)


def open_scene(backend: str, model: mujoco.MjModel, camera: Camera) -> OpenGLScene:
    """Make an `OpenGLScene`.

    Raises:
        RendererUnavailableError: OpenGL is not installed or did not start; the message says why.
    """
    require_library(backend)
    # llvmpipe, Mesa's software rasteriser, must not start additional threads
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        return OpenGLScene(backend, model, camera)
    except Exception as error:  # PyOpenGL raises anything from AttributeError to GLError
        reason = f"{backend} did not start ({type(error).__name__}: {error}){describe_conflicts(backend)}."
        raise RendererUnavailableError(reason) from error


@atexit.register
def _leave_contexts() -> None:
    """Abandon open contexts at exit: dm_control's hook may have been registered later and terminated the display."""
    for context in _open_contexts:
        context._context = None


def loads(library: str) -> bool:
    """Return whether a shared library can be loaded."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def require_library(backend: str) -> None:
    """Refuse a backend whose library is not installed.

    Raises:
        RendererUnavailableError: the message says how to install it.
    """
    if any(loads(library) for library in GL_LIBRARIES[backend]):
        return
    raise RendererUnavailableError(
        f"{backend} needs {GL_LIBRARIES[backend][0]}, which is not installed "
        f"(Debian: apt-get install {'libegl1 libgl1-mesa-dri' if backend == 'egl' else 'libosmesa6'})."
    )
