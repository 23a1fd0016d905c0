"""Chains and trees of movable joints, read from a URDF or a Pinocchio model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.names import suggest
from urdfcal.robot.mechanism import BASE, Joint, Mechanism, Tip
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from typing_extensions import Self

    from urdfcal.robot.urdf.urdf import UrdfJoint


class Tree(Mechanism):
    """Joints between a base link and several tip links."""

    @classmethod
    def from_urdf(cls, urdf: Urdf | str | Path, tip_link: str | Sequence[str], base_link: str | None = None) -> Self:
        """Read the joints between a base link and tip links from a URDF, through Pinocchio.

        Args:
            urdf: a parsed URDF, or its path or ``package://`` reference.
            tip_link: link at the end of a chain; those of a tree, the most important one first.
            base_link: an ancestor of them all; the root link by default.

        Raises:
            RobotError: the file is no valid URDF, a link is unknown, the base is not above a tip, or a joint in between
                cannot be calibrated (floating, planar, zero axis, mimic of a joint that is not in between).
        """
        if not isinstance(urdf, Urdf):
            urdf = Urdf.read(urdf)
        where = str(urdf.path or urdf.name)
        tip_links, base_link = [tip_link] if isinstance(tip_link, str) else tip_link, base_link or urdf.root
        paths = [_joint_path(urdf, link, base_link, where) for link in tip_links]
        _check(list(dict.fromkeys(joint for path in paths for joint in path)), base_link, tip_links, urdf, where)
        try:
            # Mimic joints are loaded as ordinary ones: multiplier and offset are applied to the readings, and each
            # has a placement of its own to calibrate.
            model = pin.buildModelFromXML(urdf.text)
        except (ValueError, RuntimeError) as error:
            raise RobotError(f"Pinocchio cannot load it: {error}", where=where) from error
        tree = cls.from_model(model, tip_links, base_link)
        joints = tuple(replace(joint, mimic=urdf.joints[joint.name].mimic) for joint in tree.joints)
        return replace(tree, name=urdf.name, joints=joints)

    @classmethod
    def from_model(cls, model: pin.Model, tip_link: str | Sequence[str], base_link: str | None = None) -> Self:
        """Copy the joints between a base link and tip links out of a Pinocchio model; the model is left alone.

        Args:
            model: any model; other joints do not matter.
            tip_link: body frame at the end of a chain; those of a tree, the most important one first.
            base_link: body frame above them all; the universe's first body by default.

        Raises:
            RobotError: a link is unknown, the base is not above a tip, or a joint in between has not exactly one degree
                of freedom, no axis, or is a mimic joint.
        """
        base = _body(model, base_link if base_link is not None else [*_bodies(model), "universe"][0])
        T_base_universe, data = base.placement.inverse().homogeneous, model.createData()
        index = {base.parentJoint: BASE}
        joints: list[Joint] = []
        parents: list[int] = []
        placements: list[Floats] = []
        tips: list[Tip] = []
        for link in [tip_link] if isinstance(tip_link, str) else tip_link:
            tip = _body(model, link)
            support = list(model.supports[tip.parentJoint])
            if base.parentJoint not in support:
                raise RobotError(
                    f"base link {base.name!r} is not above tip link {link!r} in the tree", where=model.name
                )
            for joint_id in support[support.index(base.parentJoint) + 1 :]:
                if joint_id in index:
                    continue
                parent, T = index[model.parents[joint_id]], model.jointPlacements[joint_id].homogeneous
                index[joint_id] = len(joints)
                joints.append(_joint(model, data, joint_id))
                parents.append(parent)
                placements.append(T_base_universe @ T if parent == BASE else T)
            carrier, T = index[tip.parentJoint], tip.placement.homogeneous
            tips.append(Tip(link, carrier, T_base_universe @ T if carrier == BASE else T))
        return cls(model.name, base.name, tuple(joints), tuple(parents), np.array(placements), tuple(tips))


class Chain(Tree):
    """A serial chain of joints from a base link down to one tip link."""

    @property
    def T_last_tip(self) -> Floats:
        """The tip link's frame in the last joint's frame, (4, 4). [m]."""
        return self.tips[0].T_joint_link


def read_mechanism(urdf: Urdf, tip_links: Sequence[str], base_link: str | None = None) -> Mechanism:
    """Read a chain where one link is asked for, else a tree; see :meth:`Tree.from_urdf`."""
    links = list(dict.fromkeys(tip_links))
    return (Chain if len(links) == 1 else Tree).from_urdf(urdf, links, base_link)


def _joint_path(urdf: Urdf, tip_link: str, base_link: str, where: str) -> list[UrdfJoint]:
    """The joints of a URDF, fixed ones included, from a base link to a tip link."""
    for link in (base_link, tip_link):
        if link not in urdf.links:
            remedy = suggest(link, urdf.links, "links")
            if link == base_link:
                remedy += f" Without base_link the arm starts at the root link {urdf.root!r}."
            raise RobotError(f"there is no link {link!r}", where=where, remedy=remedy)
    above = {joint.child: joint for joint in urdf.joints.values()}
    path: list[UrdfJoint] = []
    links = [tip_link]
    while links[-1] in above:
        path.insert(0, above[links[-1]])
        links.append(path[0].parent)
    # What hangs on the path by fixed joints, as UR's `base`, is as good a base as the link that it hangs on.
    start = base_link
    while start not in links and start in above and above[start].type == "fixed":
        start = above[start].parent
    if start not in links:
        raise RobotError(
            f"base link {base_link!r} is not above tip link {tip_link!r} in the tree",
            where=where,
            remedy=f"The links above the tip are: {', '.join(joint.parent for joint in path)}.",
        )
    return path[len(path) - links.index(start) :]


def _check(joints: Sequence[UrdfJoint], base_link: str, tip_links: Sequence[str], urdf: Urdf, where: str) -> None:
    """Refuse joints that cannot be calibrated."""
    ends = f"{base_link!r} and {' or '.join(map(repr, tip_links))}"
    for joint in joints:
        what = remedy = ""
        master = urdf.joints.get(joint.mimic.joint) if joint.mimic else None
        if joint.type in ("floating", "planar"):
            what = f"a {joint.type} joint lies between {ends}"
            remedy = "Name a base link below it: only joints with one degree of freedom can be calibrated."
        elif joint.type != "fixed" and not np.any(joint.axis):
            what, remedy = "the joint's axis is zero", "Give <axis xyz=...> the joint's direction."
        elif joint.mimic and master not in joints:
            what = f"it mimics {joint.mimic.joint!r}, which is not between {ends}"
            remedy = "Choose a base and a tip link that have both joints between them."
        elif joint.mimic and master and master.mimic:
            what = f"it mimics {joint.mimic.joint!r}, itself a mimic joint"
            remedy = "Let it mimic the driving joint."
        if what:
            raise RobotError(what, where=f"{where}:{joint.line}, joint {joint.name!r}", remedy=remedy)


def _bodies(model: pin.Model) -> list[str]:
    return [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]


def _body(model: pin.Model, link: str) -> pin.Frame:
    index = model.getFrameId(link, pin.FrameType.BODY)
    if index < model.nframes:
        return model.frames[index]
    if link == "universe":
        return model.frames[0]
    raise RobotError(f"there is no link {link!r}", where=model.name, remedy=suggest(link, _bodies(model), "links"))


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
    return Joint(
        name=name,
        type="prismatic" if prismatic else "continuous" if continuous else "revolute",
        axis=frozen(axis),
        lower=-np.inf if continuous else float(model.lowerPositionLimit[jmodel.idx_q]),
        upper=np.inf if continuous else float(model.upperPositionLimit[jmodel.idx_q]),
    )
