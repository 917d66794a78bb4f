"""`Simulator`: the interface of the CPU and CUDA backends.

Shapes: N worlds, P physics steps per control step. SI units, attitude wxyz.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rotation import rotate_inverse
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.envs.simulator.looks import Looks, LooksSampler


@dataclass(frozen=True)
class DroneState:
    """Rigid-body state of N drones."""

    position: Tensor  # (N, 3) m, world
    attitude: Tensor  # (N, 4) wxyz, body → world
    linear_velocity: Tensor  # (N, 3) m/s, world
    body_rates: Tensor  # (N, 3) rad/s, body frame


class Simulator(ABC):
    """Base class of simulators of N worlds with one drone each.

    Controllers and motors are the same for every backend. A backend provides the engine's state tensors, a function
    that advances them by one physics step, and images.

    Args:
        parameters: the drone.
        qpos: (N, 7) the engine's positions and attitudes.
        qvel: (N, 6) the engine's velocities (world) and body rates (body frame).
        qfrc_applied: (N, 6) the forces (world) and torques (body frame) that the engine applies.
        integrate: makes one physics step.
        generator: source of the physics randomisation, on the tensors' device.

    Attributes:
        state: the current state; views that the next step overwrites.
        looks: the sampler of each world's looks; None if looks do not vary.
    """

    looks: LooksSampler | None = None

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
        self.num_envs = len(qpos)
        self.device, self.dtype = qpos.device, qpos.dtype
        self.quadrotor = Quadrotor(parameters, self.num_envs, self.device, self.dtype, generator)
        self._qpos, self._qvel = qpos, qvel
        self.state = DroneState(qpos[:, :3], qpos[:, 3:], qvel[:, :3], qvel[:, 3:])
        self._flight = FusedFlight(self.quadrotor, qpos, qvel, qfrc_applied, integrate)

    def reset(self, mask: Tensor, position: Tensor, attitude: Tensor, linear_velocity: Tensor) -> None:
        """Set the masked drones (N,) bool to the given poses and velocities (N, ·), not rotating, rotors at hover."""
        rows = mask.unsqueeze(-1)
        pose = torch.cat((position, attitude), dim=1).to(self.dtype)
        velocity = torch.nn.functional.pad(linear_velocity.to(self.dtype), (0, 3))
        self._qpos.copy_(torch.where(rows, pose, self._qpos))
        self._qvel.copy_(torch.where(rows, velocity, self._qvel))
        self._flight.qvel_before.copy_(torch.where(rows, velocity, self._flight.qvel_before))
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
        """Return ideal gyro and accelerometer measurements of each drone: body rates and specific force (N, 6).

        At its centre, in rad/s and m/s², body frame; the specific force is (0, 0, 9.81) at rest. It is that of the last
        physics step; after a reset, that of an unaccelerated drone.
        """
        change = self.state.linear_velocity - self._flight.qvel_before[:, :3]
        change[:, 2] += GRAVITY * self.parameters.physics_dt
        force = rotate_inverse(self.state.attitude, change / self.parameters.physics_dt)
        return torch.cat((self.state.body_rates, force), dim=1)

    def _frames(self, rows: Tensor | None) -> tuple[Tensor, Tensor, Looks | None]:
        """Return positions (M, 3), attitudes (M, 4) and looks of all worlds, or of M rows."""
        position, attitude = self.state.position, self.state.attitude
        looks = None if self.looks is None else self.looks.looks
        if rows is None:
            return position, attitude, looks
        return position[rows], attitude[rows], None if looks is None else looks[rows]

    @abstractmethod
    def render(self, rows: Tensor | None = None) -> Tensor:
        """Return images of the nose cameras, uint8 (M, height, width, 3).

        Args:
            rows: the worlds to render, a mask (N,) bool or indices (M,); all if None.

        Raises:
            RuntimeError: this simulator was made without a renderer.
        """

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

    @abstractmethod
    def close(self) -> None:
        """Free contexts and threads; the simulator is unusable afterwards."""


def no_images(closed: bool) -> RuntimeError:
    """Return the error for rendering with a simulator that is closed or has no renderer."""
    reason = "is closed" if closed else "was made with renderer=None"
    return RuntimeError(f"This simulator cannot render images: it {reason}.")
