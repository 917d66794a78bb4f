"""The scene that every backend compiles: the hall, the gates, the drone and its nose camera, as an `MjSpec`.

`build_drone` is the moving part: simulators step it alone, in a third less time than with the hall. The scene has flat
colours without shadows, reflections or fine textures: at 64×64 pixels those alias, and MuJoCo's OpenGL renderer and
`mujoco_warp`'s ray caster must agree. Contacts are off: `envs.race.gates` detects crashes. Dimensions of the hall,
colours and the camera's mount are this project's choice.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters
from dreamer_racing.envs.tracks import Track
from dreamer_racing.settings import (
    COUNT,
    FINITE,
    POSITIVE,
    check_numbers,
    check_setting,
    check_settings,
    check_three,
    quoted,
    setting,
)

HALL_GROUP = 0  # geom group of hall and gates
IN_HALL = {"contype": 0, "conaffinity": 0, "group": HALL_GROUP}
DRONE_GROUP = 2  # geom group of the drone, hidden from its own camera
CAMERA_NAME = "nose"

FLOOR = (0.16, 0.17, 0.19)
LINE = (1.00, 0.82, 0.05)
CEILING = (0.93, 0.94, 0.95)
WALLS = {"x+": (0.20, 0.38, 0.80), "x-": (0.45, 0.28, 0.60), "y+": (0.15, 0.55, 0.40), "y-": (0.55, 0.72, 0.88)}
RACE_GATE = (1.00, 0.25, 0.00)
DECOY_GATE = (0.85, 0.00, 0.45)
WALL_THICKNESS = 0.1  # m
LINE_SPACING, LINE_WIDTH, LINE_HEIGHT = 3.0, 0.20, 0.02  # m


@dataclass(frozen=True)
class Camera:
    """The nose camera.

    Raises:
        ValueError: the message gives the value, and what is allowed.
    """

    width: int = setting(64, COUNT)  # pixels
    height: int = setting(64, COUNT)  # pixels
    field_of_view: float = setting(90.0, POSITIVE)  # vertical, degrees, below 180
    tilt: float = setting(25.0, FINITE)  # upwards, degrees; a racing drone pitches forward when it accelerates
    position: tuple[float, float, float] = (0.10, 0.0, 0.02)  # mount in the body frame, m
    near: float = setting(0.01, POSITIVE)  # distance of the near clipping plane, m
    far: float = setting(100.0, POSITIVE)  # distance of the far clipping plane, m
    # frames per second, Hz, with a whole number of control steps per frame, see `frame_interval`; None for one frame
    # per control step
    rate: float | None = setting(None, POSITIVE)

    def __post_init__(self) -> None:
        check_numbers({"camera.width": self.width, "camera.height": self.height}, {})
        check_settings(self, "camera.")
        check_three("camera.position", self.position, FINITE)
        if self.field_of_view >= 180.0:
            raise ValueError(f"camera.field_of_view={self.field_of_view}: must be below 180 degrees.")
        if self.near >= self.far:
            raise ValueError(f"camera.near={self.near}: must be below camera.far={self.far}.")


def load_camera(camera: Camera | None, rate: float | None = None, from_pixels: bool = True) -> Camera:
    """Return the camera, the default one if None, with the frame rate in Hz if one is given.

    Raises:
        ValueError: ``camera`` is not a `Camera`, the rate is invalid, or a rate is given without images.
    """
    if not (camera is None or isinstance(camera, Camera)):
        raise ValueError(f"camera={quoted(camera)}: must be a Camera, for instance Camera(tilt=25).")
    camera = camera or Camera()
    if rate is None:
        return camera
    if not from_pixels:
        raise ValueError(f"camera_rate={quoted(rate)}: needs images, but from_pixels=False: leave it out.")
    check_setting("camera_rate", rate, POSITIVE)
    return replace(camera, rate=rate)


def frame_interval(camera: Camera, control_rate: float) -> int:
    """Return the control steps from one camera frame to the next, at a control rate in Hz.

    Raises:
        ValueError: a frame would fall between two control steps; the message names the nearest valid rates.

    Example:
        >>> frame_interval(Camera(rate=25), control_rate=100)
        4
    """
    if camera.rate is None:
        return 1
    steps = control_rate / camera.rate
    if steps < 1 - 1e-6:
        raise ValueError(
            f"camera_rate={camera.rate:g} Hz: must be at most control_rate={control_rate:g}, because a control step "
            "uses only one image."
        )
    if abs(steps - round(steps)) > 1e-6 * steps:
        slower, faster = control_rate / math.ceil(steps), control_rate / math.floor(steps)
        raise ValueError(
            f"camera_rate={camera.rate:g} Hz: must be control_rate={control_rate:g} divided by a whole number, so that "
            f"every frame lasts for the same number of control steps: {slower:g} or {faster:g} are the nearest."
        )
    return round(steps)


def build_drone(parameters: QuadrotorParameters) -> mujoco.MjSpec:
    """Build the drone in an empty world, which is all that the physics needs.

    It is one free body `drone`, driven by gravity and `qfrc_applied`: a force at its centre of mass in the world frame,
    N, and a torque in the body frame, N m.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "drone"
    spec.option.timestep = parameters.physics_dt
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{parameters.integrator.upper()}")
    spec.option.gravity = (0.0, 0.0, -GRAVITY)
    disable = mujoco.mjtDisableBit  # not used: contacts, constraints, damped joints
    spec.option.disableflags = disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT | disable.mjDSBL_EULERDAMP
    drone = spec.worldbody.add_body(name="drone", pos=(0, 0, 1))
    drone.add_freejoint(name="drone")
    drone.mass, drone.inertia, drone.explicitinertial = parameters.mass, parameters.inertia, True
    drone.ipos = (0.0, 0.0, 0.0)  # centre of mass; by default MjSpec takes the body's position in the world
    return spec


