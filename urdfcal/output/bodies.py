"""The visible shapes of a URDF, hung on the frames of its joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias, cast
from xml.etree.ElementTree import TreeBuilder
from xml.parsers import expat

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.robot.urdf.urdf import find_urdf
from urdfcal.rotations import rpy_to_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

Color: TypeAlias = tuple[float, float, float, float]
MESH_FORMATS = {
    ".stl": "model/stl",
    ".dae": "model/vnd.collada+xml",
    ".obj": "model/obj",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".ply": "application/x-ply",
}
"""Media types of the mesh files that can be shown, by file suffix."""


@dataclass(frozen=True)
class Shape:
    """One visual element of a link.

    Attributes:
        kind: what ``size`` means.
        size: box: lengths along x, y, z; cylinder: radius, length along z; sphere: radius [m];
            mesh: scales along x, y, z.
        T_link_shape: (4, 4) its frame in the link's. [m]
        mesh: the file, for a mesh.
        color: red, green, blue, alpha in 0 ... 1, where the URDF names one.
    """

    kind: Literal["mesh", "box", "cylinder", "sphere"]
    size: tuple[float, ...]
    T_link_shape: Floats
    mesh: Path | None = None
    color: Color | None = None


@dataclass(frozen=True)
class Body:
    """A link that moves with a joint.

    Attributes:
        link: its name.
        frame: 0 for the base link's frame, i + 1 for joint i's.
        T_frame_link: (4, 4) the link in that frame. [m]
        shapes: what of it can be seen.
    """

    link: str
    frame: int
    T_frame_link: Floats
    shapes: tuple[Shape, ...]


def visible_bodies(urdf: Urdf, chain: Mechanism) -> tuple[tuple[Body, ...], tuple[str, ...]]:
    """Collect the links of the arm that have something to show.

    These are the links that its joints carry, what is fixed to them, and everything beyond the last joints (a gripper's
    fingers, at zero joint values); other limbs of a larger robot are left out.

    Returns:
        The links, and warnings about shapes that cannot be shown.
    """
    shapes = _Shapes(urdf)
    bodies = []
    for link, frame, T in _carried_links(urdf, chain):
        found = shapes.of(link)
        if found:
            bodies.append(Body(link, frame, frozen(T), found))
    return tuple(bodies), shapes.warnings()


def _carried_links(urdf: Urdf, chain: Mechanism) -> list[tuple[str, int, Floats]]:
    frame_of = {name: i + 1 for i, name in enumerate(chain.names)}
    last = set(range(1, len(chain.joints) + 1)) - {parent + 1 for parent in chain.parents}
    carried = [(chain.base_link, 0, np.eye(4))]
    for link, frame, T in carried:  # grows while it is walked: parents come before children
        for joint in urdf.joints.values():
            if joint.parent != link:
                continue
            if joint.name in frame_of:
                carried.append((joint.child, frame_of[joint.name], np.eye(4)))
            elif joint.type == "fixed" or frame in last:
                carried.append((joint.child, frame, T @ joint.T_parent_joint))
    return carried


@dataclass
class _Shapes:
    """Reads the shapes of links and keeps account of those that cannot be shown."""

    urdf: Urdf
    links: Mapping[str, Element] = field(init=False)
    colors: Mapping[str, Color] = field(init=False)
    lost: list[tuple[str, str]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        # Not ElementTree's own parser: it stumbles over prefixes that are nowhere declared. Urdf has refused entities.
        builder, parser = TreeBuilder(), expat.ParserCreate()
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.Parse(self.urdf.data, True)
        root = builder.close()
        self.links = {link.get("name", ""): link for link in root.iterfind("link")}
        # A material is known by its name everywhere, wherever it is given its colour.
        self.colors = {
            material.get("name", ""): color for material in root.iter("material") if (color := _color(material))
        }

    def of(self, link: str) -> tuple[Shape, ...]:
        """Read the shapes of a link that can be shown."""
        shapes = (self._shape(link, visual) for visual in self.links[link].iterfind("visual"))
        return tuple(shape for shape in shapes if shape is not None)

    def warnings(self) -> tuple[str, ...]:
        """Say which shapes are not shown, and why the first of them is not."""
        if not self.lost:
            return ()
        names = ", ".join(name for name, _ in self.lost[:3]) + (", ..." if len(self.lost) > 3 else "")
        return (f"{len(self.lost)} shapes of the robot are not shown in the recording ({names}): {self.lost[0][1]}",)

    def _shape(self, link: str, visual: Element) -> Shape | None:
        geometry = visual.find("geometry/*")
        if geometry is None:
            return None
        try:
            return self._read(visual, geometry)
        except RobotError as error:
            self.lost.append((geometry.get("filename", "?").rpartition("/")[2], str(error)))
        except ValueError as error:
            self.lost.append((f"<{geometry.tag}> of {link}", str(error)))
        return None

    def _read(self, visual: Element, geometry: Element) -> Shape:
        T, color = _placement(visual.find("origin")), self._color(visual)
        if geometry.tag == "box":
            return Shape("box", _numbers(geometry, "size", 3), T, color=color)
        if geometry.tag == "sphere":
            return Shape("sphere", _numbers(geometry, "radius", 1), T, color=color)
        if geometry.tag == "cylinder":
            size = _numbers(geometry, "radius", 1) + _numbers(geometry, "length", 1)
            return Shape("cylinder", size, T, color=color)
        if geometry.tag == "mesh":
            return Shape("mesh", _numbers(geometry, "scale", 3, "1 1 1"), T, self._mesh(geometry), color)
        raise ValueError(f"<{geometry.tag}> is no shape of URDF")

    def _mesh(self, geometry: Element) -> Path:
        reference = geometry.get("filename", "")
        folder = self.urdf.path.parent if self.urdf.path else None
        path = find_urdf(reference.removeprefix("file://"), relative_to=folder)
        if path.suffix.lower() not in MESH_FORMATS:
            raise ValueError(f"{path.name} is not one of {', '.join(MESH_FORMATS)}")
        return path

    def _color(self, visual: Element) -> Color | None:
        material = visual.find("material")
        if material is None:
            return None
        return _color(material) or self.colors.get(material.get("name", ""))


def _color(material: Element) -> Color | None:
    element = material.find("color")
    try:
        return None if element is None else cast("Color", _numbers(element, "rgba", 4))
    except ValueError:
        return None  # no reason to leave the shape out


def _placement(origin: Element | None) -> Floats:
    T = np.eye(4)
    if origin is not None:
        T[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0")
        T[:3, :3] = rpy_to_matrix(np.array(_numbers(origin, "rpy", 3, "0 0 0")))
    return T


def _numbers(element: Element, attribute: str, count: int, default: str = "") -> tuple[float, ...]:
    text = element.get(attribute, default)
    numbers = tuple(float(word) for word in text.split())
    if len(numbers) != count:
        raise ValueError(f"{attribute} of <{element.tag}> is {text!r}, not {count} numbers")
    return numbers
