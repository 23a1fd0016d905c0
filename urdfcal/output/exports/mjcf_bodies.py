"""The bodies that a robot's joints move, as MuJoCo has compiled them, and how its links' frames lie in them.

A MuJoCo file may put its bodies' frames elsewhere than a URDF its links', fuse what fixed joints hold, and count a
joint from another zero (``ref``). For what moves that does not matter: two robots are the same if with all joints at
zero their axes are the same lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import RobotError
from urdfcal.names import suggest
from urdfcal.robot.kinematics import joint_motion
from urdfcal.robot.mechanism import BASE

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from urdfcal.robot.mechanism import Joint, Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

# Two drawings through different roundings: MuJoCo writes six digits, which sum to some 1e-5 over seven joints.
# [m, entries of a direction]
_SAME = 5e-5


@dataclass(frozen=True, eq=False)
class Body:
    """A body on one joint.

    Attributes:
        index: in MuJoCo's model.
        address: of the joint's value in ``qpos``.
        joint: the robot's, its axis in the body's frame.
        anchor: (3,) a point of the axis in the body's frame. [m]
        ref: the joint's value in the place that the file gives the body. [rad or m]
        place: (4, 4) that place, in the parent body's frame. [m]
        above: the parent body and so on, up to one that a joint moves or the world.
        T_above: (4, 4) the parent body in each of them. [m]
    """

    index: int
    address: int
    joint: Joint
    anchor: Floats
    ref: float
    place: Floats
    above: tuple[int, ...]
    T_above: tuple[Floats, ...]

    def motion(self, value: float) -> Floats:
        """The body's frame (4, 4) at a joint value, in its frame at 0."""
        to_axis = np.eye(4)
        to_axis[:3, 3] = self.anchor
        return to_axis @ joint_motion(self.joint, value) @ inverse(to_axis)

    @property
    def zero(self) -> Floats:
        """(4, 4) the body at joint value 0, in the parent body's frame. [m]."""
        return self.place @ self.motion(-self.ref)


@dataclass(frozen=True, eq=False)
class Match:
    """A robot's joints found in a MuJoCo model.

    Attributes:
        bodies: of each joint.
        T_base_body: (n, 4, 4) where they are with all joints at 0, in the base link's frame. [m]
        T_body_link: (n, 4, 4) frame of each joint's link in its body's. [m]
    """

    bodies: tuple[Body, ...]
    T_base_body: Floats
    T_body_link: Floats


def match(model: Any, chain: Mechanism, placements: Floats, urdf: Urdf, where: str) -> Match:
    """Find a robot's joints in a MuJoCo model, by name.

    The base link's frame is that of a body above the first joint, or of the world; or such a body's is that of another
    link that is fixed to the base link.

    Args:
        model: MuJoCo's, compiled.
        chain: as drawn.
        placements: (n, 4, 4) of its joints, as built: to tell a model that is calibrated already.
        urdf: of the robot, for the links that are fixed to its base.
        where: the MuJoCo file.

    Raises:
        RobotError: a joint is missing or of another type, bodies hang in another order, or axes are elsewhere.
    """
    bodies = tuple(_bodies(model, chain, where))
    links, already = (_link_frames(chain.parents, of) for of in (chain.placements, placements))
    misfits = []
    for T_base_first in _bases(model, bodies[0], chain, urdf):
        T_base_body = _body_frames(chain.parents, bodies, T_base_first)
        T_body_link = inverse(T_base_body) @ links
        misfit = _misfit(bodies, chain, T_body_link)
        if misfit is None:
            return Match(bodies, frozen(T_base_body), frozen(T_body_link))
        if _misfit(bodies, chain, inverse(T_base_body) @ already) is None:
            raise RobotError(
                "its joints are placed as calibrated already",
                where=where,
                remedy="Give the model as drawn: a calibration is applied once.",
            )
        misfits.append(misfit)
    # Of several base frames, the one that explains most joints is the one that was meant.
    index, distance, angle = max(misfits)
    raise RobotError(
        f"the axis of joint {chain.names[index]!r} is not where it was drawn when it was calibrated: "
        f"it is {1e3 * distance:.3g} mm and {1e3 * angle:.3g} mrad off",
        where=where,
        remedy="Give a model of the same robot as drawn, its base body's frame that of the base link.",
    )


