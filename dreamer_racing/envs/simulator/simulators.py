"""`Simulator`, N worlds with one drone each; its backends are MuJoCo's C engine on CPU and `mujoco_warp` on CUDA.

Shapes: N worlds, P physics steps per control step. SI units, attitude wxyz.
"""

import ctypes
import os
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Any

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.envs.simulator.looks import LooksRandomisation, LooksSampler
from dreamer_racing.envs.simulator.rendering import RayCaster, Renderer, make_renderer
from dreamer_racing.envs.simulator.scene import Camera, build_drone, build_scene
from dreamer_racing.envs.simulator.warp_device import load_warp, scope
from dreamer_racing.envs.tracks import Track
from dreamer_racing.machine import GB, available_memory, usable_threads

BACKENDS = ("mujoco", "mujoco_warp")


@dataclass(frozen=True)
class DroneState:
    """Rigid-body state of N drones."""

    position: Tensor  # (N, 3) m, world
    attitude: Tensor  # (N, 4) wxyz, body → world
    linear_velocity: Tensor  # (N, 3) m/s, world
    body_rates: Tensor  # (N, 3) rad/s, body frame


class Simulator:
    """Base class of simulators of N worlds with one drone each.

    Controllers and motors are the same for every backend. A backend provides the engine's state tensors, a function
    that advances them by one physics step, and a renderer.

    Args:
        qpos: (N, 7) the engine's positions and attitudes.
        qvel: (N, 6) the engine's velocities (world) and body rates (body frame).
        qfrc_applied: (N, 6) the forces (world) and torques (body frame) that the engine applies.
        integrate: makes one physics step.
        generator: source of the physics randomisation, on the tensors' device.

    Attributes:
        state: the current state; views that the next step overwrites.
        renderer: draws the nose cameras' images; None if there are none.
        looks: the sampler of each world's looks; None if looks do not vary.
    """

    renderer: Renderer | RayCaster | None = None
    looks: LooksSampler | None = None
    _without_images = "was made with renderer=None"

    def __init__(
        self,
        parameters: QuadrotorParameters,
        qpos: Tensor,
        qvel: Tensor,
        qfrc_applied: Tensor,
        integrate: Callable[[], None],
        generator: torch.Generator | None = None,
    ) -> None:
        self.parameters = parameters
        self.device, self.dtype = qpos.device, qpos.dtype
        self.quadrotor = Quadrotor(parameters, len(qpos), self.device, self.dtype, generator)
        self._qpos, self._qvel = qpos, qvel
        self.state = DroneState(qpos[:, :3], qpos[:, 3:], qvel[:, :3], qvel[:, 3:])
        self._flight = FusedFlight(self.quadrotor, qpos, qvel, qfrc_applied, integrate)

    def reset(self, mask: Tensor, position: Tensor, attitude: Tensor, linear_velocity: Tensor) -> None:
        """Set the masked drones (N,) bool to the given poses and velocities (N, ·), not rotating, rotors at hover."""
        rows = mask.unsqueeze(-1)
        pose = torch.cat((position, attitude), dim=1).to(self.dtype)
        velocity = torch.nn.functional.pad(linear_velocity.to(self.dtype), (0, 3))
        self._qpos.copy_(torch.where(rows, pose, self._qpos))
        for velocities in (self._qvel, self._flight.qvel_before):
            velocities.copy_(torch.where(rows, velocity, velocities))
        self.quadrotor.reset(mask)
        if self.looks is not None:
            self.looks.reset(mask)

    def step(self, action: Tensor) -> Tensor:
        """Simulate one control step with finite actions (N, 4).

        Returns:
            (P + 1, N, 3) positions from the start to the end of the step, one per physics step.
        """
        self.quadrotor.command(action)
        return self._flight.fly()

    def ideal_imu(self) -> Tensor:
        """Return what ideal IMUs at the drones' centres measure (N, 6); see `FusedFlight.ideal_imu`."""
        return self._flight.ideal_imu()

    def render(self, rows: Tensor | None = None) -> Tensor:
        """Return images of the nose cameras, uint8 (M, height, width, 3).

        Args:
            rows: the worlds to render, a mask (N,) bool or indices (M,); all if None.

        Raises:
            RuntimeError: this simulator has no renderer, or is closed.
        """
        if self.renderer is None:
            raise RuntimeError(f"This simulator cannot render images: it {self._without_images}.")
        position, attitude = self.state.position, self.state.attitude
        looks = None if self.looks is None else self.looks.looks
        if rows is not None:
            position, attitude, looks = position[rows], attitude[rows], None if looks is None else looks[rows]
        return self.renderer.render(position, attitude, looks)

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state that the next step depends on, for `torch.save`."""
        return {
            "qpos": self._qpos.clone(),
            "qvel": self._qvel.clone(),
            "quadrotor": self.quadrotor.state_dict(),
            "looks": None if self.looks is None else self.looks.state_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._qpos.copy_(state_dict["qpos"])
        self._qvel.copy_(state_dict["qvel"])
        self.quadrotor.load_state_dict(state_dict["quadrotor"])
        looks = state_dict.get("looks")
        if (looks is None) != (self.looks is None):
            saved, present = ("nominal" if missing else "randomised" for missing in (looks is None, self.looks is None))
            raise ValueError(f"looks={present}: the saved worlds have looks={saved}, so resume with that.")
        if self.looks is not None and looks is not None:
            self.looks.load_state_dict(looks)

    def close(self) -> None:
        """Free the renderer's contexts and threads."""
        if self.renderer is not None:
            self.renderer.close()
            self.renderer, self._without_images = None, "is closed"


