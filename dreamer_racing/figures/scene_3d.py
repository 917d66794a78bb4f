"""3-D scene of a race in a browser, with viser: track, paths, and drones with their camera images."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb

from dreamer_racing.commands import install_extra
from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Gate, GateShape, Track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import DECOY_COLOR, GATE_COLOR, INK, SPEED_COLORS, speed_scale

if TYPE_CHECKING:
    import viser

DRONE_SCALE = 3.0
"""Scale factor of drones: at true scale, one of 0.3 m would hardly be visible in a hall of 20 m."""
CAMERA_DEPTH = 0.9  # m from a drone to its camera image
LINE_THICKNESS = 0.045  # m
FLOOR_COLOR, FLOOR_LINES = "#f1f3f5", "#dee2e6"
BOUNDS_COLOR = "#adb5bd"
VIEW = (0.12, -0.62, 0.62)  # viewpoint relative to the middle of a track, in units of its length [choice]
VIEW_ANGLE = 50.0  # degrees, vertical


def check_viser() -> None:
    """Raise ValueError if viser is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise ValueError(f"The dashboard needs the package viser: {install_extra('dashboard')}.")


@dataclass(frozen=True)
class Paint:
    """Colours of a flight."""

    color: str  # of the drone and of its curves
    speeds: Colormap  # of the path, from zero to the highest speed of all flights shown


ALONE = Paint("#1971c2", SPEED_COLORS)
SIDE_BY_SIDE = (  # bright is fast
    Paint("#1971c2", LinearSegmentedColormap.from_list("blue", ["#0b2f57", "#1971c2", "#99d3ff"])),
    Paint("#ae3ec9", LinearSegmentedColormap.from_list("violet", ["#4a1259", "#ae3ec9", "#f1b8ff"])),
)


def paints(flights: int) -> tuple[Paint, ...]:
    """Return the colours of one or two flights."""
    return (ALONE,) if flights == 1 else SIDE_BY_SIDE[:flights]


class RaceScene:
    """Track, paths and drones of one or two flights in the scene of a viser server; `place` moves the drones."""

    def __init__(self, server: viser.ViserServer, track: Track, flights: Sequence[Trajectory]) -> None:
        scene = server.scene
        scene.set_up_direction("+z")
        _look_at(server, track)
        _add_hall(scene, track)
        for index, gate in enumerate(track.gates, start=1):
            _add_gate(scene, f"/gates/{index}", gate, track.shape, GATE_COLOR, label=str(index))
        for index, gate in enumerate(track.decoys, start=1):
            _add_gate(scene, f"/decoys/{index}", gate, track.shape, DECOY_COLOR)
        speed = speed_scale(flights)
        self._drones = []
        for index, (flight, paint) in enumerate(zip(flights, paints(len(flights)), strict=True)):
            _add_line(scene, f"/lines/{index}", flight, paint.speeds, speed)
            self._drones.append(_Drone(scene, f"/drones/{index}", flight, paint))

    def place(self, rows: Sequence[int]) -> None:
        """Move every drone to a row of its flight, and show its camera image."""
        for drone, row in zip(self._drones, rows, strict=True):
            drone.place(row)


class _Drone:
    """A drone with its axes and, if its flight has a camera, the camera with its image."""

    def __init__(self, scene: viser.SceneApi, name: str, flight: Trajectory, paint: Paint) -> None:
        self._flight = flight
        self._row: int | None = None
        self._body = scene.add_frame(name, axes_length=0.5, axes_radius=0.018, origin_radius=0.001)
        _add_airframe(scene, name, paint.color)
        self._camera = None if flight.camera_tilt is None else _add_camera(scene, name, flight, paint.color)

    def place(self, row: int) -> None:
        """Move to a row of the flight, if the drone is at another row."""
        if row == self._row:
            return
        self._row = row
        position = self._flight.position[row].numpy()
        if np.isfinite(position).all():  # a diverged state has no position: the drone stays at its last one
            self._body.position, self._body.wxyz = position, self._flight.attitude[row].numpy()
        if self._camera is not None and self._flight.pixels is not None:
            self._camera.image = self._flight.pixels[row].numpy()


def _look_at(server: viser.ViserServer, track: Track) -> None:
    """Set the initial viewpoint to the whole track, obliquely from above."""
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    middle = (low + high) / 2 * (1.0, 1.0, 0.0)
    camera = server.initial_camera
    camera.position = middle + float((high - low)[:2].max()) * np.array(VIEW)
    camera.look_at = middle
    camera.fov = math.radians(VIEW_ANGLE)


def _add_hall(scene: viser.SceneApi, track: Track) -> None:
    low, high = np.array(track.bounds_low), np.array(track.bounds_high)
    width, depth, _ = high - low
    lines = _rgb(FLOOR_LINES)
    cells: dict[str, Any] = {"cell_size": 1.0, "section_size": 1.0, "cell_color": lines, "section_color": lines}
    ground: dict[str, Any] = {"plane_color": _rgb(FLOOR_COLOR), "plane_opacity": 1.0, "fade_strength": 0.0}
    place = (*((low + high) / 2)[:2], -0.01)
    scene.add_grid("/floor", width=width, height=depth, plane="xy", position=place, **cells, **ground)
    corners = np.array([[high[axis] if bits >> axis & 1 else low[axis] for axis in range(3)] for bits in range(8)])
    pairs = [(first, first | 1 << axis) for first in range(8) for axis in range(3) if not first >> axis & 1]
    edges = np.array([(corners[first], corners[second]) for first, second in pairs])  # (12, 2, 3)
    scene.add_line_segments("/bounds", edges, _rgb(BOUNDS_COLOR), thickness=1.0, thickness_units="screen")