def _bodies(model: Any, chain: Mechanism, where: str) -> Iterator[Body]:
    import mujoco

    kinds = {mujoco.mjtJoint.mjJNT_HINGE: False, mujoco.mjtJoint.mjJNT_SLIDE: True}
    names = [model.joint(i).name for i in range(model.njnt)]
    roots: set[int] = set()
    found: list[int] = []
    for joint, parent in zip(chain.joints, chain.parents, strict=True):
        if joint.name not in names:
            raise RobotError(
                f"there is no joint {joint.name!r}", where=where, remedy=suggest(joint.name, names, "joints")
            )
        index = names.index(joint.name)
        if kinds.get(mujoco.mjtJoint(int(model.jnt_type[index]))) is not joint.prismatic:
            raise RobotError(f"joint {joint.name!r} is not a {joint.type} joint", where=where)
        body = int(model.jnt_bodyid[index])
        if model.body_jntnum[body] != 1:
            raise RobotError(
                f"the body of joint {joint.name!r} has {model.body_jntnum[body]} joints",
                where=where,
                remedy="Give each joint a body of its own.",
            )
        address = int(model.jnt_qposadr[index])
        above, T_above = _above(model, body)
        roots |= {above[-1]} if parent == BASE else set()
        if above[-1] != found[parent] if parent != BASE else len(roots) > 1:
            raise RobotError(
                f"joint {joint.name!r} does not hang where it did when it was calibrated",
                where=where,
                remedy="Give a model of the same robot.",
            )
        yield Body(
            index=body,
            address=address,
            joint=replace(joint, axis=frozen(model.jnt_axis[index])),
            anchor=frozen(model.jnt_pos[index]),
            ref=float(model.qpos0[address]),
            place=frozen(_place(model, body)),
            above=above,
            T_above=T_above,
        )
        found.append(body)


def _place(model: Any, body: int) -> Floats:
    w, x, y, z = model.body_quat[body]
    T = np.eye(4)
    T[:3, :3] = pin.Quaternion(w, x, y, z).matrix()
    T[:3, 3] = model.body_pos[body]
    return T


def _above(model: Any, body: int) -> tuple[tuple[int, ...], tuple[Floats, ...]]:
    """Parent body, its parent and so on to one that moves, or the world; and the parent body's frame in each."""
    above, T = [int(model.body_parentid[body])], [np.eye(4)]
    while above[-1] != 0 and model.body_jntnum[above[-1]] == 0:
        T.append(_place(model, above[-1]) @ T[-1])
        above.append(int(model.body_parentid[above[-1]]))
    return tuple(above), tuple(frozen(T_k) for T_k in T)


def _bases(model: Any, first: Body, chain: Mechanism, urdf: Urdf) -> Iterator[Floats]:
    """Where the first joint's body may be in the base link's frame at joint value 0; bodies named as links first."""
    fixed = _fixed_to(urdf, chain.base_link)
    pairs = [(body, T, link) for body, T in zip(first.above, first.T_above, strict=True) for link in fixed]
    for _, T_body_parent, link in sorted(pairs, key=lambda pair: model.body(pair[0]).name != pair[2]):
        yield fixed[link] @ T_body_parent @ first.zero


def _fixed_to(urdf: Urdf, base_link: str) -> dict[str, Floats]:
    """T_base_link of every link that no joint moves against the base link, itself first."""
    found = {base_link: np.eye(4)}
    going = [base_link]
    fixed = [joint for joint in urdf.joints.values() if joint.type == "fixed"]
    while going:
        link = going.pop()
        for joint in fixed:
            T = joint.T_parent_joint
            for near, far, T_near_far in ((joint.parent, joint.child, T), (joint.child, joint.parent, inverse(T))):
                if near == link and far not in found:
                    found[far] = found[link] @ T_near_far
                    going.append(far)
    return found


def _link_frames(parents: Sequence[int], placements: Floats) -> Floats:
    """T_base_link of every joint's link with all joints at 0."""
    frames: list[Floats] = []
    for parent, T in zip(parents, placements, strict=True):
        frames.append(T if parent == BASE else frames[parent] @ T)
    return np.array(frames)


def _body_frames(parents: Sequence[int], bodies: tuple[Body, ...], T_base_first: Floats) -> Floats:
    """T_base_body of every joint's body with all joints at 0."""
    T_base_top = T_base_first @ inverse(bodies[0].T_above[-1] @ bodies[0].zero)
    frames: list[Floats] = []
    for parent, body in zip(parents, bodies, strict=True):
        T_base_above = T_base_top if parent == BASE else frames[parent]
        frames.append(T_base_above @ body.T_above[-1] @ body.zero)
    return np.array(frames)


def _misfit(bodies: tuple[Body, ...], chain: Mechanism, T_body_link: Floats) -> tuple[int, float, float] | None:
    """The first joint whose axis is another line than the link's: its index, distance [m] and angle [rad]."""
    for i, (body, joint, T) in enumerate(zip(bodies, chain.joints, T_body_link, strict=True)):
        axis = T[:3, :3] @ joint.axis
        between = T[:3, 3] - body.anchor
        distance = 0.0 if joint.prismatic else float(np.linalg.norm(between - axis * (axis @ between)))
        sine, cosine = np.linalg.norm(np.cross(axis, body.joint.axis)), axis @ body.joint.axis
        angle = float(np.arctan2(sine, cosine))
        if max(distance, angle) > _SAME:
            return i, distance, angle
    return None
