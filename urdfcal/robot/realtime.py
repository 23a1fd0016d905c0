"""Kinematics of one arm for control loops: a pose, its Jacobian and the nearest joint values in microseconds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from urdfcal.errors import RobotError
from urdfcal.robot.mechanism import se3

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism

_ALIGNED, _LOCAL = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, pin.ReferenceFrame.LOCAL
# Arrived: a nanometre, a nanoradian.
_ARRIVED = 1e-9
# Of a redundant arm: joint values as near as they can be, to this. [rad or m]
_NEAREST = 1e-5
# Steps: 3 from 20 mrad away, 4 from 0.2 rad; what takes many times as many is not near.
_STEPS = 60
# Damping by the error's square (Sugihara, IEEE T-RO 27(5), 2011): none where the pose is reached, and bounded steps
# beside a singularity. It grows tenfold with each step that leads away.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-15, 1e3


class RealtimeKinematics:
    """Forward and inverse kinematics of a tip, one pose a call, without checks of what is given.

    It is as true as the placements of the mechanism: of a calibration, ``RealtimeKinematics(calibration.calibrated)``;
    of a corrected URDF, ``RealtimeKinematics(Chain.from_urdf(path, tip))``. Joint models (compliance, lag, backlash)
    are not in it: ``Calibration.joint_values`` has them. An instance belongs to one thread.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        """Prepare for the first tip of a mechanism.

        Args:
            mechanism: the joints with their placements; it is copied.

        Raises:
            RobotError: no joint moves the tip.
        """
        tip = mechanism.tips[0]
        if not tip.joint + 1:
            raise RobotError("no joint moves this link", where=f"link {tip.link!r}")
        model = mechanism.build_model()
        placed = pin.Frame(tip.link, tip.joint + 1, 0, se3(tip.T_joint_link), pin.FrameType.OP_FRAME)
        self._tip = model.addFrame(placed)
        self._model, self._data = model, model.createData()
        self.joints: tuple[str, ...] = tuple(mechanism.actuated)
        """Names of the joints, in the order of all values."""
        k = len(self.joints)
        self._offset = mechanism.joint_values(np.zeros(k))
        self._spread = np.array(mechanism.reading_jacobian)
        # Where no joint mimics another, joint values are what is given.
        self._plain = np.array_equal(self._spread, np.eye(k)) and not self._offset.any()
        self._lower, self._upper = (np.array(limit) for limit in mechanism.limits)
        self._redundant = k > 6

    def forward(self, q: ArrayLike) -> Floats:
        """Compute the tip's frame T_base_tip (4, 4) [m] at values q (k,) of the actuated joints. [rad or m]."""
        pin.forwardKinematics(self._model, self._data, self._values(q))
        placed = pin.updateFramePlacement(self._model, self._data, self._tip)
        result: Floats = np.array(placed.homogeneous)
        return result

    def jacobian(self, q: ArrayLike) -> Floats:
        """Compute the derivative (6, k) of the tip's motion at joint values q (k,). [rad or m].

        Linear rows first, of the tip's origin; both in the base link's axes.
        """
        J: Floats = pin.computeFrameJacobian(self._model, self._data, self._values(q), self._tip, _ALIGNED)
        return J if self._plain else J @ self._spread

    def inverse(self, T_base_tip: ArrayLike, near: ArrayLike) -> Floats | None:
        """Find the joint values within the limits that reach a pose, those nearest to given ones.

        Damped Newton steps from there, so that an arm stays in its branch (elbow up or down); of arms with more than
        six joints the sum of squared distances to ``near`` is least among those that idle motion leads to.

        Args:
            T_base_tip: (4, 4) where the tip shall be. [m]
            near: (k,) joint values to begin with. [rad or m]

        Returns:
            (k,) joint values; None where none are found: out of reach, or only through a singularity or a limit.
        """
        target = pin.SE3(np.asarray(T_base_tip, dtype=float))
        start = np.asarray(near, dtype=float)
        lower, upper = self._lower, self._upper
        q: Floats = np.minimum(np.maximum(start, lower), upper)
        before, damping = np.inf, _DAMPING
        kept, step = q, None
        for _ in range(_STEPS):
            J, error = self._local(q, target)
            size = float(error @ error)
            if size < _ARRIVED**2 and (step is None or not self._redundant or float(step @ step) < _NEAREST**2):
                return q
            if size > before and size > _ARRIVED**2:  # it led away: from where it was, and shorter
                if (damping := 10.0 * damping) > _MOST_DAMPING:
                    return None
                q = kept
                J, error = self._local(q, target)
                size = before
            else:
                kept, before = q, size
            # Steps that are damped more are drawn less to where the search began.
            back = _DAMPING / damping * (start - q) if self._redundant else None
            step = self._step(J, error, back, damping * size + _LEAST_DAMPING)
            moved = q + step
            if (moved < lower).any() or (moved > upper).any():
                moved = self._within(q, J, error, back, damping * size + _LEAST_DAMPING)
                step = moved - q
            q = moved
        return None

    def _values(self, q: ArrayLike) -> Floats:
        given: Floats = np.asarray(q, dtype=float)
        return given if self._plain else self._offset + self._spread @ given

    def _local(self, q: Floats, target: pin.SE3) -> tuple[Floats, Floats]:
        """The Jacobian (6, k) in the tip's own frame, and the motion (6,) from there to the target."""
        model, data, values = self._model, self._data, self._values(q)
        J = pin.computeFrameJacobian(model, data, values, self._tip, _LOCAL)
        pin.forwardKinematics(model, data, values)  # which the Jacobian leaves out
        placed = pin.updateFramePlacement(model, data, self._tip)
        return J if self._plain else J @ self._spread, pin.log6(placed.actInv(target)).vector

    @staticmethod
    def _step(J: Floats, error: Floats, back: Floats | None, damping: float) -> Floats:
        """The step (k,) to the target, and towards ``back`` as far as that leaves freedom."""
        A = J @ J.T
        A.flat[:: len(A) + 1] += damping
        if back is None:
            result: Floats = dposv(A, error)[1] @ J
            return result
        onward: Floats = back + dposv(A, error - J @ back)[1] @ J
        return onward

    def _within(self, q: Floats, J: Floats, error: Floats, back: Floats | None, damping: float) -> Floats:
        """Take a step that ends within the limits: joints that would pass theirs stop there, the others make up."""
        moved: Floats = q.copy()
        free = np.ones(len(q), dtype=bool)
        while free.any():
            rest = error - J[:, ~free] @ (moved - q)[~free]
            moved[free] = q[free] + self._step(J[:, free], rest, None if back is None else back[free], damping)
            past = free & ((moved < self._lower) | (moved > self._upper))
            if not past.any():
                break
            moved[past] = np.clip(moved[past], self._lower[past], self._upper[past])
            free &= ~past
        return moved
