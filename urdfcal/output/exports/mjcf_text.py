"""Bodies of a MuJoCo file as text: which ``<body>`` a joint moves, and new places for such bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.robot.urdf.markup import (
    Edit,
    Element,
    ElementReader,
    apply_edits,
    changed_attributes,
    numbers_text,
    start_tag,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from urdfcal.arrays import Floats

# MuJoCo's other ways to write a body's orientation; quat takes their place.
_ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")


def joint_bodies(data: bytes, path: str) -> dict[str, Element]:
    """Find the ``<body>`` that each named joint of a MuJoCo file moves.

    Args:
        data: the file's bytes.
        path: what to call it in messages.

    Raises:
        RobotError: it is no MuJoCo file, or one whose text does not say where its bodies are.
    """
    reader = _MjcfReader(path)
    reader.read(data)
    return reader.bodies


def with_places(data: bytes, moved: Iterable[tuple[Element, Floats, Floats]]) -> bytes:
    """Give bodies other places; only their ``pos`` and orientation change, and only where they differ.

    Args:
        data: the file's bytes.
        moved: bodies, each with its place (4, 4) in its parent body's frame, as MuJoCo reads it, and the new one. [m]
    """
    return apply_edits(data, [edit for body, old, new in moved for edit in _edits(data, body, old, new)])


def _edits(data: bytes, body: Element, old: Floats, new: Floats) -> Iterator[Edit]:
    values = {}
    if not np.array_equal(old[:3, 3], new[:3, 3]):
        values["pos"] = numbers_text(new[:3, 3])
    if not np.array_equal(old[:3, :3], new[:3, :3]):
        x, y, z, w = pin.Quaternion(np.ascontiguousarray(new[:3, :3])).normalized().coeffs()
        values["quat"] = numbers_text(np.array([w, x, y, z]))
    written = next((name for name in _ORIENTATIONS[1:] if name in body.attributes), None)
    if written is not None and "quat" in values:
        attribute = start_tag(data, body).attributes[written]
        quote = attribute["quote"]
        yield Edit(attribute.start("name"), attribute.end(), b"quat=" + quote + values.pop("quat") + quote)
    yield from changed_attributes(data, body, values)


class _MjcfReader(ElementReader):
    """Gathers the body of every named joint."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.bodies: dict[str, Element] = {}

    def doctype(self, name: str, system_id: str | None, public_id: str | None, internal_subset: int) -> None:
        raise self.refusal(f"it has a document type, <!DOCTYPE {name} ...>", "Remove it: MuJoCo reads none.")

    def started(self, element: Element) -> None:
        tag, attributes = element.tag, element.attributes
        if not self.opened and tag != "mujoco":
            raise self.refusal(
                f"the root element is <{tag}>, not <mujoco>",
                "For another URDF: urdfcal apply OUT OTHER.urdf." if tag == "robot" else "Is it a MuJoCo file?",
            )
        if tag == "include":
            raise self.refusal(
                "it includes another file, in which bodies may be", "Name the file that holds the robot's bodies."
            )
        if tag == "compiler" and attributes.get("fusestatic") == "true":
            raise self.refusal(
                "fusestatic merges bodies, so that places are not those in the file", 'Write fusestatic="false".'
            )
        if tag == "joint" and "name" in attributes:
            self._joint(attributes["name"])

    def _joint(self, name: str) -> None:
        bodies = [i for i, element in enumerate(self.opened) if element.tag == "body"]
        if not bodies or self.opened[1].tag != "worldbody":
            return  # of an equality, a tendon, a default
        above = self.opened[bodies[-1] - 1].tag
        if above not in ("body", "worldbody"):
            raise self.refusal(
                f"the body of joint {name!r} is inside <{above}>", "Write it directly in the body that carries it."
            )
        self.bodies[name] = self.opened[bodies[-1]]
