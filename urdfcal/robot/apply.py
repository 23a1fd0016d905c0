"""Giving other models and descriptions of the same robot the placements that were calibrated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, inverse
from urdfcal.errors import RobotError
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.mechanism import BASE, se3
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.robot.mechanism import Joint, Mechanism, Tip
    from urdfcal.robot.urdf.urdf import Urdf

# Placements that differ by no more are the same drawing through different roundings. [m, entries of the rotation]
_SAME = 1e-6


def apply_to_model(model: pin.Model, chain: Mechanism, built: Floats) -> None:
    """Give a Pinocchio model the placements that a chain's joints were built with.

    The model may have more joints than the chain, in another order, on another base; some of the chain's may have
    been locked by ``pin.buildReducedModel``. Frames and joints behind a locked joint move with it. Inertias and
    collision geometry stay as drawn.

    Args:
        model: found joint by joint by name; it is changed, unless an error is raised.
        chain: as drawn.
        built: (n, 4, 4) each joint's placement in the frame of the one it hangs on. [m]

    Raises:
        RobotError: a joint is missing, or is not placed as it was drawn when it was calibrated.
    """
    joints: dict[int, Floats] = {}
    locked: dict[int, Floats] = {}  # by frame: what a correction does to everything behind it
    # What each joint hangs on: a joint of the model, and the way from there, as drawn and as built.
    carriers = [_base(model, chain)]
    for joint, parent, drawn_k, built_k in zip(chain.joints, chain.parents, chain.placements, built, strict=True):
        support, before, after = carriers[parent + 1]
        drawn_T, built_T = before @ drawn_k, after @ built_k
        if model.existJointName(joint.name):
            index = model.getJointId(joint.name)
            _check_same(model.jointPlacements[index].homogeneous, drawn_T, built_T, joint.name, model.name)
            if model.parents[index] != support:
                raise _other_robot(joint.name, model.name)
            joints[index] = built_T
            carriers.append((index, np.eye(4), np.eye(4)))
            continue
        frame = _locked_frame(model, joint.name)
        before = model.frames[frame].placement.homogeneous
        turned = inverse(drawn_T) @ before
        if model.frames[frame].parentJoint != support or not _is_motion_of(joint, turned):
            raise _other_robot(joint.name, model.name)
        after = built_T @ turned
        locked[frame] = after @ inverse(before)
        carriers.append((support, before, after))
    frames = dict(_moved_frames(model, locked)) if locked else {}
    for index in range(1, model.njoints):
        own = model.getFrameId(model.names[index], pin.FrameType.JOINT)
        if index not in joints and model.frames[own].parentFrame in frames:
            correction = frames[model.frames[own].parentFrame]
            joints[index] = correction @ model.jointPlacements[index].homogeneous
    for index, T in joints.items():
        model.jointPlacements[index] = se3(T)
    for index, correction in frames.items():
        model.frames[index].placement = se3(correction @ model.frames[index].placement.homogeneous)


def apply_to_urdf(urdf: Urdf, chain: Mechanism, built: Floats) -> bytes:
    """Write the placements that a chain's joints were built with into a description of the same robot.

    Args:
        urdf: the one the chain was read from, or another or regenerated one.
        chain: as drawn.
        built: (n, 4, 4) each joint's placement in the frame of the one it hangs on. [m]

    Returns:
        The corrected file; nothing but values of ``<origin>`` has changed.

    Raises:
        RobotError: it draws another robot: a link or joint is missing, or is not placed or typed as it was when it
            was calibrated.
    """
    where = str(urdf.path or urdf.name)
    other = read_mechanism(urdf, [tip.link for tip in chain.tips], chain.base_link)
    if (other.names, other.parents) != (chain.names, chain.parents):
        missing = [name for name in chain.names if name not in other.names] or [
            name for name in other.names if name not in chain.names
        ]
        raise _other_robot((missing or [chain.names[0]])[0], where)
    for mine, theirs, drawn_k, built_k, found in zip(
        chain.joints, other.joints, chain.placements, built, other.placements, strict=True
    ):
        _check_same(found, drawn_k, built_k, mine.name, where)
        if (
            mine.prismatic != theirs.prismatic
            or mine.mimic != theirs.mimic
            or not np.allclose(mine.axis, theirs.axis, rtol=0.0, atol=_SAME)
        ):
            raise RobotError(
                f"joint {mine.name!r} does not move as the one that was calibrated",
                where=where,
                remedy="Its type, axis or mimic differs: calibrate this robot.",
            )
    for tip, same in zip(chain.tips, other.tips, strict=True):
        if tip.joint != same.joint or not np.allclose(tip.T_joint_link, same.T_joint_link, rtol=0.0, atol=_SAME):
            raise RobotError(
                f"link {tip.link!r} is elsewhere on {_carrier(chain, tip)} than when it was calibrated",
                where=where,
                remedy="Apply the calibration to a description of the same robot.",
            )
    return rewrite_origins(urdf, origins_of(urdf, other, built))


def _carrier(chain: Mechanism, tip: Tip) -> str:
    return f"link {chain.base_link!r}" if tip.joint == BASE else f"joint {chain.names[tip.joint]!r}"


def _base(model: pin.Model, chain: Mechanism) -> tuple[int, Floats, Floats]:
    """The joint that the chain hangs on, and its base link's frame there; a model without that link is trusted."""
    if model.existFrame(chain.base_link, pin.FrameType.BODY):
        frame = model.frames[model.getFrameId(chain.base_link, pin.FrameType.BODY)]
        T = frame.placement.homogeneous
        return frame.parentJoint, T, T
    first = chain.names[0]
    if not model.existJointName(first):
        raise _missing(first, model.name)
    index = model.getJointId(first)
    T = model.jointPlacements[index].homogeneous @ inverse(chain.placements[0])
    return model.parents[index], T, T


