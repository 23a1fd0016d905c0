"""The serial chain of movable joints between two links, as drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.urdf import Mimic, Urdf, UrdfJoint, alternatives

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike

JointType = Literal["revolute", "continuous", "prismatic"]


@dataclass(frozen=True, eq=False)
class Joint:
    """One movable joint of a chain.

    Attributes:
        name: as in the URDF.
        type: revolute, continuous or prismatic.
        axis: (3,) unit vector in the joint's own frame.
        lower: limit, rad or m; -inf where there is none.
        upper: limit, rad or m; inf where there is none.
        mimic: the joint of the same chain it moves with, if any.
    """

    name: str
    type: JointType
    axis: Floats
    lower: float
    upper: float
    mimic: Mimic | None = None

    @property
    def prismatic(self) -> bool:
        """Whether the joint slides along its axis instead of turning about it."""
        return self.type == "prismatic"


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain of one-degree-of-freedom joints from a base link down to a tip link.

    Fixed joints in between are folded into the placements. Every joint has one scalar coordinate,
    continuous joints too.

    Attributes:
        name: the robot's.
        base_link: link whose frame the chain starts from; anywhere in the tree.
        tip_link: link whose frame it ends in.
        joints: from base to tip.
        placements: (n, 4, 4) T_previous_joint at zero joint value; the first in the base link's frame. [m]
        T_last_tip: (4, 4) the tip link's frame in the last joint's frame. [m]
    """

    name: str
    base_link: str
    tip_link: str
    joints: tuple[Joint, ...]
    placements: Floats
    T_last_tip: Floats

    def __post_init__(self) -> None:
        if not self.joints:
            raise RobotError(
                f"no movable joint between {self.base_link!r} and {self.tip_link!r}",
                where=self.name,
                remedy="Name a base and a tip link with revolute, continuous or prismatic joints in between.",
            )
        object.__setattr__(self, "placements", frozen(self.placements))
        object.__setattr__(self, "T_last_tip", frozen(self.T_last_tip))

    @classmethod
    def from_urdf(cls, urdf: Urdf | str | Path, tip_link: str, base_link: str | None = None) -> Chain:
        """Read the chain from a URDF, through Pinocchio.

        Args:
            urdf: a parsed URDF, or its path or ``package://`` reference.
            tip_link: link at the end of the chain.
            base_link: link at its start, an ancestor of the tip; the root link by default.

        Raises:
            RobotError: the file is no valid URDF, a link is unknown, the base is not above the tip, or a
                joint in between cannot be calibrated (floating, planar, zero axis, mimic of a joint off the chain).
        """
        if not isinstance(urdf, Urdf):
            urdf = Urdf.read(urdf)
        where = str(urdf.path or urdf.name)
        path = _joint_path(urdf, tip_link, base_link or urdf.root, where)
        names = {joint.name for joint in path}
        for joint in path:
            place = f"{where}:{joint.line}, joint {joint.name!r}"
            if joint.type in ("floating", "planar"):
                raise RobotError(
                    f"a {joint.type} joint lies between {base_link or urdf.root!r} and {tip_link!r}",
                    where=place,
                    remedy="Name a base link below it: only joints with one degree of freedom can be calibrated.",
                )
            if joint.type != "fixed" and not np.any(joint.axis):
                raise RobotError(
                    "the joint's axis is zero",
                    where=place,
                    remedy="Give <axis xyz=...> the joint's direction.",
                )
            if joint.mimic and joint.mimic.joint not in names:
                raise RobotError(
                    f"it mimics {joint.mimic.joint!r}, which is not between {base_link or urdf.root!r} and "
                    f"{tip_link!r}",
                    where=place,
                    remedy="Choose a base and a tip link that have both joints between them.",
                )
            if joint.mimic and urdf.joints[joint.mimic.joint].mimic:
                raise RobotError(
                    f"it mimics {joint.mimic.joint!r}, itself a mimic joint",
                    where=place,
                    remedy="Let it mimic the driving joint.",
                )
        try:
            # Mimic joints are loaded as ordinary ones: the chain applies multiplier and offset to the
            # readings, and each has a placement of its own to calibrate.
            model = pin.buildModelFromXML(urdf.data.decode("latin-1" if not _is_utf8(urdf.data) else "utf-8-sig"))
        except (ValueError, RuntimeError) as error:
            raise RobotError(f"Pinocchio cannot load it: {error}", where=where) from error
        chain = cls.from_model(model, tip_link, base_link or urdf.root)
        return cls(
            name=urdf.name,
            base_link=chain.base_link,
            tip_link=chain.tip_link,
            joints=tuple(
                Joint(
                    name=joint.name,
                    type=urdf.joints[joint.name].type,  # type: ignore[arg-type]  # the path holds movable ones
                    axis=joint.axis,
                    lower=urdf.joints[joint.name].lower,
                    upper=urdf.joints[joint.name].upper,
                    mimic=urdf.joints[joint.name].mimic,
                )
                for joint in chain.joints
            ),
            placements=chain.placements,
            T_last_tip=chain.T_last_tip,
        )

    @classmethod
    def from_model(cls, model: pin.Model, tip_link: str, base_link: str | None = None) -> Chain:
        """Copy the chain between two links out of a Pinocchio model; the model is left alone.

        Args:
            model: any model; joints off the chain do not matter.
            tip_link: body frame at the end of the chain.
            base_link: body frame at its start, an ancestor of the tip; the universe's first body by default.

        Raises:
            RobotError: a link is unknown, the base is not above the tip, or a joint in between has not
                exactly one degree of freedom, no axis, or is a mimic joint.
        """
        tip = _body(model, tip_link)
        bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
        base_link = base_link if base_link is not None else (bodies[0] if bodies else "universe")
        base = _body(model, base_link)
        ids: list[int] = []
        joint_id = tip.parentJoint
        while joint_id not in (base.parentJoint, 0):
            ids.insert(0, joint_id)
            joint_id = model.parents[joint_id]
        if joint_id != base.parentJoint:
            raise RobotError(
                f"base link {base_link!r} is not above tip link {tip_link!r} in the tree", where=model.name
            )
        data = model.createData()
        joints = tuple(_joint(model, data, joint_id) for joint_id in ids)
        placements = [model.jointPlacements[joint_id].homogeneous for joint_id in ids]
        if ids:
            placements[0] = base.placement.inverse().homogeneous @ placements[0]
        return cls(
            name=model.name,
            base_link=base_link,
            tip_link=tip_link,
            joints=joints,
            placements=np.array(placements),
            T_last_tip=tip.placement.homogeneous,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names, from base to tip."""
        return tuple(joint.name for joint in self.joints)

    @property
    def actuated(self) -> tuple[str, ...]:
        """The names of the joints that have a reading of their own: all but the mimic joints."""
        return tuple(joint.name for joint in self.joints if joint.mimic is None)

    @cached_property
    def reach(self) -> float:
        """An upper bound of the tip's distance from the base link's origin. [m]."""
        lengths = np.linalg.norm(self.placements[:, :3, 3], axis=1).sum() + np.linalg.norm(self.T_last_tip[:3, 3])
        strokes = [max(abs(j.lower), abs(j.upper)) for j in self.joints if j.prismatic]
        return float(lengths + sum(stroke for stroke in strokes if np.isfinite(stroke)))

    def joint_values(self, readings: ArrayLike) -> Floats:
        """Give every joint its value: mimic joints follow their master.

        Args:
            readings: (..., k) values of the actuated joints, in order. [rad or m]

        Returns:
            (..., n) values of all joints.
        """
        values = np.asarray(readings, dtype=float)
        column = {name: values[..., i] for i, name in enumerate(self.actuated)}
        return np.stack(
            [
                column[j.name] if j.mimic is None else j.mimic.multiplier * column[j.mimic.joint] + j.mimic.offset
                for j in self.joints
            ],
            axis=-1,
        )

    def readings(self, values: Floats) -> Floats:
        """Of the values (..., n) of all joints those (..., k) of the actuated ones. [rad or m]."""
        result: Floats = values[..., [joint.mimic is None for joint in self.joints]]
        return result

    @cached_property
    def reading_jacobian(self) -> Floats:
        """How all joints' values (n) follow from the actuated ones' (k): (n, k)."""
        k = len(self.actuated)
        jacobian: Floats = (self.joint_values(np.eye(k)) - self.joint_values(np.zeros(k))).T
        return jacobian

    def build_model(self, placements: ArrayLike | None = None) -> pin.Model:
        """Build the serial Pinocchio model of the chain, rooted at the base link, with q_i the i-th joint's value.

        Args:
            placements: (n, 4, 4) joint placements to use instead of the drawn ones.
        """
        model = pin.Model()
        model.name = self.name
        parent = 0
        for joint, T in zip(
            self.joints, self.placements if placements is None else np.asarray(placements), strict=True
        ):
            parent = model.addJoint(parent, _joint_model(joint), se3(T), joint.name)
        return model

    def random_values(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw ``count`` joint vectors uniformly within the limits, (count, n).

        Joints without limits turn within +-pi or slide within +-0.5 m.
        """
        unlimited = {"revolute": np.pi, "continuous": np.pi, "prismatic": 0.5}
        actuated = [joint for joint in self.joints if joint.mimic is None]
        lower = [j.lower if np.isfinite(j.lower) else -unlimited[j.type] for j in actuated]
        upper = [j.upper if np.isfinite(j.upper) else unlimited[j.type] for j in actuated]
        return self.joint_values(rng.uniform(lower, upper, (count, len(actuated))))


def se3(T: Floats) -> pin.SE3:
    """Copy a rigid transform (4, 4) into Pinocchio's type, without its check that the rotation is exact."""
    return pin.SE3(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))


_ALIGNED = {
    (False, 0): pin.JointModelRX, (False, 1): pin.JointModelRY, (False, 2): pin.JointModelRZ,
    (True, 0): pin.JointModelPX, (True, 1): pin.JointModelPY, (True, 2): pin.JointModelPZ,
}  # fmt: skip


def _joint_model(joint: Joint) -> pin.JointModel:
    along = np.flatnonzero(joint.axis == 1.0)
    if len(along) == 1 and np.count_nonzero(joint.axis) == 1:
        return _ALIGNED[joint.prismatic, int(along[0])]()
    unaligned = pin.JointModelPrismaticUnaligned if joint.prismatic else pin.JointModelRevoluteUnaligned
    return unaligned(*joint.axis)


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
