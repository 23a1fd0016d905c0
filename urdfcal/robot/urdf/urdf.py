"""The URDF: its links, its joints, the tree they form, and the bytes they were read from.

As for urdfdom, Pinocchio's reader, only ``<link>`` and ``<joint>`` directly below ``<robot>`` count, and of several
elements of a kind in a joint the first. Files it would refuse are refused here, with the place and the way out.
"""

from __future__ import annotations

import math
import re
import reprlib
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.names import listed, suggest
from urdfcal.robot.urdf import markup
from urdfcal.robot.urdf.markup import Element
from urdfcal.robot.urdf.packages import find_urdf, package_roots
from urdfcal.rotations import quaternion_to_matrix, rpy_to_matrix

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

__all__ = ["Mimic", "Urdf", "UrdfJoint", "find_urdf", "package_roots"]

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


@dataclass(frozen=True, eq=False)
class Urdf:
    """A robot description, validated.

    Attributes:
        path: the file it was read from, if any.
        data: its bytes, as they were.
        name: the robot's.
        links: names, in document order.
        joints: by name, in document order.
        root: name of the one link without a parent.
    """

    path: Path | None
    data: bytes
    name: str
    links: tuple[str, ...]
    joints: Mapping[str, UrdfJoint]
    root: str

    @classmethod
    def read(cls, path: str | Path) -> Urdf:
        """Read a file.

        Args:
            path: of the file, or a ``package://`` reference.

        Raises:
            RobotError: it cannot be found or read, or is no valid URDF.
        """
        path = find_urdf(path)
        if path.suffix == ".xacro":
            raise markup.xacro_error("its name ends in .xacro", str(path))
        try:
            size = path.stat().st_size
            if size > markup.MAX_BYTES:
                raise markup.too_large(size, str(path))
            data = path.read_bytes()
        except OSError as error:
            raise RobotError(f"cannot be read: {error.strerror}", where=str(path)) from error
        return cls.parse(data, path)

    @classmethod
    def parse(cls, data: bytes, path: Path | None = None) -> Urdf:
        """Read a URDF from its bytes.

        Args:
            data: the file's content.
            path: what to call it in messages.

        Raises:
            RobotError: it is no valid URDF.
        """
        source = str(path) if path else "URDF"
        root = markup.parse(data, source)
        robot, version = _robot(root, source)
        links = tuple(_named(root.all("link"), source))
        joints = {
            name: _joint(name, element, version, source) for name, element in _named(root.all("joint"), source).items()
        }
        return cls(path, data, robot, links, MappingProxyType(joints), _root(links, joints, source))

    @property
    def text(self) -> str:
        """Its bytes decoded, for Pinocchio."""
        try:
            return self.data.decode("utf-8-sig")
        except UnicodeDecodeError:
            return self.data.decode("latin-1")

    def __reduce__(self) -> tuple[Any, ...]:
        # Its bytes are all that other processes need.
        return Urdf.parse, (self.data, self.path)


def _robot(root: Element, source: str) -> tuple[str, str]:
    """Return the robot's name and the version of URDF it is written in."""
    where = f"{source}:{root.line}"
    if root.tag != "robot":
        raise RobotError(f"the root element is <{root.tag}>, not <robot>", where=where, remedy="Is it a URDF?")
    name = root.attributes.get("name")
    if not name:
        raise RobotError("<robot> has no name", where=where, remedy='Write <robot name="...">.')
    version = root.attributes.get("version", "1.0")
    if version not in ("1.0", "1.1", "1.2"):
        raise RobotError(f"URDF version {version!r} is not 1.0, 1.1 or 1.2", where=where)
    return name, version


