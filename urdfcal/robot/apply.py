"""Calibrated placements applied to other models and URDFs of the same robot (METHOD 4)."""

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

    from urdfcal.robot.mechanism import Joint, Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

# Placements that differ by no more are the same through different roundings. [m, entries of the rotation]
_SAME = 1e-6


def apply_to_model(model: pin.Model, chain: Mechanism, calibrated: Floats) -> None:
    """Set a Pinocchio model's joint placements to the calibrated ones.

    The model may have more joints than the chain, in another order, on another base; some of the chain's may have
    been locked by ``pin.buildReducedModel``. Frames and joints behind a locked joint move with it. Inertias and
    collision geometry stay nominal.

    Args:
        model: found joint by joint by name; it is changed, unless an error is raised.
        chain: the nominal joints.
        calibrated: (n, 4, 4) each joint's placement in the frame of the one it hangs on. [m]

    Raises:
        RobotError: a joint is missing, is not placed as it was when it was calibrated, or may hang on a locked joint.
    """
    joints: dict[int, Floats] = {}
    locked: dict[int, Floats] = {}  # by frame: the correction of everything behind it
    # What each joint hangs on: a joint of the model, and the transforms from there, nominal and calibrated.
    carriers = [_base(model, chain)]
    for joint, parent, nominal_k, calibrated_k in zip(
        chain.joints, chain.parents, chain.placements, calibrated, strict=True
    ):
        support, before, after = carriers[parent + 1]
        nominal_T, calibrated_T = before @ nominal_k, after @ calibrated_k
        if model.existJointName(joint.name):
            index = model.getJointId(joint.name)
            _check_same(model.jointPlacements[index].homogeneous, nominal_T, calibrated_T, joint.name, model.name)
            if model.parents[index] != support:
                raise _other_robot(joint.name, model.name)
            joints[index] = calibrated_T
            carriers.append((index, np.eye(4), np.eye(4)))
            continue
        # A reduced model keeps a locked joint as a frame.
        frame = model.getFrameId(joint.name, pin.FrameType.FIXED_JOINT)
        if frame == model.nframes:
            raise _missing(joint.name, model.name)
        before = model.frames[frame].placement.homogeneous
        turned = inverse(nominal_T) @ before
        if model.frames[frame].parentJoint != support or not _is_motion_of(joint, turned):
            raise _other_robot(joint.name, model.name)
        after = calibrated_T @ turned
        locked[frame] = after @ inverse(before)
        carriers.append((support, before, after))
    frames = dict(_moved_frames(model, locked))
    for index in (index for index in range(1, model.njoints) if index not in joints):
        own = model.getFrameId(model.names[index], pin.FrameType.JOINT)
        # A joint that was added by hand may have no frame, which alone says what the joint hangs on.
        if own == model.nframes:
            if model.parents[index] in {model.frames[frame].parentJoint for frame in locked}:
                raise _unknown_support(model.names[index], model.name)
        elif model.frames[own].parentFrame in frames:
            joints[index] = frames[model.frames[own].parentFrame] @ model.jointPlacements[index].homogeneous
    for index, T in joints.items():
        model.jointPlacements[index] = se3(T)
    for index, correction in frames.items():
        model.frames[index].placement = se3(correction @ model.frames[index].placement.homogeneous)


def apply_to_urdf(urdf: Urdf, chain: Mechanism, calibrated: Floats) -> bytes:
    """Write calibrated joint placements into a URDF of the same robot.

    Args:
        urdf: the one the chain was read from, or another or regenerated one.
        chain: the nominal joints.
        calibrated: (n, 4, 4) each joint's placement in the frame of the one it hangs on. [m]

    Returns:
        The corrected file; nothing but values of ``<origin>`` has changed.

    Raises:
        RobotError: it describes another robot: a link or joint is missing, or is not placed or typed as it was when it
            was calibrated.
    """
    where = str(urdf.path or urdf.name)
    links = [chain.base_link, *(tip.link for tip in chain.tips)]
    if missing := [link for link in links if link not in urdf.links]:
        raise RobotError(
            f"it describes {urdf.name!r}, which has no link {missing[0]!r}, and not the robot that was calibrated",
            where=where,
            remedy="Give a description of the same robot.",
        )
    other = read_mechanism(urdf, links[1:], chain.base_link)
    if (other.names, other.parents) != (chain.names, chain.parents):
        different = [name for name in chain.names if name not in other.names]
        different += [name for name in other.names if name not in chain.names]
        raise _other_robot([*different, chain.names[0]][0], where)
    for mine, theirs, nominal_k, calibrated_k, found in zip(
        chain.joints, other.joints, chain.placements, calibrated, other.placements, strict=True
    ):
        _check_same(found, nominal_k, calibrated_k, mine.name, where)
        _check_motion(mine, theirs, where)
    for tip, same in zip(chain.tips, other.tips, strict=True):
        if tip.joint != same.joint or not _close(tip.T_joint_link, same.T_joint_link):
            carrier = f"link {chain.base_link!r}" if tip.joint == BASE else f"joint {chain.names[tip.joint]!r}"
            raise RobotError(
                f"link {tip.link!r} is elsewhere on {carrier} than when it was calibrated",
                where=where,
                remedy="Apply the calibration to a description of the same robot.",
            )
    return rewrite_origins(urdf, origins_of(urdf, other, calibrated))


