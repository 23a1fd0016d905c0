"""Joint placements written into a URDF: the values of ``<origin>`` change, and not one other byte (METHOD 4)."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.errors import RobotError
from urdfcal.names import suggest
from urdfcal.robot.urdf import markup
from urdfcal.robot.urdf.markup import Edit, apply_edits, changed_attributes, numbers_text, start_tag
from urdfcal.robot.urdf.urdf import Urdf, UrdfJoint
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.markup import Element

# Entries that differ by no more are the same number through different roundings: the text stays.
SAME = 1e-15
# What is read back may differ from what was asked by the angles' rounding (1e-15); near this it is a defect.
READ_BACK = 1e-12


def origins_of(urdf: Urdf, chain: Mechanism, placements: ArrayLike) -> dict[str, Floats]:
    """Compute a URDF's joint origins from new placements of the chain that was read from it.

    A chain's placement folds in the fixed joints before it; the correction, multiplied from the right, does not
    care what the joint hangs on.

    Args:
        urdf: the description that ``chain`` was read from.
        chain: the nominal joints.
        placements: (n, 4, 4) each joint's frame in that of the one it hangs on. [m]

    Returns:
        Joint name -> (4, 4) new T_parent_joint, of the joints whose placement differs from the nominal one.
    """
    return {
        joint.name: urdf.joints[joint.name].T_parent_joint @ inverse(nominal) @ new
        for joint, nominal, new in zip(chain.joints, chain.placements, np.asarray(placements), strict=True)
        if not np.array_equal(nominal, new)
    }


def rewrite_origins(urdf: Urdf, placements: Mapping[str, ArrayLike]) -> bytes:
    """Write joint placements into a URDF, keeping everything else byte for byte.

    Of an ``<origin>`` only the attribute that changes is rewritten, in its own quotes; a missing attribute
    is added to the tag, a missing ``<origin>`` to the joint. Numbers are the shortest that read back exactly.

    Args:
        urdf: the description to correct.
        placements: joint name -> (4, 4) new T_parent_joint; joints left out stay. [m]

    Returns:
        The corrected file: ``urdf.data`` itself when no placement differs from it.

    Raises:
        RobotError: a joint is unknown, a placement is no rigid transform, or a rotation would have to be
            written over a quat_xyzw.
    """
    source = str(urdf.path or "URDF")
    new = {name: np.asarray(T, dtype=float) for name, T in placements.items()}
    for name, T in new.items():
        if name not in urdf.joints:
            raise RobotError(f"there is no joint {name!r}", where=source, remedy=suggest(name, urdf.joints, "joints"))
        _check_rigid(T, name)
    elements = {element.attributes["name"]: element for element in markup.parse(urdf.data, source).all("joint")}
    edits = [
        edit for name, T in new.items() for edit in _edits(urdf.data, elements[name], urdf.joints[name], T, source)
    ]
    if not edits:
        return urdf.data
    data = apply_edits(urdf.data, edits)
    _check_read_back(urdf, Urdf.parse(data, urdf.path), new)
    return data


def _edits(data: bytes, element: Element, joint: UrdfJoint, T: Floats, source: str) -> Iterator[Edit]:
    old = joint.T_parent_joint
    values = {"xyz": numbers_text(T[:3, 3]), "rpy": numbers_text(matrix_to_rpy(T[:3, :3]))}
    changed = {"xyz": np.abs(T[:3, 3] - old[:3, 3]).max() > SAME, "rpy": np.abs(T[:3, :3] - old[:3, :3]).max() > SAME}
    if not any(changed.values()):
        return
    origin = element.first("origin")
    if origin is None:
        yield _inserted_origin(data, element, values)
        return
    if changed["rpy"] and "quat_xyzw" in origin.attributes:
        raise RobotError(
            "its rotation is written as quat_xyzw, which many readers of URDF leave out",
            where=f"{source}:{origin.line}, joint {joint.name!r}",
            remedy="Replace it by rpy, then calibrate again.",
        )
    yield from changed_attributes(data, origin, {name: values[name] for name in values if changed[name]})


# A comment beside the opening tag belongs to that line, not to what is inserted below it.
_REST_OF_LINE = re.compile(rb"[ \t]*<!--(?:(?!-->)[^\r\n])*-->(?=[ \t]*[\r\n])")
_INDENTATION = re.compile(rb"(?:\r\n|\n|\r)[ \t]*\Z")


def _inserted_origin(data: bytes, joint: Element, values: Mapping[str, bytes]) -> Edit:
    start = start_tag(data, joint).end
    beside = _REST_OF_LINE.match(data, start)
    start = beside.end() if beside else start
    first_child = joint.children[0].offset
    # Line end and indentation as before the joint's first element; nothing when they share a line.
    indentation = _INDENTATION.search(data[start:first_child])
    line = indentation[0] if indentation else b""
    return Edit(
        start, start, line + b'<origin xyz="%(xyz)s" rpy="%(rpy)s"/>' % {k.encode(): v for k, v in values.items()}
    )


def _check_rigid(T: Floats, joint: str) -> None:
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise RobotError(f"its new placement is not a finite 4x4 matrix: {T.tolist()}", where=f"joint {joint!r}")
    error = max(np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max(), np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max())
    if error > READ_BACK or np.linalg.det(T[:3, :3]) < 0.0:
        raise RobotError(f"its new placement is no rigid transform (off by {error:.1e})", where=f"joint {joint!r}")


def _check_read_back(old: Urdf, written: Urdf, placements: Mapping[str, Floats]) -> None:
    """Refuse a rewritten file whose joints are not placed as asked, whatever the reason."""
    asked = {name: placements.get(name, joint.T_parent_joint) for name, joint in old.joints.items()}
    if (written.name, written.links, list(written.joints)) != (old.name, old.links, list(asked)):
        wrong = ["other links or joints"]
    else:
        wrong = [n for n, T in asked.items() if np.abs(written.joints[n].T_parent_joint - T).max() > READ_BACK]
    if wrong:
        raise RobotError(
            f"the rewritten file does not read back as asked: {', '.join(wrong[:10])}",
            where=str(old.path or "URDF"),
            remedy="This is a defect of urdfcal: please report it with the file.",
        )
