"""Movable joints that hang on one another, as drawn: what a chain and a tree of joints have in common."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from urdfcal.robot.urdf.urdf import Mimic

JointType = Literal["revolute", "continuous", "prismatic"]

BASE = -1
"""Stands for the base link where a joint's index is asked for."""


@dataclass(frozen=True, eq=False)
class Joint:
    """One movable joint.

    Attributes:
        name: as in the URDF.
        type: revolute, continuous or prismatic.
        axis: (3,) unit vector in the joint's own frame.
        lower: limit, rad or m; -inf where there is none.
        upper: limit, rad or m; inf where there is none.
        mimic: the joint of the same mechanism it moves with, if any.
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
class Tip:
    """A link that something is fastened to: where a chain ends, an LED's bracket, a camera's mount.

    Attributes:
        link: its name.
        joint: index of the last joint before it; ``BASE`` where there is none.
        T_joint_link: (4, 4) the link's frame in that joint's, or in the base link's. [m]
    """

    link: str
    joint: int
    T_joint_link: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_joint_link", frozen(self.T_joint_link))


class Mechanism:
    """Joints with one degree of freedom each, from a base link outwards.

    Fixed joints in between are folded into the placements. Every joint has one scalar coordinate, continuous joints
    too. A joint comes after the one that it hangs on.

    Attributes:
        name: the robot's.
        base_link: link whose frame everything starts from; anywhere in the URDF's tree.
        joints: n of them.
        parents: index of the joint that each joint hangs on, ``BASE`` for the base link.
        placements: (n, 4, 4) T_parent_joint at zero joint value; of those that hang on the base link in its frame. [m]
        tips: the links of interest, the most important one first.
        tip_link: the link of most interest.
    """

    name: str
    base_link: str
    joints: tuple[Joint, ...]
    parents: tuple[int, ...]
    placements: Floats
    tips: tuple[Tip, ...]
    tip_link: str

    def tip(self, link: str) -> Tip:
        """One of the tips, or the base link, by name.

        Raises:
            RobotError: it is none of them.
        """
        if link == self.base_link:
            return Tip(link, BASE, np.eye(4))
        for tip in self.tips:
            if tip.link == link:
                return tip
        raise RobotError(
            f"link {link!r} is none that was asked for",
            where=self.name,
            remedy=f"There are: {', '.join(tip.link for tip in self.tips)}.",
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names."""
        return tuple(joint.name for joint in self.joints)

    @property
    def actuated(self) -> tuple[str, ...]:
        """The names of the joints that have a reading of their own: all but the mimic joints."""
        return tuple(joint.name for joint in self.joints if joint.mimic is None)

    def path(self, joint: int) -> tuple[int, ...]:
        """The joints from the base link to ``joint``, which is the last of them; none for ``BASE``."""
        path: list[int] = []
        while joint != BASE:
            path.insert(0, joint)
            joint = self.parents[joint]
        return tuple(path)

    @cached_property
    def reach(self) -> float:
        """An upper bound of any tip's distance from the base link's origin. [m]."""
        longest = 0.0
        for tip in self.tips:
            path = list(self.path(tip.joint))
            length = np.linalg.norm(self.placements[path, :3, 3], axis=1).sum() + np.linalg.norm(
                tip.T_joint_link[:3, 3]
            )
            strokes = [max(abs(j.lower), abs(j.upper)) for j in (self.joints[i] for i in path) if j.prismatic]
            longest = max(longest, float(length + sum(stroke for stroke in strokes if np.isfinite(stroke))))
        return longest

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
        """Build the Pinocchio model of these joints, rooted at the base link, with q_i the i-th joint's value.

        Args:
            placements: (n, 4, 4) joint placements to use instead of the drawn ones.
        """
        model = pin.Model()
        model.name = self.name
        placements = self.placements if placements is None else np.asarray(placements)
        for joint, parent, T in zip(self.joints, self.parents, placements, strict=True):
            model.addJoint(parent + 1, _joint_model(joint), se3(T), joint.name)
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
