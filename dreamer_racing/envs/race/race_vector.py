"""The race as its drone would feel it: a vector in the drone's own frame, for state policies and informed losses.

Shape legend: N drones, G race gates. SI units before scaling, body frame FLU.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import align, rotate, rotate_inverse
from dreamer_racing.envs.simulator.base import DroneState
from dreamer_racing.envs.tracks import Track

RACE_VECTOR_SIZE = 21
VELOCITY, RATES, DISTANCE = 5.0, 5.0, 4.0  # m/s, rad/s, m

RACE_VECTOR_ENTRIES = (
    ("linear velocity of the drone", "m/s", VELOCITY),
    ("body rates of the drone", "rad/s", RATES),
    ("direction of the world's up", "1", 1.0),
    ("from the drone to the centre of the target gate", "m", DISTANCE),
    ("direction of flight through the target gate", "1", 1.0),
    ("from the drone to the centre of the gate after it", "m", DISTANCE),
    ("direction of flight through the gate after it", "1", 1.0),
)
"""Meaning, unit and divisor of each triple x, y, z of a race vector, all in the body frame."""


class RaceVector:
    """Computes the race vector of N drones, whose entries are those of ``RACE_VECTOR_ENTRIES``.

    Every entry is of order one [choice of divisors].

    Args:
        track: The track.
        device: Where the tensors live.
        dtype: Floating-point type of the drones' state.

    Example:
        >>> from dreamer_racing.envs.worlds import RaceWorlds
        >>> worlds = RaceWorlds("circle", num_envs=2, from_pixels=False)
        >>> worlds.reset()
        >>> worlds.vector().shape
        torch.Size([2, 21])
    """

    def __init__(self, track: Track, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64) -> None:
        self._positions = track.gate_positions(device, dtype)  # (G, 3)
        self._normals = track.gate_normals(device, dtype)  # (G, 3)
        self._up = torch.tensor([0.0, 0.0, 1.0], device=device, dtype=dtype)

    def __call__(self, state: DroneState, target_gate: Tensor) -> Tensor:
        """Return the vectors, float32 ``(N, 21)``.

        Args:
            state: Of the drones.
            target_gate: The gate to pass next, int64 ``(N,)``.
        """
        gates = torch.stack((target_gate, (target_gate + 1) % len(self._positions)), 1)  # (N, 2)
        to_gate = (self._positions[gates] - state.position.unsqueeze(1)) / DISTANCE  # (N, 2, 3)
        world = torch.cat(
            (
                (state.linear_velocity / VELOCITY).unsqueeze(1),
                self._up.expand(len(gates), 1, 3),
                torch.stack((to_gate, self._normals[gates]), 2).flatten(1, 2),
            ),
            1,
        )  # (N, 6, 3)
        body = rotate_inverse(state.attitude.unsqueeze(1).expand(-1, 6, 4), world)
        rates = (state.body_rates / RATES).unsqueeze(1)
        return torch.cat((body[:, :1], rates, body[:, 1:]), 1).flatten(1).float()

    def pose(self, vector: Tensor, target_gate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return where a drone is whose race looks like this, as well as one can say of vectors that are not exact.

        The attitude fits up, both gates' directions of flight and the line between them, by least squares; the position
        is that from which the target gate lies where it seems to.

        Args:
            vector: As ``__call__`` returns them, ``(N, 21)``.
            target_gate: The gate to pass next, int64 ``(N,)``.

        Returns:
            Positions ``(N, 3)`` in m, attitudes ``(N, 4)``, wxyz, and how badly these gates fit the vectors ``(N,)``:
            the mean square of what is left, of vectors of length 1.
        """
        gates = torch.stack((target_gate, (target_gate + 1) % len(self._positions)), 1)  # (N, 2)
        up, to_gate, direction, to_next, next_direction = vector.to(self._up.dtype).view(-1, 7, 3)[:, 2:].unbind(1)
        places, normals = self._positions[gates], self._normals[gates]
        body = torch.stack((up, direction, next_direction, DISTANCE * (to_next - to_gate)), 1)
        world = torch.cat((self._up.expand(len(gates), 1, 3), normals, places[:, 1:] - places[:, :1]), 1)  # (N, 4, 3)
        length = world.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        body, world = body / length, world / length
        attitude = align(body, world)
        misfit = (rotate(attitude.unsqueeze(1), body) - world).square().sum(-1).mean(-1)
        return places[:, 0] - rotate(attitude, DISTANCE * to_gate), attitude, misfit