def _named(elements: Collection[Element], source: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in elements:
        name = element.attributes.get("name")
        where = f"{source}:{element.line}"
        if not name:
            raise RobotError(f"<{element.tag}> has no name", where=where)
        if name in found:
            raise RobotError(
                f"there is a {element.tag} {name!r} already, in line {found[name].line}",
                where=where,
                remedy="Rename one.",
            )
        found[name] = element
    return found


def _root(links: tuple[str, ...], joints: Mapping[str, UrdfJoint], source: str) -> str:
    """Check that links and joints form one tree, and return the link at its root."""
    if not links:
        raise RobotError("the robot has no links", where=source)
    known = set(links)
    above: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        where = f"{source}:{joint.line}, joint {joint.name!r}"
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in known:
                raise RobotError(f"there is no {role} link {link!r}", where=where, remedy=suggest(link, links, "links"))
        if joint.child in above:
            raise RobotError(
                f"link {joint.child!r} hangs on joint {above[joint.child].name!r} already",
                where=where,
                remedy="A link has one parent: a closed loop cannot be written in URDF.",
            )
        above[joint.child] = joint
    try:
        TopologicalSorter({child: [joint.parent] for child, joint in above.items()}).prepare()
    except CycleError as error:
        loop = error.args[1]
        raise RobotError(
            f"its links form a loop: {' -> '.join(loop)}",
            where=f"{source}:{above[loop[-1]].line}, joint {above[loop[-1]].name!r}",
            remedy="A URDF is a tree.",
        ) from error
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        raise RobotError(
            f"it has {len(roots)} root links: {listed(roots)}",
            where=source,
            remedy="Every link but one must be the child of a joint.",
        )
    return roots[0]


_TYPES: dict[str, UrdfJointType] = {kind: kind for kind in get_args(UrdfJointType)}


def _joint(name: str, element: Element, version: str, source: str) -> UrdfJoint:
    """Read one ``<joint>``, checked the way urdfdom checks it."""

    def part(tag: str) -> tuple[Element, str]:
        """Its first child of a tag, without attributes where there is none, and what to call the place."""
        found = element.first(tag) or Element(tag, {}, element.offset, element.line)
        return found, f"{source}:{found.line}, joint {name!r}"

    where = f"{source}:{element.line}, joint {name!r}"
    written = element.attributes.get("type", "")
    if (kind := _TYPES.get(written)) is None:
        what = f"its type {written!r} is not known" if written else "it has no type"
        raise RobotError(what, where=where, remedy=f"URDF has: {', '.join(_TYPES)}.")
    links = {tag: part(tag)[0].attributes.get("link", "") for tag in ("parent", "child")}
    for tag, link in links.items():
        if not link:
            raise RobotError(f"it has no {tag} link", where=where, remedy=f'Write <{tag} link="..."/>.')
    lower, upper = _limits(kind, *part("limit"), missing=element.first("limit") is None)
    # urdfdom reads no axis of a joint that has none.
    axis = np.array([1.0, 0.0, 0.0]) if kind in ("fixed", "floating") else _vector(*part("axis"), "xyz", "1 0 0")
    return UrdfJoint(
        name=name,
        type=kind,
        **links,
        T_parent_joint=frozen(_placement(*part("origin"), version)),
        axis=frozen(axis / (math.hypot(*axis) or 1.0)),
        lower=lower,
        upper=upper,
        mimic=None if element.first("mimic") is None else _mimic(*part("mimic")),
        line=element.line,
    )


def _placement(origin: Element, where: str, version: str) -> Floats:
    T = np.eye(4)
    T[:3, 3] = _vector(origin, where, "xyz")
    if "quat_xyzw" not in origin.attributes:
        T[:3, :3] = rpy_to_matrix(_vector(origin, where, "rpy"))
        return T
    if version == "1.0":
        raise RobotError(
            "quat_xyzw is not part of URDF 1.0: Pinocchio would silently leave it out",
            where=where,
            remedy='Write <robot version="1.2" ...>, or rpy.',
        )
    if "rpy" in origin.attributes:
        raise RobotError("the origin has both rpy and quat_xyzw", where=where, remedy="Remove one.")
    xyzw = _vector(origin, where, "quat_xyzw", count=4)
    if not np.any(xyzw):
        raise RobotError("quat_xyzw is zero, which is no rotation", where=where, remedy='No rotation is "0 0 0 1".')
    T[:3, :3] = quaternion_to_matrix(xyzw)
    return T


def _limits(kind: UrdfJointType, limit: Element, where: str, *, missing: bool) -> tuple[float, float]:
    limited = kind in ("revolute", "prismatic")
    if missing and limited:
        raise RobotError(
            f"a {kind} joint needs a <limit>: Pinocchio refuses it without",
            where=where,
            remedy='Add <limit lower="..." upper="..." effort="..." velocity="..."/>'
            + (", or make it continuous." if kind == "revolute" else "."),
        )
    for needed in () if missing else ("effort", "velocity"):
        if needed not in limit.attributes:
            raise RobotError(
                f"its <limit> has no {needed}: Pinocchio refuses it without", where=where, remedy=f'Add {needed}="0".'
            )
        _scalar(limit, where, needed)
    lower, upper = _scalar(limit, where, "lower"), _scalar(limit, where, "upper")
    return (lower, upper) if limited else (-math.inf, math.inf)


def _mimic(mimic: Element, where: str) -> Mimic:
    joint = mimic.attributes.get("joint")
    if not joint:
        raise RobotError("its <mimic> names no joint", where=where, remedy='Write <mimic joint="..."/>.')
    return Mimic(joint, _scalar(mimic, where, "multiplier", "1"), _scalar(mimic, where, "offset"))


# A number as urdfdom takes it: Python's float would also take nan, inf, 1_000 and Arabic digits.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def _vector(element: Element, where: str, attribute: str, default: str = "0 0 0", count: int = 3) -> Floats:
    text = element.attributes.get(attribute, default)
    words = re.findall(r"[^ \t\r\n]+", text)
    if len(words) != count:
        raise RobotError(
            f"{attribute} of <{element.tag}> has {len(words)} numbers, not {count}: {reprlib.repr(text)}",
            where=where,
            remedy="Write them with spaces in between.",
        )
    return np.array([_number(word, f"{attribute} of <{element.tag}>", where) for word in words])


def _scalar(element: Element, where: str, attribute: str, default: str = "0") -> float:
    return _number(element.attributes.get(attribute, default), f"{attribute} of <{element.tag}>", where)


def _number(text: str, what: str, where: str) -> float:
    if "${" in text or "$(" in text:
        raise markup.xacro_error(f"{what} is {reprlib.repr(text)}", where)
    if not _NUMBER.fullmatch(text) or not math.isfinite(value := float(text)):
        raise RobotError(
            f"{what} is {reprlib.repr(text)}, not a finite number", where=where, remedy="Write it like 0.1 or 1e-3."
        )
    return value
