"""What the race needs of a simulator: the seam between the CPU backend and a CUDA one.

Shapes: N worlds, P physics steps per control step. SI units, attitude wxyz.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class DroneState:
    """Rigid-body state of N drones."""

    position: Tensor  # (N, 3) m, world
    attitude: Tensor  # (N, 4) wxyz, body → world
    linear_velocity: Tensor  # (N, 3) m/s, world
    body_rates: Tensor  # (N, 3) rad/s, body frame


class Simulator(Protocol):
    """N worlds with one drone each."""

    num_envs: int
    device: torch.device
    dtype: torch.dtype

    @property
    def state(self) -> DroneState:
        """The present state; its tensors may be views that the next step overwrites."""
        ...

    def reset(self, mask: Tensor, position: Tensor, attitude: Tensor, linear_velocity: Tensor) -> None:
        """Put the masked drones (N,) bool at rest in rotation at the given poses (N, ·), rotors at hover."""
        ...

    def step(self, action: Tensor) -> Tensor:
        """Fly one control step with finite actions (N, 4).

        Returns:
            (P + 1, N, 3) positions from the start to the end of the step, one per physics step.
        """
        ...

    def render(self, mask: Tensor | None = None) -> Tensor:
        """Images of the nose cameras, uint8 (M, height, width, 3): of all worlds, or of the M masked ones in order."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, for `torch.save`."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        ...

    def close(self) -> None:
        """Free contexts and threads; the simulator is unusable afterwards."""
        ...
