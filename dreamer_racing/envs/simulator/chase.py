"""Chase views: a camera follows each drone from outside, rendered by OpenGL without a display.

Shapes: N drones. SI units, world z up.
"""

from __future__ import annotations

import weakref

import mujoco
import numpy as np

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, OpenGLScene, RendererUnavailableError, open_scene
from dreamer_racing.envs.simulator.rendering import RenderThread
from dreamer_racing.envs.simulator.scene import DRONE_GROUP, HALL_GROUP, Camera, build_scene
from dreamer_racing.envs.tracks import Track

# choices of this project, for appearance
DISTANCE, HEIGHT = 1.0, 0.35  # m behind and above the drone
AHEAD = 0.5  # m in front of the drone: the point at which the camera is aimed
BEYOND = 1.5  # m behind the target gate: the point towards which the camera's heading turns
FIELD_OF_VIEW = 70.0  # degrees
TURNING_TIME = 0.25  # s, time constant of the camera's heading
WALL_MARGIN, FLOOR_MARGIN = 0.1, 0.25  # m
SAMPLES = 4  # per pixel, for anti-aliasing


class ChaseView:
    """Renders N drones, each with a camera behind and above it that turns towards the target gate.

    Args:
        track: the track. Its hall is rendered in nominal colours.
        size: width and height of the images, pixels.

    Raises:
        RendererUnavailableError: neither EGL nor OSMesa works here; the message says why and how to fix it.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> view = ChaseView(load_track("circle"), QuadrotorParameters())
        >>> above_the_start = np.array([[4.0, -2.5, 1.35]])
        >>> view.draw(above_the_start, np.array([[1.0, 0, 0, 0]]), np.array([0]), np.array([0.0])).shape
        (1, 256, 256, 3)
        >>> view.close()
    """

    def __init__(self, track: Track, parameters: QuadrotorParameters, num_envs: int = 1, size: int = 256) -> None:
        self._size = size
        gates = np.array([gate.position for gate in track.gates])
        self._aims = (gates + BEYOND * track.gate_normals().double().numpy())[:, :2]  # (G, 2)
        self._low = np.add(track.bounds_low, (WALL_MARGIN, WALL_MARGIN, FLOOR_MARGIN))
        self._high = np.array(track.bounds_high) - WALL_MARGIN
        self._heading = np.zeros((num_envs, 2))  # horizontal unit vectors of the cameras' headings
        self._time = np.full(num_envs, np.inf)
        camera = Camera(width=size, height=size, field_of_view=FIELD_OF_VIEW)
        spec = build_scene(track, parameters, camera)
        spec.visual.quality.offsamples = SAMPLES
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._thread = RenderThread("chase")  # owns the OpenGL context
        try:
            self._scene = self._thread.submit(_open, self._model, camera).result()
        except BaseException:
            self._thread.end(None)
            raise
        self._end = weakref.finalize(self, self._thread.end, self._scene.close)
        self._end.atexit = False  # contexts are freed at exit anyway

    def draw(self, position: np.ndarray, attitude: np.ndarray, target_gate: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Render the drones.

        Args:
            position: (N, 3) m. A drone with a non-finite pose is not rendered: its image is black.
            attitude: (N, 4) wxyz.
            target_gate: gates to pass next, (N,) int.
            time: time of each episode, (N,) s, for the cameras' turning. At 0 or a decrease, an episode begins.

        Returns:
            uint8 RGB (N, size, size, 3), first row at the top.
        """
        self._follow(position, target_gate, time)
        images = np.zeros((len(position), self._size, self._size, 3), np.uint8)
        there = np.isfinite(position).all(1) & np.isfinite(attitude).all(1)
        for index in there.nonzero()[0]:
            pose = position[index], attitude[index], self._heading[index]
            self._thread.submit(self._film, *pose, images[index]).result()
        return images

    def _follow(self, position: np.ndarray, target_gate: np.ndarray, time: np.ndarray) -> None:
        """Turn the cameras towards the gates, immediately where an episode begins."""
        way = self._aims[target_gate] - position[:, :2]
        wanted = way / np.linalg.norm(way, axis=1, keepdims=True).clip(1e-9)
        passed = np.where((time == 0) | (time < self._time), np.inf, time - self._time)
        share = 1 - np.exp(-passed / TURNING_TIME)
        turned = (1 - share)[:, None] * self._heading + share[:, None] * np.nan_to_num(wanted)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        self._heading = np.where(length > 1e-3, turned / length.clip(1e-9), self._heading)
        self._time = time.copy()

    def _film(self, position: np.ndarray, attitude: np.ndarray, heading: np.ndarray, out: np.ndarray) -> None:
        self._data.qpos[:] = *position, *attitude
        mujoco.mj_forward(self._model, self._data)
        self._scene.show(self._model, self._data, HALL_GROUP, DRONE_GROUP)
        eye = np.clip(np.append(position[:2] - DISTANCE * heading, position[2] + HEIGHT), self._low, self._high)
        forward = np.append(position[:2] + AHEAD * heading, position[2]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        self._scene.draw(eye, np.cross(right / np.linalg.norm(right), forward), forward, out)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._end()
        self._thread.join()


def _open(model: mujoco.MjModel, camera: Camera) -> OpenGLScene:
    """Make the scene with the first OpenGL library that works."""
    reasons = []
    for backend in GL_LIBRARIES:
        try:
            return open_scene(backend, model, camera)
        except RendererUnavailableError as error:
            reasons.append(str(error))
    raise RendererUnavailableError(
        f"Only OpenGL can draw a drone from outside, and there is none here. {' '.join(reasons)}"
    )
