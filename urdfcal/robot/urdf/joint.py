"""One ``<joint>`` of a URDF, checked the way urdfdom, Pinocchio's reader, checks it.

Joints that it would refuse are refused here, with the place and the way out. Of several elements of a kind
in a joint, the first counts.
"""

from __future__ import annotations

import math
import re
import reprlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.urdf import markup
from urdfcal.rotations import quaternion_to_matrix, rpy_to_matrix

if TYPE_CHECKING:
    from urdfcal.robot.urdf.markup import Element

UrdfJointType = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]


@dataclass(frozen=True)
class Mimic:
    """The joint that another one follows: value = multiplier * (value of ``joint``) + offset.

    Attributes:
        joint: name of the joint followed, as read: there may be none of that name (example-robot-data's
            alex_psyonic_hands has such joints, and Pinocchio loads it).
        multiplier: its gear ratio.
        offset: rad or m.
    """

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        name: its name.
        type: one of URDF's six.
        parent: name of the link it hangs on.
        child: name of the link it moves.
        T_parent_joint: (4, 4) its frame, at zero the child link's, in the parent link's frame. [m]
        axis: (3,) unit vector in its own frame, or zero as read.
        lower: limit, rad or m; -inf where there is none.
        upper: limit, rad or m; inf where there is none.
        mimic: the joint it follows, if any.
        line: of the file, where it starts.
    """

    name: str
    type: UrdfJointType
    parent: str
    child: str
    T_parent_joint: Floats
    axis: Floats
    lower: float
    upper: float
    mimic: Mimic | None
    line: int


def read_joint(name: str, element: Element, version: str, source: str) -> UrdfJoint:
    """Read one joint.

    Args:
        name: the joint's.
        element: its ``<joint>``.
        version: of URDF, as ``<robot>`` declares it.
        source: what to call the file in messages.

    Raises:
        RobotError: something it needs is missing or makes no sense.
    """

    def at(child: Element | None) -> str:
        return f"{source}:{(child or element).line}, joint {name!r}"

    written = element.attributes.get("type", "")
    kind = _TYPES.get(written)
    if kind is None:
        what = f"its type {written!r} is not known" if written else "it has no type"
        raise RobotError(what, where=at(None), remedy=f"URDF has: {', '.join(_TYPES)}.")
    origin, axis, limit, mimic = (element.first(tag) for tag in ("origin", "axis", "limit", "mimic"))
    lower, upper = _limits(kind, limit, at(limit))
    return UrdfJoint(
        name=name,
        type=kind,
        parent=_link(element.first("parent"), "parent", at(None)),
        child=_link(element.first("child"), "child", at(None)),
        T_parent_joint=frozen(_placement(origin, version, at(origin))),
        # urdfdom reads no axis of a joint that has none.
        axis=frozen(_axis(axis if kind not in ("fixed", "floating") else None, at(axis))),
        lower=lower,
        upper=upper,
        mimic=_mimic(mimic, at(mimic)),
        line=element.line,
    )


_TYPES: dict[str, UrdfJointType] = {kind: kind for kind in get_args(UrdfJointType)}


def _link(element: Element | None, tag: str, where: str) -> str:
    link = element.attributes.get("link") if element else None
    if not link:
        raise RobotError(f"it has no {tag} link", where=where, remedy=f'Write <{tag} link="..."/>.')
    return link


def _placement(origin: Element | None, version: str, where: str) -> Floats:
    T = np.eye(4)
    if origin is None:
        return T
    T[:3, 3] = _vector(origin, "xyz", where, default=(0.0, 0.0, 0.0))
    if "quat_xyzw" not in origin.attributes:
        T[:3, :3] = rpy_to_matrix(_vector(origin, "rpy", where, default=(0.0, 0.0, 0.0)))
        return T
    if version == "1.0":
        raise RobotError(
            "quat_xyzw is not part of URDF 1.0: Pinocchio would silently leave it out",
            where=where,
            remedy='Write <robot version="1.2" ...>, or rpy.',
        )
    if "rpy" in origin.attributes:
        raise RobotError("the origin has both rpy and quat_xyzw", where=where, remedy="Remove one.")
    xyzw = _vector(origin, "quat_xyzw", where, count=4)
    if not np.any(xyzw):
        raise RobotError("quat_xyzw is zero, which is no rotation", where=where, remedy='No rotation is "0 0 0 1".')
    T[:3, :3] = quaternion_to_matrix(xyzw)
    return T


def _axis(element: Element | None, where: str) -> Floats:
    x = (1.0, 0.0, 0.0)
    axis = np.array(x) if element is None else _vector(element, "xyz", where, default=x)
    return axis / (math.hypot(*axis) or 1.0)


def _limits(kind: UrdfJointType, limit: Element | None, where: str) -> tuple[float, float]:
    if limit is None:
        if kind in ("revolute", "prismatic"):
            raise RobotError(
                f"a {kind} joint needs a <limit>: Pinocchio refuses it without",
                where=where,
                remedy='Add <limit lower="..." upper="..." effort="..." velocity="..."/>'
                + (", or make it continuous." if kind == "revolute" else "."),
            )
        return -math.inf, math.inf
    for needed in ("effort", "velocity"):
        if needed not in limit.attributes:
            raise RobotError(
                f"its <limit> has no {needed}: Pinocchio refuses it without", where=where, remedy=f'Add {needed}="0".'
            )
        _scalar(limit, needed, where)
    lower, upper = _scalar(limit, "lower", where), _scalar(limit, "upper", where)
    return (lower, upper) if kind in ("revolute", "prismatic") else (-math.inf, math.inf)


def _mimic(element: Element | None, where: str) -> Mimic | None:
    if element is None:
        return None
    joint = element.attributes.get("joint")
    if not joint:
        raise RobotError("its <mimic> names no joint", where=where, remedy='Write <mimic joint="..."/>.')
    return Mimic(joint, _scalar(element, "multiplier", where, default=1.0), _scalar(element, "offset", where))


# A number as urdfdom takes it: Python's float would also take nan, inf, 1_000 and Arabic digits.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SPACE = re.compile(r"[ \t\r\n]+")


def _vector(
    element: Element, attribute: str, where: str, *, count: int = 3, default: tuple[float, ...] | None = None
) -> Floats:
    text = element.attributes.get(attribute)
    if text is None and default is not None:
        return np.array(default)
    words = [word for word in _SPACE.split(text or "") if word]
    if len(words) != count:
        raise RobotError(
            f"{attribute} of <{element.tag}> has {len(words)} numbers, not {count}: {reprlib.repr(text)}",
            where=where,
            remedy="Write them with spaces in between.",
        )
    return np.array([_number(word, f"{attribute} of <{element.tag}>", where) for word in words])


def _scalar(element: Element, attribute: str, where: str, default: float = 0.0) -> float:
    text = element.attributes.get(attribute)
    return default if text is None else _number(text, f"{attribute} of <{element.tag}>", where)


def _number(text: str, what: str, where: str) -> float:
    if "${" in text or "$(" in text:
        raise markup.xacro_error(f"{what} is {reprlib.repr(text)}", where)
    if not _NUMBER.fullmatch(text) or not math.isfinite(value := float(text)):
        raise RobotError(
            f"{what} is {reprlib.repr(text)}, not a finite number", where=where, remedy="Write it like 0.1 or 1e-3."
        )
    return value
