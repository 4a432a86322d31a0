"""Rotations as unit quaternions (w, x, y, z): q turns the axes of a body to those of the world.

Of one body as shape (4,), or of many as shape (b, 4).
"""

from __future__ import annotations

import numpy as np

from solvers.solution import Floats

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def rotation_matrix(q: Floats) -> Floats:
    """Matrix R of a rotation, x_world = R x_body; shape (3, 3), or (b, 3, 3) of many."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotation_of(matrix: Floats) -> Floats:
    """Quaternion of a rotation matrix, shape (4,), w ≥ 0: the eigenvector of Davenport's matrix (Bar-Itzhack 2000)."""
    m = np.asarray(matrix, dtype=np.float64)
    skew = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    K = np.empty((4, 4))
    K[0, 0] = np.trace(m)
    K[0, 1:] = K[1:, 0] = skew
    K[1:, 1:] = m + m.T - np.trace(m) * np.eye(3)
    q: Floats = np.linalg.eigh(K)[1][:, -1]
    return -q if q[0] < 0.0 else q


def multiply(p: Floats, q: Floats) -> Floats:
    """Rotation q, then p: R(p) R(q); shape (4,)."""
    w, x, y, z = p
    turn = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: Floats = turn @ np.asarray(q, dtype=np.float64)
    return product


def inverse(q: Floats) -> Floats:
    """Rotation back; shape (4,) or (b, 4)."""
    turned: Floats = np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])
    return turned


def about(axis: tuple[float, float, float] | Floats, angle: float) -> Floats:
    """Rotation about an axis of any length by an angle [rad]; shape (4,)."""
    direction = np.asarray(axis, dtype=np.float64)
    unit = direction / np.linalg.norm(direction)
    return np.concatenate([[np.cos(0.5 * angle)], np.sin(0.5 * angle) * unit])
