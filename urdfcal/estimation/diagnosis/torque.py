"""Joint torques under gravity, from the inertials of the robot's URDF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session


def gravity_torques(session: Session, chain: Mechanism, q: Floats) -> Floats | None:
    """Compute the torques (N, n) that hold the arm against gravity, [N m or N]; None where the URDF has no masses.

    The base link's z axis points up.

    Args:
        session: with the URDF.
        chain: the joints.
        q: (N, n) joint values. [rad or m]
    """
    if session.urdf is None:
        return None
    model = pin.buildModelFromXML(session.urdf.text)
    if not all(model.existJointName(name) for name in chain.names):
        return None
    joints = [model.joints[model.getJointId(name)] for name in chain.names]
    data, tau = model.createData(), np.zeros_like(q)
    configuration = pin.neutral(model)
    for k, values in enumerate(q):
        for joint, value in zip(joints, values, strict=True):
            if joint.nq == 2:  # continuous
                configuration[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
            else:
                configuration[joint.idx_q] = value
        torque = pin.computeGeneralizedGravity(model, data, configuration)
        tau[k] = [torque[joint.idx_v] for joint in joints]
    return tau if np.any(tau) else None
