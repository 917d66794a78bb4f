"""N worlds on CPU: MuJoCo's C engine for the rigid bodies, batched natively, and a renderer for their cameras."""

import os
from collections.abc import Mapping
from typing import Any

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from dreamer_racing.envs.flight import Flight
from dreamer_racing.envs.quadrotor import Quadrotor, QuadrotorParameters
from dreamer_racing.envs.scene import Camera, build_scene
from dreamer_racing.envs.simulator.base import DroneState
from dreamer_racing.envs.simulator.rendering import Renderer, make_renderer
from dreamer_racing.envs.tracks import Track


class MujocoSimulator:
    """The CPU backend of `Simulator`.

    Args:
        track: what stands in the hall.
        parameters: the drone.
        num_envs: N worlds.
        camera: the nose camera.
        renderer: `auto`, `egl`, `osmesa`, `warp`, or None for no images.
        num_threads: physics and rendering threads; the CPUs of this process if None.
        generator: source of the physics randomisation.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> simulator = MujocoSimulator(load_track("kidney"), QuadrotorParameters(), num_envs=4, renderer=None)
        >>> simulator.step(torch.zeros(4, 4)).shape
        torch.Size([11, 4, 3])
    """

    device = torch.device("cpu")
    dtype = torch.float64  # MuJoCo's

    def __init__(
        self,
        track: Track,
        parameters: QuadrotorParameters,
        num_envs: int,
        camera: Camera | None = None,
        renderer: str | None = "auto",
        num_threads: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.parameters = parameters
        camera = camera or Camera()
        self.quadrotor = Quadrotor(parameters, num_envs, self.device, self.dtype, generator)
        self.model = build_scene(track, parameters, camera).compile()
        # a broken state must be seen and ended by the race, not hidden by an automatic reset
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        num_threads = min(num_threads or available_cpus(), num_envs)
        self._batch = Batch(self.model, num_envs, num_threads)
        self._qpos = torch.from_numpy(self._batch.bind("qpos"))  # (N, 7) view of MuJoCo's state
        self._qvel = torch.from_numpy(self._batch.bind("qvel"))  # (N, 6)
        ctrl = torch.from_numpy(self._batch.bind("ctrl"))  # (N, 6)
        self.state = DroneState(self._qpos[:, :3], self._qpos[:, 3:], self._qvel[:, :3], self._qvel[:, 3:])
        self._flight = Flight(self.quadrotor, self._qpos, self._qvel, ctrl, self._batch.step)
        self.renderer: Renderer | None = None
        if renderer is not None:
            scene = build_scene(track, parameters, camera).compile()
            self.renderer = make_renderer(renderer, scene, camera, num_envs, num_threads)

    def reset(self, mask: Tensor, position: Tensor, attitude: Tensor, linear_velocity: Tensor) -> None:
        """Put the masked drones (N,) bool at the given poses (N, ·), not rotating, rotors at hover."""
        rows = mask.unsqueeze(-1)
        pose = torch.cat((position, attitude), dim=1).to(self.dtype)
        velocity = torch.nn.functional.pad(linear_velocity.to(self.dtype), (0, 3))
        self._qpos.copy_(torch.where(rows, pose, self._qpos))
        self._qvel.copy_(torch.where(rows, velocity, self._qvel))
        self.quadrotor.reset(mask)

    def step(self, action: Tensor) -> Tensor:
        """Fly one control step with finite actions (N, 4); return the path (P + 1, N, 3) of all physics steps."""
        path = torch.empty(self.parameters.physics_steps + 1, self.num_envs, 3, dtype=self.dtype)
        path[0] = self.state.position
        self.quadrotor.command(action)
        for index in range(self.parameters.physics_steps):
            self._flight.step(index)
            path[index + 1] = self.state.position
        return path

    def render(self, mask: Tensor | None = None) -> Tensor:
        """Images uint8 (M, height, width, 3) of all worlds, or of the M masked ones in order."""
        if self.renderer is None:
            raise RuntimeError("This simulator was made with renderer=None: it has no images to give.")
        state = self.state
        position, attitude = state.position, state.attitude
        if mask is not None:
            position, attitude = position[mask], attitude[mask]
        return self.renderer.render(position, attitude)

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on."""
        return {"qpos": self._qpos.clone(), "qvel": self._qvel.clone(), "quadrotor": self.quadrotor.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._qpos.copy_(state_dict["qpos"])
        self._qvel.copy_(state_dict["qvel"])
        self.quadrotor.load_state_dict(state_dict["quadrotor"])

    def close(self) -> None:
        """Free the renderer's contexts and threads."""
        if self.renderer is not None:
            self.renderer.close()
            self.renderer = None


def available_cpus() -> int:
    """CPUs this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