def _add_gate(
    scene: viser.SceneApi, name: str, gate: Gate, shape: GateShape, color: str, label: str | None = None
) -> None:
    """Draw a gate as four bars and, if it has a label, an arrow in the direction of flight."""
    half_yaw = math.radians(gate.yaw_degrees) / 2
    attitude = (math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw))
    scene.add_frame(name, show_axes=False, position=gate.position, wxyz=attitude)
    bar, middle = (shape.outer - shape.opening) / 2, (shape.outer + shape.opening) / 4
    bars = {
        "top": ((shape.depth, shape.outer, bar), (0.0, 0.0, middle)),
        "bottom": ((shape.depth, shape.outer, bar), (0.0, 0.0, -middle)),
        "left": ((shape.depth, bar, shape.opening), (0.0, middle, 0.0)),
        "right": ((shape.depth, bar, shape.opening), (0.0, -middle, 0.0)),
    }
    for side, (size, position) in bars.items():
        scene.add_box(f"{name}/{side}", color=_rgb(color), dimensions=size, position=position)
    if label is None:
        return
    above = shape.outer / 2
    scene.add_arrows(
        f"{name}/forwards",
        np.array([[(0.0, 0.0, above + 0.12), (0.7, 0.0, above + 0.12)]]),
        _rgb(color),
        shaft_radius=0.03,
        head_radius=0.09,
        head_length=0.22,
    )
    scene.add_label(f"{name}/number", label, position=(0.0, 0.0, above + 0.35), anchor="bottom-center")


def _add_line(scene: viser.SceneApi, name: str, trajectory: Trajectory, colors: Colormap, speed: Normalize) -> None:
    points = trajectory.position.numpy()
    points = points[np.isfinite(points).all(axis=1)]  # (K + 1, 3), or one row less if the last state diverged
    shades = _linear(colors(speed(trajectory.speed.numpy()[: len(points)]))[:, :3])
    segments, ends = (np.stack((rows[:-1], rows[1:]), axis=1) for rows in (points, shades))  # (K, 2, 3)
    scene.add_line_segments(name, segments, ends, thickness=LINE_THICKNESS)


def _add_airframe(scene: viser.SceneApi, name: str, color: str) -> None:
    """Draw body, arms and rotors as in the simulator's scene, but larger and in the flight's colour."""
    big, dark = DRONE_SCALE, _rgb(INK)
    scene.add_box(f"{name}/body", color=_rgb(color), dimensions=(0.12 * big, 0.06 * big, 0.04 * big))
    for index, (x, y) in enumerate(QuadrotorParameters().rotor_positions):
        place = (big * x, big * y, 0.02 * big)
        half_turn = math.atan2(y, x) / 2
        scene.add_box(
            f"{name}/arm_{index}",
            color=dark,
            dimensions=(big * math.hypot(x, y), 0.015 * big, 0.015 * big),
            position=(place[0] / 2, place[1] / 2, 0.005 * big),
            wxyz=(math.cos(half_turn), 0.0, 0.0, math.sin(half_turn)),
        )
        rotor = _rgb(color) if x > 0 else dark  # front rotors have the flight's colour
        scene.add_cylinder(f"{name}/rotor_{index}", 0.06 * big, 0.008 * big, rotor, position=place, opacity=0.85)


def _add_camera(scene: viser.SceneApi, name: str, flight: Trajectory, color: str) -> viser.CameraFrustumHandle:
    """Draw the camera's view frustum, with its image at `CAMERA_DEPTH`."""
    height, width = flight.pixels.shape[1:3] if flight.pixels is not None else (Camera.height, Camera.width)
    half = math.tan(math.radians(Camera.field_of_view) / 2)
    volume = half * (half * width / height) / 3.0  # at depth 1; its cube root is viser's measure of size
    return scene.add_camera_frustum(
        f"{name}/camera",
        fov=math.radians(Camera.field_of_view),
        aspect=width / height,
        scale=CAMERA_DEPTH * volume ** (1 / 3),
        thickness=0.025,
        color=_rgb(color),
        format="png",  # lossless, and small for flat colours
        wxyz=_camera_attitude(float(flight.camera_tilt or 0.0)),
        position=DRONE_SCALE * np.array(Camera.position),
        cast_shadow=False,
        receive_shadow=False,
    )


def _camera_attitude(tilt: float) -> tuple[float, float, float, float]:
    """Return the quaternion wxyz of a camera (x right, y down, z forwards) along body x, tilted up by degrees."""
    cosine, sine = math.cos(math.radians(tilt) / 2), math.sin(math.radians(tilt) / 2)
    near, far = (cosine + sine) / 2, (cosine - sine) / 2
    return near, -far, far, -near


def _linear(colors: np.ndarray) -> np.ndarray:
    """Convert sRGB colours in [0, 1] to linear uint8, which viser expects for colours per point."""
    light = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * light).astype(np.uint8)


def _rgb(color: str) -> tuple[int, int, int]:
    """Convert a colour to viser's uint8 RGB tuple."""
    red, green, blue = (round(255 * part) for part in to_rgb(color))
    return red, green, blue
