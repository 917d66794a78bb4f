"""N worlds on a CUDA device: `mujoco_warp` for the rigid bodies and the cameras."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.looks import LooksRandomisation, LooksSampler
from dreamer_racing.envs.simulator.mujoco_cpu import Simulator
from dreamer_racing.envs.simulator.ray_caster import RayCaster
from dreamer_racing.envs.simulator.scene import Camera, build_drone, build_scene
from dreamer_racing.envs.simulator.warp_device import load_warp, scope
from dreamer_racing.envs.tracks import Track
from dreamer_racing.machine import GB, available_memory


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
    total = 0
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        if dataclasses.is_dataclass(value):
            total += _array_bytes(value)
        else:
            total += getattr(value, "capacity", 0)
    return total
