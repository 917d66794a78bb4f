"""The rate loop of ``preset=betaflight`` by itself, as the simulator's kernel computes it."""

# warp reads annotations as they are: no `from __future__ import annotations` here

from functools import cache
from typing import Any

import numpy as np
import torch

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.drone.rate_loop import RateLoop
from dreamer_racing.envs.simulator import fused_rate_loop
from dreamer_racing.envs.simulator.warp_device import load_warp


@cache
def make_kernel() -> Any:
    """Make the kernel that advances one flight controller by 1 ms."""
    wp = load_warp()
    vec3 = wp.types.vector(3, wp.float64)
    Firmware, motor_commands = fused_rate_loop.make_kernels(torch.float64)

    @wp.kernel
    def advance(
        firmware: Firmware,
        setpoint: wp.array(dtype=wp.float64),
        gyro: wp.array(dtype=wp.float64),
        motors: wp.array(dtype=wp.float64),
        memory: wp.array2d(dtype=vec3),
        own: wp.array2d(dtype=vec3),
    ):
        wanted = vec3(setpoint[1], setpoint[2], setpoint[3])
        rates = vec3(gyro[0], gyro[1], gyro[2])
        commands = motor_commands(firmware, 0, setpoint[0], wanted, rates, memory, own)
        for rotor in range(4):
            motors[rotor] = commands[rotor]

    return advance


class RateController:
    """One flight controller.

    Attributes:
        thrust_max: N, of four motors at full command.
    """

    def __init__(self) -> None:
        loop = self._loop = RateLoop(PRESETS["betaflight"], 1)
        self.thrust_max = loop.thrust_max
        tensors = [torch.zeros(size, dtype=torch.float64) for size in (4, 3, 4)]
        self._setpoint, self._gyro, self._motors = (tensor.numpy() for tensor in tensors)
        wp = load_warp()
        common = fused_rate_loop.fill(loop, fused_rate_loop.make_kernels(torch.float64)[0])
        inputs = [common, *map(wp.from_torch, tensors), *fused_rate_loop.arrays(loop, tensors[0])]
        self._advance = wp.launch(make_kernel(), 1, inputs=inputs, device="cpu", record_cmd=True)

    def reset(self) -> None:
        """Forget everything, as when it is armed."""
        self._loop.reset(torch.ones(1, 1, dtype=torch.bool))

    def motors(self, thrust: float, rates: np.ndarray, gyro: np.ndarray) -> np.ndarray:
        """Let 1 ms pass; return the motor commands, M1 … M4.

        Args:
            thrust: N, wanted of four motors.
            rates: (3,) rad/s, wanted, FLU.
            gyro: (3,) rad/s, measured, FLU.
        """
        self._setpoint[0], self._setpoint[1:], self._gyro[:] = thrust, rates, gyro
        self._advance.launch()
        return self._motors.copy()
