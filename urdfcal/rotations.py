"""Rotations: URDF's roll-pitch-yaw angles, quaternions, rotation vectors and cross products."""

from __future__ import annotations

from math import atan2, cos, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# Below this cosine of the pitch the yaw is rounding noise: products of a few rotation matrices carry
# errors of 2e-16 to 8e-16 in their entries. Taking it for zero changes the matrix by no more than this.
GIMBAL_LOCK = 1e-15


def rpy_to_matrix(rpy: ArrayLike) -> Floats:
    """Turn roll, pitch and yaw into a rotation matrix.

    Args:
        rpy: (3,) roll, pitch, yaw about the fixed x, y, z axes. [rad]

    Returns:
        (3, 3) R = Rz(yaw) Ry(pitch) Rx(roll), read-only.
    """
    roll, pitch, yaw = (float(angle) for angle in np.asarray(rpy, dtype=float))
    sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
    return frozen(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_to_rpy(R: ArrayLike) -> Floats:
    """Turn a rotation matrix into roll, pitch in [-pi/2, pi/2], and yaw.

    The yaw comes first; pitch and roll are then read off Rz(-yaw) R. Whatever the yaw, even one of pure
    rounding noise near gimbal lock, the roll makes up for it, and the three angles give back R to rounding
    (the usual asin and atan2 of single entries lose half the digits there). At gimbal lock yaw = 0.

    Args:
        R: (3, 3) rotation matrix.

    Returns:
        (3,) roll, pitch, yaw, none of them -0.0, read-only. [rad]
    """
    R = np.asarray(R, dtype=float) + 0.0  # -0.0 + 0.0 = 0.0: no half turn of the wrong sign
    yaw = atan2(R[1, 0], R[0, 0]) if hypot(R[0, 0], R[1, 0]) > GIMBAL_LOCK else 0.0
    s, c = sin(yaw), cos(yaw)
    pitch = atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = atan2(s * R[0, 2] - c * R[1, 2] + 0.0, c * R[1, 1] - s * R[0, 1])
    return frozen([roll + 0.0, pitch + 0.0, yaw + 0.0])


def quaternion_to_matrix(xyzw: ArrayLike) -> Floats:
    """Turn a quaternion (4,), x y z w, of any length but zero, into a rotation matrix (3, 3)."""
    q = np.asarray(xyzw, dtype=float)
    x, y, z, w = q / hypot(*q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(R: Floats) -> Floats:
    """Turn rotation matrices (..., 3, 3) into unit quaternions (..., 4), x y z w.

    Of the four ways to write a quaternion from a matrix, each dividing by one component, the one with the largest
    divisor is taken (Shepperd, J. Guidance and Control 1(3), 1978).
    """
    x, y, z = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # 4 q q^T, whose columns are all parallel to q.
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., range(4), range(4)] = 1 + np.stack([x - y - z, y - z - x, z - x - y, x + y + z], axis=-1)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., i, j] = outer[..., j, i] = R[..., i, j] + R[..., j, i]
        outer[..., k, 3] = outer[..., 3, k] = R[..., j, i] - R[..., i, j]
    best = np.argmax(outer[..., range(4), range(4)], axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    result: Floats = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return result


def rotation_vector_to_matrix(w: Floats) -> Floats:
    """Turn rotation vectors (..., 3), axis times angle, into rotation matrices (..., 3, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    W = skew(w)
    # sinc(x) is sin(pi x) / (pi x): both factors keep their digits at no angle at all.
    R: Floats = np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * (W @ W)
    return R


def matrix_to_rotation_vector(R: Floats) -> Floats:
    """Turn rotation matrices (..., 3, 3) into rotation vectors (..., 3), axis times angle.

    Small angles keep their digits; close to half a turn the axis loses them.
    """
    v = 0.5 * np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1.0))
    result: Floats = v * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return result


def turn_z_to(direction: ArrayLike) -> Floats:
    """The smallest rotation (3, 3) that takes the z axis to a direction (3,) of any length."""
    import pinocchio as pin  # not needed to read a URDF

    R: Floats = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(direction, dtype=float)).matrix()
    return R


def skew(v: Floats) -> Floats:
    """Cross-product matrices: ``skew(v) @ w == cross(v, w)``; (..., 3) -> (..., 3, 3)."""
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result
