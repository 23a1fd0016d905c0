"""The URDF: its links, its joints, the tree they form, and the bytes they were read from.

As for urdfdom, Pinocchio's reader, only ``<link>`` and ``<joint>`` directly below ``<robot>`` count. Files it
would refuse are refused here, with the place and the way out.
"""

from __future__ import annotations

from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from urdfcal.errors import RobotError
from urdfcal.names import listed, suggest
from urdfcal.robot.urdf import markup
from urdfcal.robot.urdf.joint import Mimic, UrdfJoint, read_joint
from urdfcal.robot.urdf.packages import find_urdf, package_roots

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from urdfcal.robot.urdf.markup import Element

__all__ = ["Mimic", "Urdf", "UrdfJoint", "find_urdf", "package_roots"]


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
            name: read_joint(name, element, version, source)
            for name, element in _named(root.all("joint"), source).items()
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