def build_scene(track: Track, parameters: QuadrotorParameters, camera: Camera | None = None) -> mujoco.MjSpec:
    """Build the scene of a track: gates and decoys in a hall whose walls are the bounding box, and the drone.

    The drone is `build_drone` with the camera ``nose``; None is the default camera.
    """
    camera = camera or Camera()
    spec = build_drone(parameters)
    spec.modelname = f"drone_race_{track.name}"
    spec.stat.extent = 1.0  # so that the clipping planes below are in metres
    spec.stat.center = (0.0, 0.0, 1.0)
    spec.visual.map.znear, spec.visual.map.zfar = camera.near, camera.far
    spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 0, 0
    spec.visual.quality.numquads = 1  # flat colours need no more; the default takes a third of a frame's time
    spec.visual.global_.offwidth, spec.visual.global_.offheight = camera.width, camera.height
    _add_light(spec)
    _add_hall(spec, track)
    _add_gates(spec, track)
    drone = spec.body("drone")
    _add_airframe(spec, drone, parameters)
    drone.add_camera(
        name=CAMERA_NAME, pos=camera.position, quat=_camera_attitude(camera.tilt), fovy=camera.field_of_view
    )
    return spec


def _add_light(spec: mujoco.MjSpec) -> None:
    """Add mostly ambient light, and one slanted lamp that makes the faces of a gate distinguishable."""
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.78,) * 3, (0.0,) * 3, (0.0,) * 3
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0, 0, 5),
        dir=(0.35, 0.2, -1.0),
        ambient=(0, 0, 0),
        diffuse=(0.32, 0.32, 0.32),
        specular=(0, 0, 0),
        castshadow=False,
    )


def _add_box(spec: mujoco.MjSpec, name: str, low: Sequence[float], high: Sequence[float], rgb: Sequence[float]) -> None:
    corners = np.array((low, high))
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=corners.mean(axis=0),
        size=(corners[1] - corners[0]) / 2,
        material=_material(spec, rgb),
        **IN_HALL,
    )


def _material(spec: mujoco.MjSpec, rgb: Sequence[float]) -> str:
    """Return the name of a colour's matte material, which is added on first use."""
    name = "matte_" + "_".join(f"{round(255 * channel):03d}" for channel in rgb)
    if spec.material(name) is None:
        spec.add_material(name=name, rgba=(*rgb, 1.0), specular=0.0, shininess=0.0, reflectance=0.0)
    return name


def _add_hall(spec: mujoco.MjSpec, track: Track) -> None:
    """Add a floor at z = 0, ceiling and walls at the bounding box, and yellow lines on the floor."""
    (x0, y0, _), (x1, y1, z1) = track.bounds_low, track.bounds_high
    t = WALL_THICKNESS
    _add_box(spec, "floor", (x0 - t, y0 - t, -t), (x1 + t, y1 + t, 0.0), FLOOR)
    _add_box(spec, "ceiling", (x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t), CEILING)
    _add_box(spec, "wall_x+", (x1, y0 - t, 0.0), (x1 + t, y1 + t, z1), WALLS["x+"])
    _add_box(spec, "wall_x-", (x0 - t, y0 - t, 0.0), (x0, y1 + t, z1), WALLS["x-"])
    _add_box(spec, "wall_y+", (x0, y1, 0.0), (x1, y1 + t, z1), WALLS["y+"])
    _add_box(spec, "wall_y-", (x0, y0 - t, 0.0), (x1, y0, z1), WALLS["y-"])
    half = LINE_WIDTH / 2
    # without the sides against floor and walls, which are never visible and take a tenth of a frame's time
    lines = [((x - half, y0, 0.0), (x + half, y1, LINE_HEIGHT), "x-x+z+") for x in _spaced(x0, x1)]
    lines += [((x0, y - half, 0.0), (x1, y + half, LINE_HEIGHT), "y-y+z+") for y in _spaced(y0, y1)]
    _add_box_mesh(spec, "floor_lines", lines)
    spec.worldbody.add_geom(
        name="floor_lines",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="floor_lines",
        material=_material(spec, LINE),
        **IN_HALL,
    )


