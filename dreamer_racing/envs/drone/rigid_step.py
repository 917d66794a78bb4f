"""One physics step of N drones: controller and motors compute a wrench, MuJoCo integrates the rigid bodies.

This is the torch reference of the physics, against which `simulator.fused_flight` is tested. The simulators use the
fused kernels.

Shapes: N drones. SI units, attitude wxyz, `qpos` (N, 7) is position and attitude, `qvel` (N, 6) is the velocity in the
world and the body rates in the body frame, as in MuJoCo's free joint.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rotation import rotate, turn


class RigidStep:
    """Quadrotors on MuJoCo's rigid bodies.

    The force is applied in its mid-step direction. Still, MuJoCo's Euler step is first order: v' = v + h·a(x, v), then
    x' = x + h·v', which accumulates an error of 7 cm over two seconds of racing. Two corrections make it second order
    (docs/simulation.md has the figures): the torque is corrected for the difference between the gyroscopic torques at
    the start and in the middle of the step, and half of the overshoot h·(v' − v) is subtracted from the pose. RK4
    needs neither.

    Args:
        quadrotor: controllers and motors.
        qpos: (N, 7) view of MuJoCo's positions and attitudes.
        qvel: (N, 6) view of MuJoCo's velocities and body rates.
        qfrc_applied: (N, 6) view of MuJoCo's applied force (world frame) and torque (body frame).
        integrate: makes one physics step with the current `qfrc_applied`.
    """

    def __init__(
        self,
        quadrotor: Quadrotor,
        qpos: Tensor,
        qvel: Tensor,
        qfrc_applied: Tensor,
        integrate: Callable[[], None],
    ) -> None:
        self.quadrotor = quadrotor
        self.position, self.attitude = qpos[:, :3], qpos[:, 3:]
        self.linear_velocity, self.body_rates = qvel[:, :3], qvel[:, 3:]
        self._qvel, self._integrate = qvel, integrate
        self._force, self._torque = qfrc_applied[:, :3], qfrc_applied[:, 3:]
        self._corrected = quadrotor.parameters.integrator != "RK4"
        self._half_step = 0.5 * quadrotor.parameters.physics_dt

    def step(self, physics_step: int) -> None:
        """Simulate one physics step, given its index in the control step."""
        self.apply(self.quadrotor.wrench(physics_step, self.attitude, self.linear_velocity, self.body_rates))

    def apply(self, wrench: Tensor) -> None:
        """Move the bodies by one physics step under a wrench (N, 6), body frame, N and N m."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        gyroscopic = self.quadrotor.gyroscopic_torque(self.body_rates)
        rates = self.quadrotor.rates_half_a_step_later(self.body_rates, torque, gyroscopic)
        force = torch.add(force, torch.linalg.cross(rates, force), alpha=self._half_step)
        self._force.copy_(rotate(self.attitude, force))
        if not self._corrected:
            self._torque.copy_(torque)
            self._integrate()
            return
        torch.add(torque, gyroscopic - self.quadrotor.gyroscopic_torque(rates), out=self._torque)
        before = self._qvel.clone()
        self._integrate()
        overshoot = (before - self._qvel).mul_(self._half_step)  # (N, 6), m and rad, negative
        self.position.add_(overshoot[:, :3])
        self.attitude.copy_(turn(self.attitude, overshoot[:, 3:]))
