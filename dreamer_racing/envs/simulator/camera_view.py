"""The nose camera's geometry in torch: its pose on a drone, points in its axes, and whether they are in view.

Shapes: M drones, L points.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.simulator.scene import Camera


class NoseMount:
    """Computes the camera poses of drones."""

    def __init__(self, camera: Camera, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64) -> None:
        self._mount = torch.tensor(camera.position, device=device, dtype=dtype)
        self._tilt = torch.tensor([camera.tilt], device=device, dtype=dtype)

    def __call__(self, position: Tensor, attitude: Tensor, tilt: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the camera positions (M, 3), m, and axes (M, 3, 3) with rows right, up, backwards, in the world.

        Args:
            position: positions of the drones, (M, 3), m.
            attitude: attitudes of the drones, (M, 4) wxyz.
            tilt: tilts of the cameras, (M,), degrees upwards; the camera's own if None.
        """
        angle = torch.deg2rad(self._tilt if tilt is None else tilt)
        cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        right = torch.stack((zero, zero - 1.0, zero), -1)
        up, backwards = torch.stack((-sine, zero, cosine), -1), torch.stack((-cosine, zero, -sine), -1)
        axes = torch.stack((right, up, backwards), 1).expand(len(position), -1, -1)  # (M, 3, 3) in the body frame
        eye = position + rotate(attitude, self._mount.expand_as(position))
        return eye, rotate(attitude.unsqueeze(1).expand(-1, 3, -1), axes)


def points_in_camera(position: Tensor, attitude: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """Return points (M, L, 3) in the axes of drones' cameras, m: along the optical axis, to the left, and up.

    Args:
        position: positions of the drones, (M, 3), m.
        attitude: attitudes of the drones, (M, 4) wxyz, body → world.
        points: points in the world, (L, 3), or separate ones for each drone (M, L, 3), m.
        camera: the nose camera.
    """
    eye, axes = NoseMount(camera, position.device, position.dtype)(position, attitude)
    right, up, backwards = ((points - eye.unsqueeze(1)) @ axes.mT).unbind(-1)
    return torch.stack((-backwards, -right, up), dim=-1)


def is_in_view(points: Tensor, camera: Camera) -> Tensor:
    """Return whether points (..., 3) in the camera's axes project into the image, (...) bool."""
    up = math.tan(math.radians(camera.field_of_view) / 2)
    left = up * camera.width / camera.height
    depth = points[..., 0]
    return (depth > 0) & (points[..., 1].abs() <= left * depth) & (points[..., 2].abs() <= up * depth)
