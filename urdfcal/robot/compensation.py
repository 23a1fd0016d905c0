"""Joint commands that bring the calibrated arm's tip to the poses of the nominal arm's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.kinematics import joint_axes, tip_motion, tip_poses
from urdfcal.robot.newton import reach_pose
from urdfcal.rotations import matrix_to_rotation_vector

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from urdfcal.arrays import Ints
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.newton import TipAtOnce, TrueValuesOfOne

    TrueValues = Callable[[Floats, Ints], tuple[Floats, Floats]]

# Away from singularities three steps arrive from centimetres off; beside one, or at a limit, steps shrink slowly and
# what is left is reported.
_STEPS = 20
# Arrived: a tenth of a nanometre at an arm's length of one metre.
_ARRIVED = 1e-10
# Damped least squares (Nakamura & Hanafusa, J. Dyn. Sys. 108, 1986) for directions that move the tip less than this a
# radian, as a share of the reach: steps there shrink instead of growing without bound.
_WEAK = 0.02
# What can be reached is reached: from this error down, damping goes with it (Sugihara, IEEE T-RO 27(5), 2011). [-, rad]
# Of 4,000 random commands each, more than 1e-9 m is left in 0.03 % (panda, 0.4 % without), 0.8 % (elbow3r, 4.6 %),
# 1.0 % (so101, 1.9 %), 2.9 % (ur5, 3.5 %); ten times as much or a third leave more.
_FAR, _TINY = 1e-3, 1e-15
# Damping of the projection onto the position's null space, on the same scale: only singular directions, not weak ones,
# are left to the orientation.
_SINGULAR = 1e-7
# No joint is taken further from its nominal command: a calibration's corrections are smaller, and beside a singularity
# a hair's breadth at the tip is not worth turning the wrist over. [rad or m]
_FURTHEST = 0.3
# What a radian counts beside a reach where the two compete.
_ORIENTATION = 1e-5
# Poses that are solved together.
_BLOCK = 1024


@dataclass(frozen=True, eq=False)
class Compensation:
    """Joint commands, and the pose error that they leave between the calibrated and the nominal tip.

    Attributes:
        q: (..., k) commands of the actuated joints. [rad or m]
        position: (...) distance left. [m]
        angle: (...) angle left. [rad]
    """

    q: Floats
    position: Floats
    angle: Floats

    def __post_init__(self) -> None:
        for name in ("q", "position", "angle"):
            object.__setattr__(self, name, frozen(getattr(self, name)))


def compensate_one(nominal: TipAtOnce, calibrated: TipAtOnce, q: Floats, true: TrueValuesOfOne) -> Compensation | None:
    """Find one joint command as :func:`compensate` does, in a tenth of the time; None where plain steps do not do.

    Args:
        nominal: the arm as the controller believes it is.
        calibrated: the same arm with calibrated placements.
        q: (k,) command of the actuated joints, made for the nominal arm. [rad or m]
        true: what the joints do when they are told to be somewhere.
    """
    lower, upper = nominal.limits
    if not ((q >= lower) & (q <= upper)).all():
        return None
    limits = np.maximum(lower, q - _FURTHEST), np.minimum(upper, q + _FURTHEST)
    found = reach_pose(calibrated, nominal.pose(nominal.told.values(q)), q, limits, true, _WEAK)
    if found is None:
        return None
    command, error = found
    position, turn = error[:3], error[3:]
    return Compensation(command, np.sqrt(position @ position), np.sqrt(turn @ turn))


def compensate(nominal: Mechanism, calibrated: Mechanism, q: ArrayLike, true: TrueValues | None = None) -> Compensation:
    """Find joint commands that bring the calibrated arm's tip to the nominal arm's poses.

    Damped Gauss-Newton on the calibrated arm from the nominal commands, position first: the orientation is corrected
    with what freedom the position leaves (Siciliano & Slotine, ICAR 1991), so that arms of fewer than six joints place
    their tip where they can. Joints stop at their limits.

    Args:
        nominal: the arm as the controller believes it is.
        calibrated: the same arm with calibrated placements.
        q: (..., k) commands of the actuated joints, made for the nominal arm. [rad or m]
        true: gives for commands (M, k) of some poses (M,) of the N all joints' true values (M, n), and their
            derivatives (M, n, k); left out: they are where they are told.

    Raises:
        RobotError: a command is not finite, or beyond the joint's limits.
    """
    given, (lower, upper) = np.array(q, dtype=float), nominal.limits
    if given.shape[-1:] != lower.shape:
        raise RobotError(f"commands of shape {given.shape} are not (..., {len(lower)})", where=nominal.name)
    if outside := nominal.outside_limits(given):
        raise RobotError(
            str(outside[0]),
            where=f"command {outside[0].pose}",
            remedy="Commands are in radians and metres, of the robot that was calibrated.",
        )
    commands = given.reshape(-1, len(lower))
    found, position, angle = np.empty_like(commands), np.empty(len(commands)), np.empty(len(commands))
    for first in range(0, len(commands), _BLOCK):
        poses = slice(first, first + _BLOCK)
        T = tip_poses(nominal, nominal.joint_values(commands[poses]))
        least, most = np.maximum(lower, commands[poses] - _FURTHEST), np.minimum(upper, commands[poses] + _FURTHEST)
        each = np.arange(len(commands))[poses]
        found[poses], error = _approach(calibrated, T, commands[poses], least, most, _true(calibrated, true, each))
        position[poses], angle[poses] = np.linalg.norm(error.reshape(-1, 2, 3), axis=2).T
    shape = given.shape[:-1]
    return Compensation(found.reshape(given.shape), position.reshape(shape), angle.reshape(shape))


def _true(chain: Mechanism, true: TrueValues | None, poses: Ints) -> TrueValues:
    """The joints' true values in poses of a block; as commanded where there are no joint models."""
    if true is not None:
        return lambda q, some: true(q, poses[some])
    return lambda q, _: (chain.joint_values(q), chain.reading_jacobian[None])


