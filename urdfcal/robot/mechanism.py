"""Movable joints that hang on one another: what a chain and a tree of joints have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.names import suggest

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from urdfcal.robot.urdf.urdf import Mimic

JointType = Literal["revolute", "continuous", "prismatic"]

BASE = -1
"""The base link, where a joint's index is expected."""

# Values this close to a limit are at it: files round. [rad or m]
_LIMIT_ROUNDING = 1e-6


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

    @property
    def unit(self) -> Literal["rad", "m"]:
        """The unit of the joint's values."""
        return "m" if self.prismatic else "rad"


class LimitViolation(NamedTuple):
    """A reading outside its joint's limits; as text, the finding of an error message.

    Attributes:
        pose: index of its row in the readings.
        joint: the joint that it is of.
        value: the reading. [rad or m]
    """

    pose: int
    joint: Joint
    value: float

    @property
    def beyond(self) -> float:
        """How far it is outside. [rad or m]."""
        return max(self.joint.lower - self.value, self.value - self.joint.upper)

    def __str__(self) -> str:
        joint = self.joint
        limits = f"[{joint.lower:g}, {joint.upper:g}]"
        return f"{joint.name} = {self.value:g} {joint.unit} is outside the joint's limits {limits}"


@dataclass(frozen=True, eq=False)
class Tip:
    """A link at the end of a chain or a branch: the tool, an LED's bracket, a camera's mount.

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


@dataclass(frozen=True, eq=False)
class Mechanism:
    """One-degree-of-freedom joints from a base link outwards: a chain to one tip link, or a tree to several.

    Fixed joints in between are folded into the placements. Every joint has one scalar coordinate, continuous joints
    too. A joint comes after the one that it hangs on.

    Attributes:
        name: the robot's.
        base_link: link whose frame everything starts from; anywhere in the URDF's tree.
        joints: n of them: those to the first tip, from the base outwards, then those to the second that are new, and
            so on.
        parents: index of the joint that each joint hangs on, ``BASE`` for the base link.
        placements: (n, 4, 4) T_parent_joint at zero joint value; of those that hang on the base link in its frame. [m]
        tips: the links of interest, the most important one first.
    """

    name: str
    base_link: str
    joints: tuple[Joint, ...]
    parents: tuple[int, ...]
    placements: Floats
    tips: tuple[Tip, ...]

    def __post_init__(self) -> None:
        if not self.joints:
            raise RobotError(
                f"no movable joint between {self.base_link!r} and {', '.join(repr(tip.link) for tip in self.tips)}",
                where=self.name,
                remedy="Name a base and a tip link with revolute, continuous or prismatic joints in between.",
            )
        object.__setattr__(self, "placements", frozen(self.placements))

    @property
    def tip_link(self) -> str:
        """The first tip's name."""
        return self.tips[0].link

    def tip(self, link: str) -> Tip:
        """Find one of the tips, or the base link, by name.

        Raises:
            RobotError: it is none of them.
        """
        if link == self.base_link:
            return Tip(link, BASE, np.eye(4))
        for tip in self.tips:
            if tip.link == link:
                return tip
        raise RobotError(
            f"link {link!r} is none of the tip links",
            where=self.name,
            remedy=suggest(link, [tip.link for tip in self.tips], "tip links"),
        )

    def end_on(self, joint: int) -> Floats:
        """The frame (4, 4) of the first tip link on a joint in the joint's frame, or that where there is none. [m]."""
        return next((tip.T_joint_link for tip in self.tips if tip.joint == joint), np.eye(4))

    @property
    def names(self) -> tuple[str, ...]:
        """The joints' names."""
        return tuple(joint.name for joint in self.joints)

    @property
    def actuated(self) -> tuple[str, ...]:
        """The names of the joints that have a reading of their own: all but the mimic joints."""
        return tuple(joint.name for joint in self.actuated_joints)

    @property
    def actuated_joints(self) -> tuple[Joint, ...]:
        """The joints that have a reading of their own."""
        return tuple(joint for joint in self.joints if joint.mimic is None)

    @property
    def limits(self) -> tuple[Floats, Floats]:
        """Lower and upper limits of the actuated joints, (k,) each; infinite where there are none. [rad or m]."""
        lower, upper = np.array([(joint.lower, joint.upper) for joint in self.actuated_joints]).T
        return lower, upper

    def outside_limits(self, readings: ArrayLike, margin: float = _LIMIT_ROUNDING) -> list[LimitViolation]:
        """Find the readings that are outside their joint's limits, or not finite.

        Args:
            readings: (..., k) values of the actuated joints, in order. [rad or m]
            margin: how far beyond a limit is still inside. [rad or m]

        Returns:
            Row by row of the readings as (N, k).
        """
        joints, (lower, upper) = self.actuated_joints, self.limits
        q = np.asarray(readings, dtype=float).reshape(-1, len(joints))
        outside = ~((q >= lower - margin) & (q <= upper + margin) & np.isfinite(q))
        return [LimitViolation(int(pose), joints[i], float(q[pose, i])) for pose, i in np.argwhere(outside)]

    def path(self, joint: int) -> tuple[int, ...]:
        """List the joints from the base link to ``joint``, itself included; none for ``BASE``."""
        path: list[int] = []
        while joint != BASE:
            path.insert(0, joint)
            joint = self.parents[joint]
        return tuple(path)

    @property
    def branches(self) -> tuple[tuple[int, ...], ...]:
        """The joints cut into serial runs, each hanging on a joint of an earlier one, or on the base link.

        A run begins where a joint is not the first to hang on its parent.
        """
        runs: dict[int, list[int]] = {}  # by their last joint
        for joint, parent in enumerate(self.parents):
            runs[joint] = [*runs.pop(parent, []), joint]
        return tuple(map(tuple, sorted(runs.values())))

    @cached_property
    def reach(self) -> float:
        """An upper bound of any tip's distance from the base link's origin. [m]."""
        lengths = []
        for tip in self.tips:
            path = list(self.path(tip.joint))
            strokes = [max(abs(j.lower), abs(j.upper)) for j in (self.joints[i] for i in path) if j.prismatic]
            length = np.linalg.norm(self.placements[path, :3, 3], axis=1).sum()
            length += np.linalg.norm(tip.T_joint_link[:3, 3])
            lengths.append(float(length + sum(stroke for stroke in strokes if np.isfinite(stroke))))
        return max(lengths)

    def joint_values(self, readings: ArrayLike) -> Floats:
        """Compute every joint's value from the readings: mimic joints follow their master.

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
        """Select the actuated joints' values (..., k) from all joints' values (..., n). [rad or m]."""
        result: Floats = values[..., [joint.mimic is None for joint in self.joints]]
        return result

    def torques(self, measured: Floats) -> Floats:
        """Return torques (..., n) of all joints from measured ones (..., k); mimic joints have none."""
        result = np.zeros((*measured.shape[:-1], len(self.joints)))
        result[..., [joint.mimic is None for joint in self.joints]] = measured
        return result

    @cached_property
    def reading_jacobian(self) -> Floats:
        """The derivative (n, k) of all joints' values with respect to the actuated joints' readings."""
        k = len(self.actuated)
        jacobian: Floats = (self.joint_values(np.eye(k)) - self.joint_values(np.zeros(k))).T
        return jacobian

    def with_placements(self, placements: Floats) -> Mechanism:
        """Copy the mechanism with other joint placements (n, 4, 4). [m]."""
        return replace(self, placements=placements)

    def build_model(self, placements: ArrayLike | None = None) -> pin.Model:
        """Build the Pinocchio model of these joints, rooted at the base link, with q_i the i-th joint's value.

        Args:
            placements: (n, 4, 4) joint placements to use instead of the nominal ones.
        """
        model = pin.Model()
        model.name = self.name
        placements = self.placements if placements is None else np.asarray(placements)
        for joint, parent, T in zip(self.joints, self.parents, placements, strict=True):
            model.addJoint(parent + 1, _joint_model(joint), se3(T), joint.name)
        return model

    def random_values(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw ``count`` vectors of joint values uniformly within the limits, (count, n).

        Joints without limits turn within +-pi or slide within +-0.5 m.
        """
        lower, upper = self.limits
        farthest = np.array([0.5 if joint.prismatic else np.pi for joint in self.actuated_joints])
        lower, upper = np.where(np.isfinite(lower), lower, -farthest), np.where(np.isfinite(upper), upper, farthest)
        return self.joint_values(rng.uniform(lower, upper, (count, len(farthest))))


def se3(T: Floats) -> pin.SE3:
    """Copy a rigid transform (4, 4) into Pinocchio's type, without its check that the rotation is exact."""
    return pin.SE3(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))


def _joint_model(joint: Joint) -> pin.JointModel:
    kind = ("Revolute", "R") if not joint.prismatic else ("Prismatic", "P")
    if 1.0 in joint.axis and np.count_nonzero(joint.axis) == 1:
        return getattr(pin, f"JointModel{kind[1]}{'XYZ'[int(np.argmax(joint.axis))]}")()
    return getattr(pin, f"JointModel{kind[0]}Unaligned")(*joint.axis)