def _spaced(low: float, high: float) -> np.ndarray:
    """Return centred positions between two walls, `LINE_SPACING` apart."""
    count = max(1, int((high - low) // LINE_SPACING))
    return (low + high) / 2 + (np.arange(count) - (count - 1) / 2) * LINE_SPACING


Box = tuple[Sequence[float], Sequence[float], str]
"""Low corner, high corner, and the sides to build: `x-x+y-y+z-z+` for all."""

# corners of each side, facing outward; corner 4 i + 2 j + k is at (low, high)[i] in x, [j] in y and [k] in z
SIDES = {
    "x-": (0, 1, 3, 2), "x+": (4, 6, 7, 5), "y-": (0, 4, 5, 1),
    "y+": (2, 3, 7, 6), "z-": (0, 2, 6, 4), "z+": (1, 5, 7, 3),
}  # fmt: skip


def _add_box_mesh(spec: mujoco.MjSpec, name: str, boxes: Sequence[Box]) -> None:
    """Add axis-aligned boxes as one mesh, which needs only one draw call."""
    corners = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    vertices: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []
    for low, high, sides in boxes:
        corner = np.where(corners, high, low)
        for side, quad in SIDES.items():
            if side not in sides:
                continue
            start = len(vertices)
            vertices.extend(corner[list(quad)])  # separate vertices per side, for flat shading
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    spec.add_mesh(
        name=name,
        uservert=np.array(vertices).ravel(),
        userface=np.array(faces).ravel(),
        smoothnormal=False,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _add_gates(spec: mujoco.MjSpec, track: Track) -> None:
    inner, outer, depth = track.shape.opening / 2, track.shape.outer / 2, track.shape.depth / 2
    bars = [
        ((-depth, -outer, inner), (depth, outer, outer), "x-x+y-y+z-z+"),  # top
        ((-depth, -outer, -outer), (depth, outer, -inner), "x-x+y-y+z-z+"),  # bottom
        ((-depth, -outer, -inner), (depth, -inner, inner), "x-x+y-y+"),  # sides
        ((-depth, inner, -inner), (depth, outer, inner), "x-x+y-y+"),
    ]
    _add_box_mesh(spec, "gate", bars)
    for kind, gates, usual in (("gate", track.gates, RACE_GATE), ("decoy", track.decoys, DECOY_GATE)):
        for index, gate in enumerate(gates):
            half_yaw = math.radians(gate.yaw_degrees) / 2
            spec.worldbody.add_geom(
                name=f"{kind}_{index}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname="gate",
                pos=gate.position,
                quat=(math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw)),
                material=_material(spec, gate.color or usual),
                **IN_HALL,
            )


def gate_materials(model: mujoco.MjModel) -> list[int]:
    """Return the material indices of gates and decoys in a compiled scene."""
    names = (model.geom(index).name for index in range(model.ngeom))
    return sorted({int(model.geom(name).matid[0]) for name in names if name.startswith(("gate_", "decoy_"))})


def _camera_attitude(tilt: float) -> np.ndarray:
    """Return the quaternion wxyz of a camera (right x, up y, backwards z) looking along body x with an upward tilt."""
    cosine, sine = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    right, up, backwards = (0.0, -1.0, 0.0), (-sine, 0.0, cosine), (-cosine, 0.0, -sine)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack((right, up, backwards), axis=1).ravel())
    return quaternion


def _add_airframe(spec: mujoco.MjSpec, body: mujoco.MjsBody, parameters: QuadrotorParameters) -> None:
    """Add the visible geometry of the drone, which is massless and hidden from its own camera."""
    look = {"contype": 0, "conaffinity": 0, "group": DRONE_GROUP, "mass": 0.0}
    dark, front, rear = (0.12, 0.12, 0.13), (0.95, 0.95, 0.95), (0.15, 0.75, 0.25)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.06, 0.03, 0.02), material=_material(spec, dark), **look)
    for x, y in parameters.rotor_positions:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0, 0, 0, x, y, 0.01), size=(0.01, 0, 0),
            material=_material(spec, dark), **look,
        )  # fmt: skip
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=(x, y, 0.02), size=(0.06, 0.004, 0),
            material=_material(spec, front if x > 0 else rear), **look,
        )  # fmt: skip
