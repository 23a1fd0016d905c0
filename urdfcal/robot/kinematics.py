"""Forward kinematics of links and its derivatives, by Pinocchio (METHOD 5)."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.robot.mechanism import se3

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Joint, Mechanism, Tip


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """A link's frame at N poses, and its derivatives with respect to every joint's placement.

    Attributes:
        R: (N, 3, 3) rotation part of T_base_link.
        p: (N, 3) translation part of T_base_link. [m]
        regressor: (N, 6, 6 n) velocity (linear, angular) of the link's frame, in axes parallel to the base
            link's, for placements moving as M_j <- M_j exp6(xi_j).
    """

    R: Floats
    p: Floats
    regressor: Floats


class Buffers:
    """Pinocchio's model and what it computes into, for one thread at a time: ``with buffers as (model, data)``."""

    def __init__(self, model: pin.Model) -> None:
        """Make them for a model, which is then no one else's."""
        self._both, self._lock = (model, model.createData()), Lock()

    def __enter__(self) -> tuple[pin.Model, pin.Data]:
        """Wait for the other threads."""
        self._lock.acquire()
        return self._both

    def __exit__(self, *_: object) -> None:
        """Let another thread go on."""
        self._lock.release()


def link_motions(mechanism: Mechanism, model: pin.Model, q: Floats, tips: Sequence[Tip]) -> tuple[LinkMotion, ...]:
    """Compute the frames of some links and Pinocchio's joint kinematic regressors for them at every pose.

    Args:
        mechanism: the joints; their own placements are not used.
        model: of them with the placements to use, see ``Mechanism.build_model``.
        q: (N, n) joint values. [rad or m]
        tips: the links.
    """
    regressors = np.zeros((len(tips), len(q), 6, 6 * len(mechanism.joints)))
    frames = _frames(model, q, tips, regressors)
    return tuple(LinkMotion(T[:, :3, :3], T[:, :3, 3], of) for T, of in zip(frames, regressors, strict=True))


def tip_motion(mechanism: Mechanism, model: pin.Model, q: Floats) -> LinkMotion:
    """Compute the tip link's frames and regressor; see :func:`link_motions`."""
    return link_motions(mechanism, model, q, mechanism.tips[:1])[0]


def link_poses(
    mechanism: Mechanism, q: Floats, tips: Sequence[Tip], placements: Floats | None = None
) -> tuple[Floats, ...]:
    """Compute the frames T_base_link of some links at every pose, without derivatives.

    Args:
        mechanism: the joints.
        q: (N, n) joint values. [rad or m]
        tips: the links.
        placements: (n, 4, 4) to use instead of the mechanism's own.

    Returns:
        (N, 4, 4) for each link. [m]
    """
    return tuple(_frames(mechanism.build_model(placements), q, tips))


def tip_poses(mechanism: Mechanism, q: Floats, placements: Floats | None = None) -> Floats:
    """Compute the tip link's frame T_base_tip (N, 4, 4) at every pose; see :func:`link_poses`."""
    return link_poses(mechanism, q, mechanism.tips[:1], placements)[0]


def joint_axes(mechanism: Mechanism) -> Floats:
    """The joints' unit body twists (linear, angular), block by block: (6 n, n).

    A joint's motion multiplies its placement from the right, so ``regressor @ joint_axes`` is a link's Jacobian.
    """
    S = np.zeros((6 * len(mechanism.joints), len(mechanism.joints)))
    for i, joint in enumerate(mechanism.joints):
        first = 6 * i + (0 if joint.prismatic else 3)
        S[first : first + 3, i] = joint.axis
    return S


def joint_motion(joint: Joint, value: float) -> Floats:
    """Compute the transform (4, 4) of a joint's motion to a value [rad or m], in the joint's own frame. [m]."""
    T = np.eye(4)
    if joint.prismatic:
        T[:3, 3] = value * joint.axis
    else:
        T[:3, :3] = pin.exp3(value * joint.axis)
    return T


def _frames(model: pin.Model, q: Floats, tips: Sequence[Tip], regressors: Floats | None = None) -> Floats:
    """Frames (L, N, 4, 4) of links at every pose; their regressors (L, N, 6, 6 n) are filled in where asked for."""
    data = model.createData()
    T = np.zeros((len(tips), len(q), 4, 4))
    T[..., 3, 3] = 1.0
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    # Views of what every pass writes: asking Pinocchio for them each time costs a third of the loop.
    views = []
    for T_i, tip in zip(T, tips, strict=True):
        M = data.oMi[tip.joint + 1]
        views.append((tip.joint + 1, se3(tip.T_joint_link), M.rotation, M.translation, T_i[:, :3, :3], T_i[:, :3, 3]))
    for k, q_k in enumerate(q):
        pin.forwardKinematics(model, data, q_k)
        for i, (joint, link, rotation, translation, R_i, p_i) in enumerate(views):
            if regressors is not None and joint:  # what is fixed to the base link does not move
                regressors[i, k] = pin.computeJointKinematicRegressor(model, data, joint, aligned, link)
            R_i[k] = rotation
            p_i[k] = translation
    result: Floats = T @ np.array([tip.T_joint_link for tip in tips]).reshape(-1, 1, 4, 4)
    return result
