"""State of the flight controllers and motors of N quadrotors, and each drone's randomised parameters.

Rotor speeds, delayed commands and parameters are tensors that are updated in place, so that a CUDA graph can advance
them. `simulator.fused_flight` does: its kernels turn collective thrust and body rates (CTBR) into force and torque.

Shapes: N drones. SI units, body frame FLU. The numbers and their sources: `envs.drone.parameters`.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters, Randomisation
from dreamer_racing.envs.drone.rate_loop import DroneParameter, RateLoop

RELATIVE = ("mass", "inertia", "drag", "thrust", "torque")  # parameters that are randomised by a factor


class Quadrotor:
    """Flight controllers and motors of N drones.

    Args:
        dtype: floating-point type; MuJoCo's own (float64) on CPU.
        generator: source of the per-episode randomisation, on `device`; needed only if parameters are randomised.

    Attributes:
        drones: each drone's parameters relative to nominal: mass (N, 1), inertia (N, 3), drag, thrust and torque
            (N, 1); and its command delay (N,), int64 physics steps.
        rotor_speed: (N, 4) √N: a rotor's thrust is its square.
        setpoints: (history + 1, N, 4) N and rad/s, newest first.
        rate_loop: the Betaflight flight controllers; None if body rates are controlled by a proportional loop.
        effort: (N, 3) of the control step so far: share of its physics steps with a rotor target at a limit, mean
            commanded collective thrust in N, and mean shortfall in N of the rotor targets, which the mixer reduces in
            favour of body rates or at the rotors' limits.
    """

    def __init__(
        self,
        parameters: QuadrotorParameters,
        num_drones: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
        generator: torch.Generator | None = None,
    ) -> None:
        self.parameters = p = parameters
        self._generator = generator

        def repeated(*values: float) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype).repeat(num_drones, 1)

        # affine map from actions in [-1, 1] to total thrust, N, and body rates, rad/s
        thrust_scale = p.collective_thrust_scale * p.mass
        self._setpoint_scale = repeated(thrust_scale, *p.body_rate_max)  # (N, 4)
        self._setpoint_offset = repeated(thrust_scale, 0.0, 0.0, 0.0)  # (N, 4)
        self._hover_setpoint = repeated(p.mass * GRAVITY, 0.0, 0.0, 0.0)  # (N, 4)
        self._hover_speed = math.sqrt(p.mass * GRAVITY / 4.0)
        self.motor_decay = math.exp(-p.physics_dt / p.motor_time_constant)
        self.rotor_speed = repeated(*[self._hover_speed] * 4)
        delay_max = p.randomisation.delay_max if p.randomisation else p.command_delay
        history = math.ceil(round(delay_max / p.physics_dt) / p.physics_steps)
        self.setpoints = self._hover_setpoint.repeat(history + 1, 1, 1)
        self.drones = {name: repeated(*[1.0] * (3 if name == "inertia" else 1)) for name in RELATIVE}
        self.drones["delay_steps"] = torch.full((num_drones,), round(p.command_delay / p.physics_dt), device=device)
        self.effort = repeated(0.0, 0.0, 0.0)
        self.rate_loop = None if p.betaflight is None else RateLoop(p, num_drones, device, dtype)
        if self.rate_loop is not None:
            self.set_motors(torch.ones(num_drones, 1, dtype=torch.bool, device=device), 1.0, 0.0)

    def reset(self, mask: Tensor) -> None:
        """Reset the masked drones (N,) bool: rotors at hover, no pending commands, newly drawn parameters."""
        rows = mask.unsqueeze(-1)  # (N, 1)
        self.rotor_speed.masked_fill_(rows, self._hover_speed)
        self.setpoints.copy_(torch.where(rows, self._hover_setpoint, self.setpoints))
        widths = self.parameters.randomisation
        if widths is not None:
            self._randomise(rows, widths)
        if self.rate_loop is not None:
            frame = 0.0 if widths is None else (self._uniform(len(mask)) * self.rate_loop.frame_steps).floor()
            self.rate_loop.reset(rows, frame)

    def _randomise(self, rows: Tensor, widths: Randomisation) -> None:
        num_drones = len(rows)
        for name in RELATIVE:
            current = self.drones[name]
            noise = 2.0 * self._uniform(*current.shape) - 1.0
            current.copy_(torch.where(rows, 1.0 + getattr(widths, name) * noise, current))
        delay = widths.delay_min + (widths.delay_max - widths.delay_min) * self._uniform(num_drones)
        delay = (delay / self.parameters.physics_dt).round().long()
        self.drones["delay_steps"].copy_(torch.where(rows[:, 0], delay, self.drones["delay_steps"]))
        if self.rate_loop is not None:
            own = self.rate_loop.drone_parameters
            noise = 2.0 * self._uniform(num_drones, 4, 3) - 1.0
            relative = torch.cat((1.0 + widths.gains * noise[:, :3], 1.0 + widths.filters * noise[:, 3:]), dim=1)
            own[:, : DroneParameter.MOTORS] = torch.where(rows.unsqueeze(-1), relative, own[:, : DroneParameter.MOTORS])
            lag = 1.0 + widths.motor_lag * (2.0 * self._uniform(num_drones, 1) - 1.0)
            self.set_motors(rows, lag, widths.sag_max * self._uniform(num_drones, 1))

    def set_motors(self, rows: Tensor, lag: Tensor | float, sag: Tensor | float) -> None:
        """Set the relative motor lag and the battery sag at full load of masked drones (N, 1) with a `rate_loop`."""
        assert self.rate_loop is not None
        motors = self.rate_loop.drone_parameters[:, DroneParameter.MOTORS]
        decay = math.log(self.motor_decay) / (torch.ones_like(motors[:, :1]) * lag)
        values = torch.cat((decay.exp(), (0.5 * decay).exp(), torch.zeros_like(decay) + sag), dim=1)
        motors.copy_(torch.where(rows, values, motors))

    def _uniform(self, *shape: int) -> Tensor:
        like = self.rotor_speed
        return torch.rand(shape, generator=self._generator, device=like.device, dtype=like.dtype)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of controllers and motors, and each drone's parameters."""
        drones = {name: values.clone() for name, values in self.drones.items()}
        state = {"rotor_speed": self.rotor_speed.clone(), "setpoints": self.setpoints.clone(), "drones": drones}
        if self.rate_loop is not None:
            state["rate_loop"] = self.rate_loop.state.clone()
            state["rate_loop_own"] = self.rate_loop.drone_parameters.clone()
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.rotor_speed.copy_(state_dict["rotor_speed"])
        self.setpoints.copy_(state_dict["setpoints"])
        for name, values in state_dict["drones"].items():
            self.drones[name].copy_(values)
        if self.rate_loop is not None:
            self.rate_loop.state.copy_(state_dict["rate_loop"])
            self.rate_loop.drone_parameters.copy_(state_dict["rate_loop_own"])

    def command(self, action: Tensor) -> None:
        """Set the actions (N, 4) in [-1, 1] of the next control step: collective thrust and body rates x, y, z."""
        action = action.to(self.setpoints).clamp(-1.0, 1.0)
        setpoint = torch.addcmul(self._setpoint_offset, action, self._setpoint_scale)
        self.setpoints.copy_(torch.cat((setpoint.unsqueeze(0), self.setpoints[:-1])))
