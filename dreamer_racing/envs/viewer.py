"""`RaceWindow`, MuJoCo's viewer of a running flight.

It needs a display; without one, it reports what is missing instead of failing inside GLFW. F1 lists its keys.
"""

import os
import sys
import threading
import time
from collections.abc import Mapping

import mujoco
import numpy as np
from tensordict import TensorDictBase

from dreamer_racing.envs.simulator.opengl import loads
from dreamer_racing.envs.simulator.scene import build_scene
from dreamer_racing.envs.worlds import RaceWorlds

GL_WINDOW_LIBRARIES = ("libGL.so.1", "libGL.so", "libOpenGL.so.0")
INSET_SHARE, INSET_MARGIN = 0.4, 8  # largest share of the window's shorter side; pixels
CHASE_DISTANCE, CHASE_ELEVATION = 5.0, -35.0  # of the viewer's camera relative to the drone, m and degrees
HIDDEN_GROUP = 4  # geom group that the viewer hides until this digit key is pressed


class ViewerUnavailableError(RuntimeError):
    """No window can be opened here; the message names what is missing and what would help."""


class WindowClosedError(Exception):
    """The user has closed the window."""


class RaceWindow:
    """MuJoCo's viewer of the flight of one drone, with its camera image in a corner.

    The camera follows the drone and can be turned with the mouse; walls and ceiling, which would block the view, are
    hidden until the key 4 is pressed. The window slows the flight down to real time.

    Args:
        worlds: worlds of the flight, N = 1; the window renders a separate copy of their scene.

    Raises:
        ViewerUnavailableError: no window can be opened here.
    """

    def __init__(self, worlds: RaceWorlds) -> None:
        check_window()
        from mujoco import viewer

        self._track, self._control_dt = worlds.track, worlds.parameters.control_dt
        self._model = _compile_open_scene(worlds)
        self._data = mujoco.MjData(self._model)
        self._due = time.monotonic()
        before = set(threading.enumerate())
        self._viewer = viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        self._threads = set(threading.enumerate()) - before
        camera = self._viewer.cam
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, self._model.body("drone").id
        camera.distance, camera.elevation = CHASE_DISTANCE, CHASE_ELEVATION

    def show(self, tensordict: TensorDictBase) -> None:
        """Show the current state of a flight, and wait until the next one is due.

        Args:
            tensordict: from a `DroneRacingEnv`, [1]: `privileged`, `race` and, if there are images, `pixels`.

        Raises:
            WindowClosedError: the user has closed the window.
        """
        self._refuse_closed()
        state = {name: value[0].cpu().numpy() for name, value in tensordict["privileged"].items()}
        with self._viewer.lock():
            self._data.qpos[:] = *state["position"], *state["attitude"]
            mujoco.mj_forward(self._model, self._data)
        self._viewer.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *self._overlay_text(tensordict)))
        images = tensordict.get("pixels", None)
        if images is not None:
            self._refuse_closed()  # again: asking a closed window for its size is a segmentation fault
            self._viewer.set_images(self._inset(images[0].cpu().numpy()))
        self._viewer.sync()
        self._due = max(self._due + self._control_dt, time.monotonic())
        time.sleep(max(0.0, self._due - time.monotonic()))

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()
        for thread in self._threads:  # at exit, GLFW must not be terminated while one still draws
            thread.join()

    def _refuse_closed(self) -> None:
        if not self._viewer.is_running():
            raise WindowClosedError

    def _overlay_text(self, tensordict: TensorDictBase) -> tuple[str, str]:
        """Return names and values of the overlay text, one line each."""
        gates, lap = self._track.num_gates, int(tensordict["race", "gates_passed"]) // self._track.num_gates + 1
        rows = {
            "lap": f"{lap}/{self._track.laps}",
            "gate": f"{int(tensordict['race', 'target_gate']) + 1}/{gates}",
            "speed": f"{float(tensordict['privileged', 'linear_velocity'].norm()):.1f} m/s",
        }
        return "\n".join(rows), "\n".join(rows.values())

    def _inset(self, image: np.ndarray) -> tuple[mujoco.MjrRect, np.ndarray]:
        """Return the image's rectangle in the window, at the lower right, and the image (H, W, 3) enlarged to fit."""
        window = self._viewer.viewport
        scale = max(1, int(INSET_SHARE * min(window.width, window.height) / max(image.shape[:2])))
        large = image.repeat(scale, axis=0).repeat(scale, axis=1)
        height, width = large.shape[:2]
        return mujoco.MjrRect(window.width - width - INSET_MARGIN, INSET_MARGIN, width, height), large


def _compile_open_scene(worlds: RaceWorlds) -> mujoco.MjModel:
    """Compile the scene of these worlds with hidden walls and ceiling."""
    spec = build_scene(worlds.track, worlds.parameters, worlds.camera)
    for geom in spec.geoms:
        if geom.name.startswith(("wall", "ceiling")):
            geom.group = HIDDEN_GROUP
    return spec.compile()


def check_window(environment: Mapping[str, str] = os.environ) -> None:
    """Check that a window can be opened with these environment variables, before MuJoCo tries.

    Raises:
        ViewerUnavailableError: it cannot; the message, without a full stop, names everything that is missing.
    """
    if missing := _missing_display(environment) or _missing_glfw():
        raise ViewerUnavailableError(f"The viewer cannot open a window here: {'; '.join(missing)}")


def _missing_display(environment: Mapping[str, str]) -> list[str]:
    """Return what this Linux machine lacks for a window; nothing on other systems, where a desktop is assumed."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    if not environment.get("DISPLAY") and not environment.get("WAYLAND_DISPLAY"):
        missing.append("no display (DISPLAY and WAYLAND_DISPLAY are not set; over ssh use ssh -X, or a desktop)")
    if not any(loads(library) for library in GL_WINDOW_LIBRARIES):
        missing.append(f"no OpenGL library {GL_WINDOW_LIBRARIES[0]} (Debian: apt-get install libgl1)")
    return missing


def _missing_glfw() -> list[str]:
    """Return why GLFW cannot start; checked last, because its start is what fails without a display."""
    try:
        import glfw
    except (ImportError, OSError) as error:
        return [f"the Python package glfw does not load ({error}; pip install glfw)"]
    try:
        started = glfw.init()
    except glfw.GLFWError as error:
        return [f"GLFW did not start ({error})"]
    return [] if started else ["GLFW did not start: the display named by DISPLAY does not answer"]
