"""Pinhole projection of `scene.Camera` in torch: points in the nose camera's axes, and whether they are in view.

Shapes: M drones, L points.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import rotate, rotate_inverse
from dreamer_racing.envs.simulator.scene import Camera


def points_in_camera(position: Tensor, attitude: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """Return points in the camera's axes.

    Args:
        position: positions of the drones, (M, 3), m.
        attitude: attitudes of the drones, (M, 4) wxyz, body → world.
        points: points in the world, (L, 3), or separate ones for each drone (M, L, 3), m.
        camera: the nose camera.

    Returns:
        (M, L, 3) m: along the optical axis, to the left, and up in the image.
    """
    mount = torch.tensor(camera.position, dtype=position.dtype, device=position.device)
    eye = position + rotate(attitude, mount.expand_as(position))  # (M, 3)
    body = rotate_inverse(attitude.unsqueeze(1).expand(-1, points.shape[-2], 4), points - eye.unsqueeze(1))  # (M, L, 3)
    x, left, z = body.unbind(-1)
    cosine, sine = math.cos(math.radians(camera.tilt)), math.sin(math.radians(camera.tilt))
    return torch.stack((cosine * x + sine * z, left, cosine * z - sine * x), dim=-1)


def is_in_view(points: Tensor, camera: Camera) -> Tensor:
    """Return whether points (..., 3) in the camera's axes project into the image, (...) bool."""
    up = math.tan(math.radians(camera.field_of_view) / 2)
    left = up * camera.width / camera.height
    depth = points[..., 0]
    return (depth > 0) & (points[..., 1].abs() <= left * depth) & (points[..., 2].abs() <= up * depth)