_batches: weakref.WeakSet[Batch] = weakref.WeakSet()


def _keep_batches() -> None:
    """In a forked process, keep the parent's batches from being freed, which would wait for threads that do not exist.

    A list of references would itself be freed at exit, so the reference counts are incremented.
    """
    for batch in _batches:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep_batches)


class MujocoSimulator(Simulator):
    """Simulator with MuJoCo's C engine, in float64.

    Args:
        renderer: a name that `make_renderer` takes, or None for no images.
        num_threads: physics and rendering threads; `usable_threads` if None.
        generator: source of the randomisation of physics and looks.
        looks: randomisation of looks; None for the same in every episode.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> simulator = MujocoSimulator(load_track("kidney"), QuadrotorParameters(), num_envs=4, renderer=None)
        >>> simulator.step(torch.zeros(4, 4)).shape
        torch.Size([11, 4, 3])
    """

    def __init__(
        self,
        track: Track,
        parameters: QuadrotorParameters,
        num_envs: int,
        camera: Camera | None = None,
        renderer: str | None = "auto",
        num_threads: int | None = None,
        generator: torch.Generator | None = None,
        looks: LooksRandomisation | None = None,
    ) -> None:
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads={num_threads}: must be at least 1.")
        num_threads = min(num_threads or usable_threads(), num_envs)
        model = build_drone(parameters).compile()
        # the race must detect a non-finite state and end the episode; an automatic reset would hide it
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        batch = Batch(model, num_envs, num_threads)
        _batches.add(batch)
        qpos, qvel, force = (torch.from_numpy(batch.bind(name)) for name in ("qpos", "qvel", "qfrc_applied"))
        super().__init__(parameters, qpos, qvel, force, batch.step, generator)
        if renderer is not None:
            camera = camera or Camera()
            scene = build_scene(track, parameters, camera).compile()
            self.renderer = make_renderer(renderer, scene, camera, num_envs, num_threads, looks is not None)
            if looks is not None:
                self.looks = LooksSampler(looks, scene, camera, num_envs, self.device, self.dtype, generator)


class WarpSimulator(Simulator):
    """Simulator with `mujoco_warp`'s physics, in float32, and its ray caster. On CPU it is slow, for tests only.

    Neither a step nor rendering all worlds synchronises with the device.

    Args:
        images: whether to render images.
        generator: source of the randomisation of physics and looks, on the device.
        looks: randomisation of looks; None for the same in every episode.

    Raises:
        ValueError: the device does not have enough memory for so many worlds.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> simulator = WarpSimulator(load_track("kidney"), QuadrotorParameters(), 4, images=False, device="cpu")
        >>> simulator.step(torch.zeros(4, 4)).shape
        torch.Size([11, 4, 3])
    """

    def __init__(
        self,
        track: Track,
        parameters: QuadrotorParameters,
        num_envs: int,
        camera: Camera | None = None,
        images: bool = True,
        device: torch.device | str = "cuda",
        generator: torch.Generator | None = None,
        looks: LooksRandomisation | None = None,
    ) -> None:
        warp, device = load_warp(), torch.device(device)
        _check_memory(memory_of_worlds(track, parameters, num_envs, camera, images), num_envs, device)
        data, integrate = _make_bodies(parameters, num_envs, device)
        qpos, qvel, force = (warp.to_torch(array) for array in (data.qpos, data.qvel, data.qfrc_applied))
        super().__init__(parameters, qpos, qvel, force, integrate, generator)
        if images:
            camera = camera or Camera()
            scene = build_scene(track, parameters, camera).compile()
            self.renderer = RayCaster(scene, camera, num_envs, device, looks is not None)
            if looks is not None:
                self.looks = LooksSampler(looks, scene, camera, num_envs, device, self.dtype, generator)

    def step(self, action: Tensor) -> Tensor:
        """Simulate one control step on torch's current stream; see `Simulator.step`."""
        with scope(self.device):
            return super().step(action)


