"""URDF's roll-pitch-yaw angles and rotation matrices: R = Rz(yaw) Ry(pitch) Rx(roll), fixed axes."""

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
