"""Reading joints between a base link and others from a URDF or a Pinocchio model."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.mechanism import BASE, Joint, Tip
from urdfcal.robot.urdf.urdf import Urdf, UrdfJoint, alternatives

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


class Drawing(NamedTuple):
    """What a mechanism is made of; see :class:`~urdfcal.robot.mechanism.Mechanism`."""

    name: str
    base_link: str
    joints: tuple[Joint, ...]
    parents: tuple[int, ...]
    placements: Floats
    tips: tuple[Tip, ...]


def draw_urdf(urdf: Urdf | str | Path, tip_links: Sequence[str], base_link: str | None = None) -> Drawing:
    """Read the joints between a base link and some others from a URDF, through Pinocchio.

    Args:
        urdf: a parsed URDF, or its path or ``package://`` reference.
        tip_links: the links; the joints to the first come first, then those to the second that are new, and so on.
        base_link: an ancestor of them all; the root link by default.

    Raises:
        RobotError: the file is no valid URDF, a link is unknown, the base is not above a tip, or a joint in between
            cannot be calibrated (floating, planar, zero axis, mimic of a joint that is not in between).
    """
    if not isinstance(urdf, Urdf):
        urdf = Urdf.read(urdf)
    where = str(urdf.path or urdf.name)
    base_link = base_link or urdf.root
    paths = [_joint_path(urdf, link, base_link, where) for link in tip_links]
    _check(urdf, list(dict.fromkeys(joint.name for path in paths for joint in path)), base_link, tip_links, where)
    try:
        # Mimic joints are loaded as ordinary ones: multiplier and offset are applied to the readings, and each
        # has a placement of its own to calibrate.
        model = pin.buildModelFromXML(urdf.data.decode("latin-1" if not _is_utf8(urdf.data) else "utf-8-sig"))
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot load it: {error}", where=where) from error
    drawing = draw_model(model, tip_links, base_link)
    drawn = [urdf.joints[joint.name] for joint in drawing.joints]
    joints = (
        Joint(joint.name, as_drawn.type, joint.axis, as_drawn.lower, as_drawn.upper, as_drawn.mimic)  # type: ignore[arg-type]  # the path holds movable ones
        for joint, as_drawn in zip(drawing.joints, drawn, strict=True)
    )
    return drawing._replace(name=urdf.name, joints=tuple(joints))


def draw_model(model: pin.Model, tip_links: Sequence[str], base_link: str | None = None) -> Drawing:
    """Copy the joints between a base link and some others out of a Pinocchio model; the model is left alone.

    Args:
        model: any model; other joints do not matter.
        tip_links: body frames, as for :func:`draw_urdf`.
        base_link: body frame above them all; the universe's first body by default.

    Raises:
        RobotError: a link is unknown, the base is not above a tip, or a joint in between has not exactly one degree
            of freedom, no axis, or is a mimic joint.
    """
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    base_link = base_link if base_link is not None else (bodies[0] if bodies else "universe")
    base, data = _body(model, base_link), model.createData()
    index = {base.parentJoint: BASE}
    joints: list[Joint] = []
    parents: list[int] = []
    placements: list[Floats] = []
    tips: list[Tip] = []
    T_base_universe = base.placement.inverse().homogeneous
    for link in tip_links:
        tip = _body(model, link)
        path: list[int] = []
        joint_id = tip.parentJoint
        while joint_id not in index and joint_id:
            path.insert(0, joint_id)
            joint_id = model.parents[joint_id]
        if joint_id not in index:
            raise RobotError(f"base link {base_link!r} is not above tip link {link!r} in the tree", where=model.name)
        for joint_id in path:
            parent, T = index[model.parents[joint_id]], model.jointPlacements[joint_id].homogeneous
            index[joint_id] = len(joints)
            joints.append(_joint(model, data, joint_id))
            parents.append(parent)
            placements.append(T_base_universe @ T if parent == BASE else T)
        carrier, T = index[tip.parentJoint], tip.placement.homogeneous
        tips.append(Tip(link, carrier, T_base_universe @ T if carrier == BASE else T))
    return Drawing(
        model.name, base_link, tuple(joints), tuple(parents), np.array(placements).reshape(-1, 4, 4), tuple(tips)
    )


def _check(urdf: Urdf, names: Sequence[str], base_link: str, tip_links: Sequence[str], where: str) -> None:
    """Refuse joints that cannot be calibrated."""
    ends = f"{base_link!r} and {' or '.join(map(repr, tip_links))}"
    for joint in (urdf.joints[name] for name in names):
        place = f"{where}:{joint.line}, joint {joint.name!r}"
        if joint.type in ("floating", "planar"):
            raise RobotError(
                f"a {joint.type} joint lies between {ends}",
                where=place,
                remedy="Name a base link below it: only joints with one degree of freedom can be calibrated.",
            )
        if joint.type != "fixed" and not np.any(joint.axis):
            raise RobotError(
                "the joint's axis is zero", where=place, remedy="Give <axis xyz=...> the joint's direction."
            )
        if joint.mimic and joint.mimic.joint not in names:
            raise RobotError(
                f"it mimics {joint.mimic.joint!r}, which is not between {ends}",
                where=place,
                remedy="Choose a base and a tip link that have both joints between them.",
            )
        if joint.mimic and urdf.joints[joint.mimic.joint].mimic:
            raise RobotError(
                f"it mimics {joint.mimic.joint!r}, itself a mimic joint",
                where=place,
                remedy="Let it mimic the driving joint.",
            )


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _joint_path(urdf: Urdf, tip_link: str, base_link: str, where: str) -> list[UrdfJoint]:
    for link in (base_link, tip_link):
        if link not in urdf.links:
            raise RobotError(f"there is no link {link!r}", where=where, remedy=alternatives(link, urdf.links))
    above = {joint.child: joint for joint in urdf.joints.values()}
    path: list[UrdfJoint] = []
    # What hangs on the path by fixed joints, as UR's `base`, is as good a base as the link that it hangs on.
    on_path = _above(urdf, tip_link)
    while base_link not in on_path and base_link in above and above[base_link].type == "fixed":
        base_link = above[base_link].parent
    link = tip_link
    while link != base_link:
        if link not in above:
            raise RobotError(
                f"base link {base_link!r} is not above tip link {tip_link!r} in the tree",
                where=where,
                remedy=f"The links above the tip are: {', '.join(joint.parent for joint in path)}.",
            )
        path.insert(0, above[link])
        link = above[link].parent
    return path


def _above(urdf: Urdf, link: str) -> set[str]:
    """A link and all links above it."""
    parents = {joint.child: joint.parent for joint in urdf.joints.values()}
    chain = {link}
    while link in parents:
        link = parents[link]
        chain.add(link)
    return chain


def _body(model: pin.Model, link: str) -> pin.Frame:
    for frame in model.frames:
        if frame.name == link and frame.type == pin.FrameType.BODY:
            return frame
    if link == "universe":
        return model.frames[0]
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    raise RobotError(f"there is no link {link!r}", where=model.name, remedy=alternatives(link, bodies))


def _joint(model: pin.Model, data: pin.Data, joint_id: int) -> Joint:
    jmodel, name = model.joints[joint_id], model.names[joint_id]
    where = f"{model.name}, joint {name!r}"
    kind = jmodel.shortname()
    if "Mimic" in kind:
        raise RobotError(
            "a mimic joint", where=where, remedy="Build the model with mimic=False, or use Chain.from_urdf."
        )
    if jmodel.nv != 1 or "Helical" in kind:
        raise RobotError(
            f"{kind} is not a revolute, continuous or prismatic joint",
            where=where,
            remedy="Name a base link below it: only joints with one degree of freedom can be calibrated.",
        )
    subspace = np.asarray(data.joints[joint_id].S).ravel()
    prismatic = bool(np.any(subspace[:3]))
    axis = subspace[:3] if prismatic else subspace[3:]
    if not np.any(axis) or not np.all(np.isfinite(axis)):
        raise RobotError("the joint's axis is zero", where=where, remedy="Give <axis xyz=...> the joint's direction.")
    continuous = jmodel.nq == 2
    limits = slice(jmodel.idx_q, jmodel.idx_q + 1)
    return Joint(
        name=name,
        type="prismatic" if prismatic else "continuous" if continuous else "revolute",
        axis=frozen(axis),
        lower=-np.inf if continuous else float(model.lowerPositionLimit[limits][0]),
        upper=np.inf if continuous else float(model.upperPositionLimit[limits][0]),
    )
