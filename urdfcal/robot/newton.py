"""Newton's method on one joint command at a time: quick where nothing is singular and no joint is at its limit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from urdfcal.robot.kinematics import Buffers
from urdfcal.robot.mechanism import se3

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism


# With the derivatives of the start each step leaves a hundredth of the error; where it leaves more than this share,
# derivatives are taken anew.
_STEPS, _SLOW = 12, 0.03
# Arrived, on the scale of the reach, and a step that is none [rad]: what is left is rounding.
_ARRIVED = 1e-10
# An arm of fewer joints than this cannot reach every pose: where it is closest, derivatives are from this near. [rad]
_FREEDOM, _NEAR = 6, 1e-3
_EYES = {n: np.eye(n) for n in (3, 6)}


class TrueValuesOfOne(Protocol):
    """What joints do that are told to be somewhere."""

    def values(self, q: Floats) -> Floats:
        """Compute for a command (k,) the true values (n,) of all joints. [rad or m]."""

    def slopes(self, q: Floats) -> Floats:
        """Compute the derivative (n, k) of :meth:`values`."""


@dataclass(frozen=True, eq=False)
class AsTold:
    """Joints that are where they are told, mimic joints where their master takes them.

    Attributes:
        mechanism: the joints.
    """

    mechanism: Mechanism

    @cached_property
    def _affine(self) -> tuple[Floats, Floats] | None:
        """The derivative (n, k) and the values (n,) at zero; None where all joints are actuated."""
        chain = self.mechanism
        J, zero = chain.reading_jacobian, chain.joint_values(np.zeros(len(chain.actuated)))
        return None if np.array_equal(J, np.eye(len(J))) and not zero.any() else (J, zero)

    def values(self, q: Floats) -> Floats:
        """Compute for a command (k,) the values (n,) of all joints. [rad or m]."""
        if self._affine is None:
            return q
        J, zero = self._affine
        result: Floats = J @ q + zero
        return result

    def slopes(self, q: Floats) -> Floats:
        """Return the derivative (n, k) of :meth:`values`."""
        del q
        return self.mechanism.reading_jacobian


@dataclass(frozen=True, eq=False)
class TipAtOnce:
    """A mechanism's first tip for one configuration at a time, by Pinocchio without detours.

    Threads may share it: each call has Pinocchio's buffers for itself.

    Attributes:
        mechanism: the joints, with the placements to use.
    """

    mechanism: Mechanism

    @cached_property
    def _buffers(self) -> Buffers:
        return Buffers(self.mechanism.build_model())

    @cached_property
    def told(self) -> AsTold:
        """Joints that are where they are told."""
        return AsTold(self.mechanism)

    @cached_property
    def limits(self) -> tuple[Floats, Floats]:
        """Lower and upper limits (k,) of the actuated joints. [rad or m]."""
        return self.mechanism.limits

    @cached_property
    def reach(self) -> float:
        """Of the arm. [m]."""
        return self.mechanism.reach

    @cached_property
    def _tip(self) -> tuple[int, pin.SE3]:
        """Pinocchio's number of the joint that carries the tip, and T_joint_tip."""
        tip = self.mechanism.tips[0]
        return tip.joint + 1, se3(tip.T_joint_link)

    def pose(self, values: Floats) -> pin.SE3:
        """Compute T_base_tip at the values (n,) of all joints."""
        joint, link = self._tip
        with self._buffers as (model, data):
            pin.forwardKinematics(model, data, values)
            return data.oMi[joint] * link

    def jacobian(self, values: Floats) -> tuple[pin.SE3, Floats]:
        """Compute T_base_tip, and its velocity (6, n) per joint (linear, angular) in axes parallel to the base's."""
        joint, link = self._tip
        with self._buffers as (model, data):
            pin.computeJointJacobians(model, data, values)
            T = data.oMi[joint] * link
            if not joint:
                return T, np.zeros((6, len(values)))
            J: Floats = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            arm = T.translation - data.oMi[joint].translation
        J[:3] -= pin.skew(arm) @ J[3:]
        return T, J


