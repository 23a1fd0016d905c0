"""What one joint does to its link."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Joint


def joint_motion(joint: Joint, value: float) -> Floats:
    """The link's frame (4, 4) in the joint's own, at a value [rad or m]: turned about or moved along its axis."""
    T = np.eye(4)
    if joint.prismatic:
        T[:3, 3] = value * joint.axis
    else:
        T[:3, :3] = pin.exp3(value * joint.axis)
    return T