def _make_bodies(
    parameters: QuadrotorParameters, num_envs: int, device: torch.device
) -> tuple[Any, Callable[[], None]]:
    """Make N drones in empty worlds; return their data and a function that makes one physics step, in a `scope`."""
    load_warp()
    import mujoco_warp

    drone = build_drone(parameters).compile()
    with scope(device):
        model, data = mujoco_warp.put_model(drone), _make_data(drone, num_envs)
    return data, partial(mujoco_warp.step, model, data)


def _check_memory(needed: int, num_envs: int, device: torch.device) -> None:
    available = available_memory(device)
    if needed > available:
        raise ValueError(
            f"num_envs={num_envs:,} needs about {needed / GB:.1f} GB, and {device} has {available / GB:.1f} GB left: "
            f"at most about {int(num_envs * available / needed):,} worlds fit."
        )


def _make_data(model: mujoco.MjModel, num_worlds: int) -> Any:
    """Make the data of worlds without room for contacts or constraints, so that MuJoCo does not run its solver."""
    import mujoco_warp

    return mujoco_warp.make_data(model, nworld=num_worlds, nconmax=0, njmax=0)


def memory_of_worlds(
    track: Track, parameters: QuadrotorParameters, num_envs: int, camera: Camera | None = None, images: bool = True
) -> int:
    """Estimate the device memory of a `WarpSimulator` and one observation of its N worlds, in bytes.

    It adds up the arrays of one world. The nodes of the bounding volumes, which warp does not expose, are assumed to
    be two per geom, of 64 bytes.
    """
    models = [build_drone(parameters).compile()]
    per_world = 4 * 3 * (parameters.physics_steps + 1)  # positions of all physics steps
    if images:
        camera = camera or Camera()
        hall = build_scene(track, parameters, camera).compile()
        models.append(hall)
        pixels = camera.width * camera.height
        per_world += pixels * (4 + 2 * 3) + hall.ngeom * (28 + 2 * 64)  # packed; rendered and copied; bounding volumes
    with scope(torch.device("cpu")):
        per_world += sum(_array_bytes(_make_data(model, 2)) - _array_bytes(_make_data(model, 1)) for model in models)
    return per_world * num_envs


def _array_bytes(data: Any) -> int:
    """Return the bytes of all warp arrays of a (nested) dataclass."""
    values = [getattr(data, field.name) for field in fields(data)]
    return sum(_array_bytes(value) if is_dataclass(value) else getattr(value, "capacity", 0) for value in values)


def check_device(device: torch.device | str) -> None:
    """Refuse a device that does not exist or is not supported.

    Raises:
        ValueError: the message says what is available.
    """
    if str(device).partition(":")[0] not in ("cpu", "cuda"):
        raise ValueError(f"device={str(device)!r}: must be cpu or cuda.")
    device = torch.device(device)
    if device.type == "cpu":
        return
    if not torch.cuda.is_available():
        build = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        raise ValueError(
            f"device={str(device)!r}: torch {torch.__version__}, built {build}, finds no CUDA device here. Use "
            "device='cpu', or install a torch build for CUDA and NVIDIA's driver."
        )
    if (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device={str(device)!r}: there are {torch.cuda.device_count()} CUDA device(s), from cuda:0.")


def make_simulator(
    track: Track,
    parameters: QuadrotorParameters,
    num_envs: int,
    camera: Camera,
    renderer: str | None,
    num_threads: int | None,
    generator: torch.Generator,
    device: torch.device | str,
    backend: str = "auto",
    looks: LooksRandomisation | None = None,
) -> Simulator:
    """Make the simulator of a backend; `auto` chooses by device. Arguments: `RaceWorlds`; renderer=None: no images.

    Raises:
        ValueError: unknown backend, or one that does not support the device or renderer.
    """
    device = torch.device(device)
    if backend == "auto":
        backend = "mujoco" if device.type == "cpu" else "mujoco_warp"
    if backend not in BACKENDS:
        raise ValueError(f"Unknown backend {backend!r}: use auto, {', '.join(BACKENDS)}.")
    if backend == "mujoco":
        if device.type != "cpu":
            raise ValueError(f"backend='mujoco' runs on cpu, not on {str(device)!r}: set one or the other.")
        return MujocoSimulator(track, parameters, num_envs, camera, renderer, num_threads, generator, looks)
    if renderer not in (None, "auto", "warp"):
        raise ValueError(
            f"renderer={renderer!r} is for backend 'mujoco'. The backend on {str(device)!r} is 'mujoco_warp', which "
            "has its own renderer: use renderer='auto' or 'warp'."
        )
    return WarpSimulator(track, parameters, num_envs, camera, renderer is not None, device, generator, looks)