def reach_pose(
    tip: TipAtOnce, T: pin.SE3, q: Floats, limits: tuple[Floats, Floats], true: TrueValuesOfOne, weak: float
) -> tuple[Floats, Floats] | None:
    """Find the command that brings a tip to a pose; None where that takes more than a few plain steps.

    Position first: the orientation is corrected with what freedom the position leaves. Every other step takes what the
    joints do from its derivatives; where it ends, it is as it is.

    Args:
        tip: of the arm.
        T: T_base_tip to reach.
        q: (k,) command to start from, which is near.
        limits: (k,) least and largest command.
        true: what the joints do when they are told to be somewhere.
        weak: of fewer than six joints, directions that move the tip less than this a radian, as a share of the reach,
            are not for plain steps.

    Returns:
        The command (k,), and the error (6,) that it leaves (m, rad).
    """
    reach, (lower, upper) = tip.reach, limits
    short, wanted, turned = len(q) < _FREEDOM, T.translation, T.rotation
    length, drift, anew, exact = np.inf, 0.0, True, False
    for _ in range(_STEPS):
        exact = anew or not exact
        if exact:
            values, told = true.values(q), q
        if anew:
            slopes = true.slopes(q)
            here, J = tip.jacobian(values)
            found = _inverse(J @ slopes, reach, weak)
            if found is None:
                return None
            inverse, drift = found, 0.0
        else:
            here = tip.pose(values if exact else values + slopes @ (q - told))
        error = np.empty(6)
        error[:3] = wanted - here.translation
        error[3:] = pin.log3(turned @ here.rotation.T)
        if exact and not short and error @ error < (_ARRIVED * reach) ** 2:
            return q, error
        step = inverse @ error
        before, length = length, sqrt(step @ step)
        if exact and short and length < _ARRIVED and drift < _NEAR:
            return q, error
        q, drift = q + step, drift + length
        # What cannot be reached is least where the derivatives are right.
        anew = length > _SLOW * before or (short and drift > _NEAR)
        if not np.logical_and(lower <= q, q <= upper).all():
            return None
    return None


def _inverse(J: Floats, reach: float, weak: float) -> Floats | None:
    """What turns an error (6,) of the tip into a step (k,), position first; None where there is none.

    Enough joints serve position and orientation at once, with the least step, and need no order. Of fewer a direction
    must not be weak. J is used up.
    """
    J[:3] /= reach
    k = J.shape[1]
    if k >= _FREEDOM:
        A = _inverted(J @ J.T)
        if A is None:
            return None
        inverse: Floats = J.T @ A
    else:
        J_p, J_o = J[:3], J[3:]
        A = _strong(J_p @ J_p.T, 0, weak)
        if A is None:
            return None
        P = J_p.T @ A
        turned = J_o @ P
        J_left = J_o - turned @ J_p
        A = _strong(J_left @ J_left.T, _FREEDOM - k, weak)
        if A is None:
            return None
        inverse = np.empty((k, 6))
        Q = inverse[:, 3:] = J_left.T @ A
        inverse[:, :3] = P - Q @ turned
    inverse[:, :3] /= reach
    return inverse


def _strong(A: Floats, missing: int, weak: float) -> Floats | None:
    """The inverse of A (3, 3), damped where so many of its directions are missing; None where another is weak.

    The least eigenvalue is at least one over the sum of the inverse ones.
    """
    if missing:
        A.flat[::4] += weak**2
    inverse = _inverted(A)
    if inverse is None:
        return None
    others = inverse.trace() - missing / weak**2
    return inverse if others < (0.5 if missing else 1.0) / weak**2 else None


def _inverted(A: Floats) -> Floats | None:
    """The inverse of a symmetric matrix; None where it is not positive definite."""
    _, inverse, failed = dposv(A, _EYES[len(A)])
    return None if failed else inverse