def _locked_frame(model: pin.Model, name: str) -> int:
    """Where a reduced model keeps a locked joint."""
    if not model.existFrame(name, pin.FrameType.FIXED_JOINT):
        raise _missing(name, model.name)
    return int(model.getFrameId(name, pin.FrameType.FIXED_JOINT))


def _moved_frames(model: pin.Model, locked: dict[int, Floats]) -> Iterator[tuple[int, Floats]]:
    """Every frame behind a locked joint, with the correction of the last such joint before it."""
    supports = {model.frames[frame].parentJoint for frame in locked}
    for index, frame in enumerate(model.frames):
        above = index
        while above and model.frames[above].parentJoint == frame.parentJoint:
            if above in locked:
                yield index, locked[above]
                break
            below, above = above, model.frames[above].parentFrame
            # pin.buildReducedModel makes a locked joint's frame its own parent: what it hung on is not told.
            if above == below and frame.parentJoint in supports:
                raise RobotError(
                    f"joint {model.frames[above].name!r} is locked, and so are calibrated joints that it may hang on",
                    where=model.name,
                    remedy="Apply the calibration to the whole model first, and reduce that.",
                )
            if above == below:
                break


def _is_motion_of(joint: Joint, T: Floats) -> bool:
    """Whether a joint can carry its frame there."""
    turn, slide = T[:3, :3] @ joint.axis - joint.axis, T[:3, 3]
    if joint.prismatic:
        turn, slide = T[:3, :3] - np.eye(3), slide - joint.axis * (joint.axis @ slide)
    return bool(np.abs(turn).max() <= _SAME and np.abs(slide).max() <= _SAME)


def _check_same(found: Floats, drawn: Floats, built: Floats, joint: str, where: str) -> None:
    if np.allclose(found, drawn, rtol=0.0, atol=_SAME):
        return
    if np.allclose(found, built, rtol=0.0, atol=_SAME):
        raise RobotError(
            f"joint {joint!r} already has its calibrated placement",
            where=where,
            remedy="Give the robot as drawn: a calibration is applied once.",
        )
    raise RobotError(
        f"the placement of joint {joint!r} is not the one that was calibrated: "
        f"it is {1e3 * np.linalg.norm(found[:3, 3] - drawn[:3, 3]):.3g} mm off, or turned",
        where=where,
        remedy="Give the robot as it was drawn when it was calibrated, or calibrate this one.",
    )


def _missing(joint: str, where: str) -> RobotError:
    return RobotError(f"there is no joint {joint!r}", where=where, remedy="Give a model of the same robot.")


def _other_robot(joint: str, where: str) -> RobotError:
    return RobotError(
        f"joint {joint!r} does not hang where it did when it was calibrated",
        where=where,
        remedy="Give a model of the same robot.",
    )
