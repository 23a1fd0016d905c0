"""Frames that a calibration found: poses of the cameras and LEDs, as static transforms of ROS 2 or in the URDF."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import OutputError
from urdfcal.robot.urdf.markup import Edit, apply_edits
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.result.calibration import Calibration

# What tf2, URDF and a launch file's arguments all take.
_NAME = re.compile(r"\w[\w.-]*", re.ASCII)
# Stand in names of things of several sessions, and of things that moved.
_PLAIN = str.maketrans("/@", "__")
# What angles round to.
_READ_BACK = 1e-12
LAUNCH = "static_transforms.launch.xml"


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """A frame fixed to a link.

    Attributes:
        name: its own.
        parent: the link that carries it.
        T_parent_frame: (4, 4) where it is. [m]
    """

    name: str
    parent: str
    T_parent_frame: Floats


def found_frames(calibration: Calibration) -> tuple[FixedFrame, ...]:
    """The cameras' optical frames (z forward, x right, y down) and the LEDs', each in that of the link it is fixed to.

    What is fixed in the world becomes fixed to the base link, as in the last session that has it. A camera's is named
    as ROS drivers do, ``<camera>_optical_frame``, an LED's as the LED, with _ for / and @; LEDs have no orientation:
    theirs is their link's.

    Raises:
        OutputError: a name is none for a frame, that of a link, or two frames have one name.
    """
    document, chain = calibration.to_dict(), calibration.chain
    bases = {thing: document["T_world_base"] for kind in ("leds", "cameras") for thing in document[kind]}
    for session in document.get("sessions", {}).values():
        bases |= dict.fromkeys([*session["leds"], *session["cameras"]], session["T_world_base"])

    def fixed(frame: str, link: str, T: Floats) -> FixedFrame:
        own = frame.translate(_PLAIN)
        if link == WORLD:
            return FixedFrame(own, chain.base_link, frozen(inverse(np.array(bases[name])) @ T))
        return FixedFrame(own, link, frozen(T))

    frames = []
    for name, camera in document["cameras"].items():
        T = inverse(np.array(camera["T_cam_world"])) if "T_cam_world" in camera else np.array(camera["T_link_camera"])
        frames.append(fixed(f"{name}_optical_frame", camera["link"], T))
    for name, led in document["leds"].items():
        T = np.eye(4)
        T[:3, 3] = led["position"]
        frames.append(fixed(name, led["link"], T))
    names = [frame.name for frame in frames]
    links = (chain.base_link, *(tip.link for tip in chain.tips))
    for i, name in enumerate(names):
        if name in links:
            raise OutputError(f"{name!r} is a link of the robot", remedy="Rename the LED or the camera.")
        if not _NAME.fullmatch(name):
            raise OutputError(f"{name!r} is no name for a frame", remedy="Use letters, digits, _, - and . in names.")
        if name in names[:i]:
            raise OutputError(f"two frames would be named {name!r}", remedy="Rename the LED or the camera.")
    return tuple(frames)


def static_transforms(frames: Sequence[FixedFrame]) -> dict[str, str]:
    """Write one ``static_transform_publisher`` a frame.

    Args:
        frames: what to publish.

    Returns:
        The launch file, by name.
    """
    lines = [_node(frame) for frame in frames]
    return {LAUNCH: "\n".join(["<launch>", *lines, "</launch>", ""])}


def _node(frame: FixedFrame) -> str:
    T = frame.T_parent_frame
    quaternion = pin.Quaternion(T[:3, :3]).coeffs()
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    numbers = " ".join(
        f"--{name} {float(value) + 0.0!r}" for name, value in zip(names, [*T[:3, 3], *quaternion], strict=True)
    )
    arguments = f"{numbers} --frame-id {frame.parent} --child-frame-id {frame.name}"
    node = f"{frame.name}_publisher".replace("-", "_").replace(".", "_")
    return (
        f'  <node pkg="tf2_ros" exec="static_transform_publisher" name={quoteattr(node)}\n'
        f"        args={quoteattr(arguments)}/>"
    )


def urdf_with_frames(urdf: Urdf, frames: Sequence[FixedFrame]) -> dict[str, bytes]:
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


def _joint(frame: FixedFrame) -> str:
    return f"{frame.name}_joint"


def _xml(frame: FixedFrame) -> str:
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


def _check(urdf: Urdf, frames: Sequence[FixedFrame]) -> None:
    for frame in frames:
        T = urdf.joints[_joint(frame)].T_parent_joint
        if not np.allclose(T, frame.T_parent_frame, rtol=0.0, atol=_READ_BACK):
            raise OutputError(
                f"frame {frame.name!r} does not read back as written",
                where=str(urdf.path or urdf.name),
                remedy="This is a defect of urdfcal: please report it with the file.",
            )
