"""Poses to tip placements and their derivatives: Pinocchio in the loop (DESIGN section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.robot.chain import se3

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class TipMotion:
    """Where the tip link is at N poses, and how it moves with every joint's placement.

    Attributes:
        R: (N, 3, 3) rotation part of T_base_tip.
        p: (N, 3) translation part of T_base_tip. [m]
        regressor: (N, 6, 6 n) velocity (linear, angular) of the tip frame, in axes parallel to the base
            link's, for placements moving as M_j <- M_j exp6(xi_j).
    """

    R: Floats
    p: Floats
    regressor: Floats


def tip_motion(chain: Chain, model: pin.Model, q: Floats) -> TipMotion:
    """Run forward kinematics and Pinocchio's joint kinematic regressor at every pose.

    Args:
        chain: the chain; its own placements are not used.
        model: of the chain with the placements to use, see ``Chain.build_model``.
        q: (N, n) joint values. [rad or m]
    """
    data, last = model.createData(), model.njoints - 1
    tip = se3(chain.T_last_tip)
    R, p = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
    regressor = np.empty((len(q), 6, 6 * len(chain.joints)))
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # Views of what every pass writes: asking Pinocchio for them each time costs a third of the loop.
    rotation, translation = data.oMi[last].rotation, data.oMi[last].translation
    for k, q_k in enumerate(q):
        pin.forwardKinematics(model, data, q_k)
        regressor[k] = pin.computeJointKinematicRegressor(model, data, last, aligned, tip)
        R[k], p[k] = rotation, translation
    return TipMotion(R @ tip.rotation, p + R @ tip.translation, regressor)


def tip_poses(chain: Chain, q: Floats, placements: Floats | None = None) -> Floats:
    """T_base_tip at every pose, without derivatives.

    Args:
        chain: the chain.
        q: (N, n) joint values. [rad or m]
        placements: (n, 4, 4) to use instead of the chain's own.

    Returns:
        (N, 4, 4).
    """
    model = chain.build_model(placements)
    data, last = model.createData(), model.njoints - 1
    T = np.empty((len(q), 4, 4))
    for k, q_k in enumerate(q):
        pin.forwardKinematics(model, data, q_k)
        T[k] = data.oMi[last].homogeneous
    result: Floats = T @ chain.T_last_tip
    return result


def joint_axes(chain: Chain) -> Floats:
    """The body twists (linear, angular) of the joints' motions, block by block: (6 n, n).

    A joint's motion stands to the right of its placement, so ``regressor @ joint_axes`` is the tip's Jacobian.
    """
    S = np.zeros((6 * len(chain.joints), len(chain.joints)))
    for i, joint in enumerate(chain.joints):
        first = 6 * i + (0 if joint.prismatic else 3)
        S[first : first + 3, i] = joint.axis
    return S
