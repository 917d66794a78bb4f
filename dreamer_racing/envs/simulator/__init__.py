"""Batched simulators: N drones in N worlds, stepped and rendered together.

`MujocoSimulator` runs on CPU. A CUDA backend implements the same `Simulator` interface.
"""

from dreamer_racing.envs.simulator.base import DroneState, Simulator
from dreamer_racing.envs.simulator.mujoco_cpu import MujocoSimulator

__all__ = ["DroneState", "MujocoSimulator", "Simulator"]