def apply_to_mechanism(other: Mechanism, chain: Mechanism, calibrated: Floats, where: str) -> Mechanism:
    """Give another reading of a robot's joints the calibrated placements; those that have them already keep them.

    Args:
        other: joints of the same robot, to the same links or others, nominal or already corrected.
        chain: the nominal joints that were calibrated.
        calibrated: (n, 4, 4) each joint's placement in the frame of the one it hangs on. [m]
        where: ``other`` is from, for messages.

    Raises:
        RobotError: a joint was not calibrated, or does not hang where it did, or moves otherwise.
    """
    placements = np.array(other.placements)
    for i, (joint, parent) in enumerate(zip(other.joints, other.parents, strict=True)):
        if joint.name not in chain.names:
            raise RobotError(
                f"joint {joint.name!r} was not calibrated",
                where=where,
                remedy=f"Calibrated are {', '.join(chain.names)}: name the result of this robot.",
            )
        k = chain.names.index(joint.name)
        above = BASE if chain.parents[k] == BASE else chain.names[chain.parents[k]]
        if above != (BASE if parent == BASE else other.names[parent]):
            raise _other_robot(joint.name, where)
        _check_motion(chain.joints[k], joint, where)
        if not _close(placements[i], calibrated[k]):
            _check_same(placements[i], chain.placements[k], calibrated[k], joint.name, where)
        placements[i] = calibrated[k]
    return other.with_placements(placements)


def _base(model: pin.Model, chain: Mechanism) -> tuple[int, Floats, Floats]:
    """The joint that the chain hangs on, and its base link's frame there; a model without that link is trusted."""
    base = model.getFrameId(chain.base_link, pin.FrameType.BODY)
    if base < model.nframes:
        frame = model.frames[base]
        T = frame.placement.homogeneous
        return frame.parentJoint, T, T
    first = chain.names[0]
    if not model.existJointName(first):
        raise _missing(first, model.name)
    index = model.getJointId(first)
    T = model.jointPlacements[index].homogeneous @ inverse(chain.placements[0])
    return model.parents[index], T, T


def _moved_frames(model: pin.Model, locked: dict[int, Floats]) -> Iterator[tuple[int, Floats]]:
    """Every frame behind a locked joint, with the correction of the last such joint before it."""
    supports = {model.frames[frame].parentJoint for frame in locked}
    for index, frame in enumerate(model.frames):
        above = index
        while frame.parentJoint in supports and above not in locked:
            if not above or model.frames[above].type == pin.FrameType.JOINT:
                break
            below, above = above, model.frames[above].parentFrame
            # pin.buildReducedModel makes a locked joint's frame its own parent, and a frame that was added by hand may
            # have none: what they hung on is unknown.
            if above == below or model.frames[above].parentJoint != frame.parentJoint:
                raise _unknown_support(model.frames[below].name, model.name)
        if above in locked:
            yield index, locked[above]


def _is_motion_of(joint: Joint, T: Floats) -> bool:
    """Whether a joint can carry its frame there."""
    turn, slide = T[:3, :3] @ joint.axis - joint.axis, T[:3, 3]
    if joint.prismatic:
        turn, slide = T[:3, :3] - np.eye(3), slide - joint.axis * (joint.axis @ slide)
    return bool(np.abs(turn).max() <= _SAME and np.abs(slide).max() <= _SAME)


def _close(found: Floats, expected: Floats) -> bool:
    return np.allclose(found, expected, rtol=0.0, atol=_SAME)


def _check_motion(calibrated: Joint, found: Joint, where: str) -> None:
    same = (calibrated.prismatic, calibrated.mimic) == (found.prismatic, found.mimic)
    if not same or not _close(calibrated.axis, found.axis):
        raise RobotError(
            f"joint {calibrated.name!r} does not move as the one that was calibrated",
            where=where,
            remedy="Its type, axis or mimic differs: calibrate this robot.",
        )


def _check_same(found: Floats, nominal: Floats, calibrated: Floats, joint: str, where: str) -> None:
    if _close(found, nominal):
        return
    if _close(found, calibrated):
        raise RobotError(
            f"joint {joint!r} already has its calibrated placement",
            where=where,
            remedy="Give the nominal robot: a calibration is applied once.",
        )
    raise RobotError(
        f"the placement of joint {joint!r} is not the one that was calibrated: "
        f"it is {1e3 * np.linalg.norm(found[:3, 3] - nominal[:3, 3]):.3g} mm off, or turned",
        where=where,
        remedy="Give the robot as it was when it was calibrated, or calibrate this one.",
    )


def _missing(joint: str, where: str) -> RobotError:
    return RobotError(f"there is no joint {joint!r}", where=where, remedy="Give a model of the same robot.")


def _other_robot(joint: str, where: str) -> RobotError:
    return RobotError(
        f"joint {joint!r} does not hang where it did when it was calibrated",
        where=where,
        remedy="Give a model of the same robot.",
    )


def _unknown_support(name: str, where: str) -> RobotError:
    return RobotError(
        f"the model does not say what {name!r} hangs on: it may be a locked joint that was calibrated",
        where=where,
        remedy="Apply the calibration to the whole model first, and reduce that.",
    )
