"""Unit quaternions (wxyz, body → world) on batched tensors.

Shapes: every function broadcasts over leading dimensions; quaternions end in 4, vectors in 3.
"""

import torch
from torch import Tensor


def rotate(attitude: Tensor, vector: Tensor) -> Tensor:
    """Rotate body-frame vectors (..., 3) into the world by attitudes (..., 4), wxyz."""
    w, xyz = attitude[..., :1], attitude[..., 1:]
    cross = 2.0 * torch.linalg.cross(xyz, vector)
    return vector + w * cross + torch.linalg.cross(xyz, cross)


def rotate_inverse(attitude: Tensor, vector: Tensor) -> Tensor:
    """Rotate world-frame vectors (..., 3) into the body by attitudes (..., 4), wxyz."""
    w, xyz = attitude[..., :1], attitude[..., 1:]
    cross = 2.0 * torch.linalg.cross(xyz, vector)
    return vector - w * cross + torch.linalg.cross(xyz, cross)


def turn(attitude: Tensor, rotation: Tensor) -> Tensor:
    """Turn attitudes (..., 4), wxyz, by small body-frame rotation vectors (..., 3) in rad."""
    half, w, xyz = rotation / 2.0, attitude[..., :1], attitude[..., 1:]
    change = torch.cat((-(xyz * half).sum(-1, keepdim=True), w * half + torch.linalg.cross(xyz, half)), dim=-1)
    return torch.nn.functional.normalize(attitude + change, dim=-1)


def from_roll_pitch_yaw(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Return attitudes (..., 4), wxyz, from intrinsic z-y'-x'' (yaw, pitch, roll) angles in radians, each (...)."""
    cr, sr = torch.cos(roll / 2), torch.sin(roll / 2)
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        dim=-1,
    )


def align(body: Tensor, world: Tensor) -> Tensor:
    """Return the attitudes (..., 4), wxyz, that best rotate body-frame vectors (..., K, 3) into world ones (..., K, 3).

    They minimise the sum of squared distances, and are unique for K ≥ 2 vectors that are not parallel.

    Reference: Horn 1987, "Closed-form solution of absolute orientation using unit quaternions", Section 4.
    """
    products = torch.einsum("...ki,...kj->...ij", body, world)
    trace = products.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    cross = torch.linalg.cross(body, world).sum(-2)
    symmetric = products + products.mT - trace * torch.eye(3, dtype=body.dtype, device=body.device)
    upper = torch.cat((trace, cross.unsqueeze(-2)), -1)
    matrix = torch.cat((upper, torch.cat((cross.unsqueeze(-1), symmetric), -1)), -2)
    return torch.linalg.eigh(matrix).eigenvectors[..., -1]