def _approach(
    chain: Mechanism, T: Floats, start: Floats, lower: Floats, upper: Floats, true: TrueValues
) -> tuple[Floats, Floats]:
    """Find commands (N, k) that bring the tip to poses T (N, 4, 4), and the errors left (N, 6).

    ``start``, ``lower`` and ``upper`` are (N, k).
    """
    model, axes = chain.build_model(), joint_axes(chain)
    q = np.clip(start, lower, upper)
    best, error_left = q.copy(), np.full((len(q), 6), np.inf)
    going = np.arange(len(q))
    for _ in range(_STEPS):
        values, slopes = true(q[going], going)
        motion = tip_motion(chain, model, values)
        turn = matrix_to_rotation_vector(T[going, :3, :3] @ np.swapaxes(motion.R, 1, 2))
        error = np.concatenate([T[going, :3, 3] - motion.p, turn], axis=1)
        nearer = _error_size(error, chain) < _error_size(error_left[going], chain)
        best[going[nearer]], error_left[going[nearer]] = q[going[nearer]], error[nearer]
        far = _error_size(error, chain) > _ARRIVED
        if not far.any():
            break
        J = (motion.regressor[far].reshape(-1, len(axes)) @ axes).reshape(-1, 6, axes.shape[1])
        J = J @ (slopes[far] if len(slopes) == len(far) else slopes)
        going, error = going[far], error[far]
        step = _step(J, error, np.ones(q[going].shape, dtype=bool), chain.reach)
        least, most = lower[going], upper[going]
        stuck = ((q[going] <= least) & (step < 0.0)) | ((q[going] >= most) & (step > 0.0))
        limited = stuck.any(axis=1)
        if limited.any():  # the others make up for joints that stand at their limit
            step[limited] = _step(J[limited], error[limited], ~stuck[limited], chain.reach)
        moved = np.clip(q[going] + step, least, most)
        moving = np.abs(moved - q[going]).max(axis=1) > _ARRIVED
        q[going] = moved
        going = going[moving]
        if not len(going):
            break
    return best, error_left


def _step(J: Floats, error: Floats, free: Bools, reach: float) -> Floats:
    """The step (N, k) towards the position, and towards the orientation in the position's null space."""
    J = J * free[:, None]
    J_p, J_o = J[:, :3] / reach, J[:, 3:]
    position, turn = error[:, :3] / reach, error[:, 3:]
    step = _weakly_damped_inverse(J_p, position) @ position[..., None]
    J_left = J_o - J_o @ _inverse(J_p, np.full(len(J), _SINGULAR**2)) @ J_p
    step += _weakly_damped_inverse(J_left, turn) @ (turn[..., None] - J_o @ step)
    result: Floats = step[..., 0] * free
    return result


def _weakly_damped_inverse(J: Floats, error: Floats) -> Floats:
    """A pseudo-inverse (N, k, 3), damped as its least singular value nears zero, unless little error (N, 3) is left."""
    least = np.linalg.eigvalsh(J @ np.swapaxes(J, 1, 2))[:, 0]
    far = np.minimum(np.linalg.norm(error, axis=1) / _FAR, 1.0)
    return _inverse(J, (far * _WEAK * np.clip(1.0 - least / _WEAK**2, 0.0, 1.0)) ** 2 + _TINY)


def _inverse(J: Floats, damping: Floats) -> Floats:
    """J^T (J J^T + damping)^-1, (N, k, 3)."""
    J_T = np.swapaxes(J, 1, 2)
    result: Floats = J_T @ np.linalg.inv(J @ J_T + damping[:, None, None] * np.eye(3))
    return result


def _error_size(error: Floats, chain: Mechanism) -> Floats:
    """The size of an error, position first: an unreachable orientation must not outweigh a reachable position."""
    position, angle = np.linalg.norm(error.reshape(-1, 2, 3), axis=2).T
    result: Floats = position / chain.reach + _ORIENTATION * angle
    return result
