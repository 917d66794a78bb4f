"""Functions on single attitude quaternions (wxyz, body → world): product, rotation, difference and matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Numbers = Sequence[float] | np.ndarray  # a quaternion, (4,) wxyz


def product(first: Numbers, second: Numbers) -> tuple[float, ...]:
    """Multiply two quaternions, each (4,) wxyz: the rotation `second`, then `first`."""
    a, b, c, d = first
    w, x, y, z = second
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def conjugate(attitude: Numbers) -> tuple[float, ...]:
    """Return the inverse of an attitude (4,) wxyz of unit length."""
    w, x, y, z = attitude
    return (w, -x, -y, -z)


def turn(attitude: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turn an attitude (4,) wxyz by a rotation vector (3,) in rad, in the body frame."""
    angle = float(np.linalg.norm(rotation))
    half = 0.5 * angle
    scale = 0.5 if angle < 1e-9 else np.sin(half) / angle
    turned = np.array(product(attitude, (np.cos(half), *(scale * rotation))))
    return turned / np.linalg.norm(turned)


def rotation_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,), rad, body frame, that turns one attitude into another, the short way round.

    The inverse of `turn`: the logarithm of first⁻¹ second, each (4,) wxyz of unit length. It is the same for q and −q.
    """
    cosine, *vector = product(conjugate(first), second)  # cosine of half the angle, and its sine times the axis
    axis = np.array(vector)
    sine = float(np.linalg.norm(axis))
    half = math.atan2(sine, abs(cosine))
    scale = 2.0 if sine < 1e-9 else 2.0 * half / sine
    return math.copysign(scale, cosine) * axis


def rotation_matrix(attitude: np.ndarray) -> np.ndarray:
    """Return the rotation body → world (3, 3) of an attitude (4,) wxyz; its columns are forward, left and up."""
    w, x, y, z = attitude
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )
