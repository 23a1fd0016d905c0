"""URDF: the cameras' and LEDs' frames as links on fixed joints."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.robot.urdf.markup import Edit, apply_edits
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.output.exports.frames import Frame

# What angles round to.
_READ_BACK = 1e-12


def urdf_with_frames(urdf: Urdf, frames: Sequence[Frame]) -> dict[str, bytes]:
    """Add frames to a URDF, each a link on a fixed joint, before the end of ``<robot>``; all else stays as it is.

    Args:
        urdf: a description that was read from a file.
        frames: what to add.

    Returns:
        The new file, by name.

    Raises:
        OutputError: a link or joint of such a name is there already, or the parent link is not.
        RobotError: the new file cannot be read back.
    """
    for frame in frames:
        if frame.name in urdf.links or _joint(frame) in urdf.joints:
            raise OutputError(
                f"there is a link {frame.name!r} or a joint {_joint(frame)!r} already",
                where=str(urdf.path or urdf.name),
                remedy="Rename the LED or the camera in the session.",
            )
    new_line = b"\r\n" if b"\r\n" in urdf.data else b"\n"
    text = "\n".join(_xml(frame) for frame in frames) + "\n"
    end = _end_of_root(urdf.data)
    data = apply_edits(urdf.data, [Edit(end, end, text.encode("ascii", "xmlcharrefreplace").replace(b"\n", new_line))])
    _check(Urdf.parse(data, urdf.path), frames)
    stem = urdf.path.stem if urdf.path else urdf.name
    return {f"{stem}_frames.urdf": data}


def _joint(frame: Frame) -> str:
    return f"{frame.name}_joint"


def _xml(frame: Frame) -> str:
    T = frame.T_parent_frame
    xyz, rpy = (
        " ".join(repr(float(value) + 0.0) for value in values) for values in (T[:3, 3], matrix_to_rpy(T[:3, :3]))
    )
    return f"""\
  <link name="{frame.name}"/>
  <joint name="{_joint(frame)}" type="fixed">
    <origin xyz="{xyz}" rpy="{rpy}"/>
    <parent link={quoteattr(frame.parent)}/>
    <child link="{frame.name}"/>
  </joint>"""


def _end_of_root(data: bytes) -> int:
    """Where the root element's end tag starts: the last element to end."""
    ends: list[int] = []
    parser = expat.ParserCreate()
    parser.EndElementHandler = lambda _: ends.append(parser.CurrentByteIndex)
    parser.Parse(data, True)
    return ends[-1]


def _check(urdf: Urdf, frames: Sequence[Frame]) -> None:
    for frame in frames:
        T = urdf.joints[_joint(frame)].T_parent_joint
        if not np.allclose(T, frame.T_parent_frame, rtol=0.0, atol=_READ_BACK):
            raise OutputError(
                f"frame {frame.name!r} does not read back as written",
                where=str(urdf.path or urdf.name),
                remedy="This is a defect of urdfcal: please report it with the file.",
            )
