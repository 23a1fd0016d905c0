"""Frames that a calibration found: cameras, targets, LEDs and the tracker, as transforms of ROS 2 or in the URDF."""

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
_NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw")
TRACKER = "tracker"
"""What the frame is called in which points and poses were measured."""
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

    @property
    def joint(self) -> str:
        """The joint that fixes it, in a URDF."""
        return f"{self.name}_joint"


def found_frames(calibration: Calibration) -> tuple[FixedFrame, ...]:
    """The cameras' optical frames (z forward, x right, y down), the targets' and LEDs', in those of what carries them.

    Where a tracker measured, or a camera whose poses of targets are all there is, its frame is there as well.

    What is fixed in the world becomes fixed to the base link, as in the last session that has it. A camera's is named
    as ROS drivers do, ``<camera>_optical_frame``, an LED's as the LED, with _ for / and @; LEDs have no orientation:
    theirs is their link's.

    Raises:
        OutputError: a name is none for a frame, that of a link, or two frames have one name.
    """
    document, chain, found = calibration.document, calibration.chain, []
    bases = dict.fromkeys([TRACKER, *document.leds, *document.targets, *document.cameras], document.T_world_base)
    for session in document.sessions.values():
        bases |= dict.fromkeys([*session.leds, *session.cameras], session.T_world_base)
    for name, camera in document.cameras.items():
        T = np.array(camera.T_link_camera) if camera.T_cam_world is None else inverse(np.array(camera.T_cam_world))
        found.append((name, f"{name}_optical_frame", camera.link, T))
    if not document.cameras and any(each.kind in ("points", "poses") for each in document.fit.residuals):
        found.append((TRACKER, TRACKER, WORLD, np.eye(4)))
    for name, target in document.targets.items():
        found.append((name, name, target.link, np.array(target.T_link_target)))
    for name, led in document.leds.items():
        T = np.eye(4)
        T[:3, 3] = led.position
        found.append((name, name, led.link, T))
    frames = []
    for name, frame, link, T in found:
        if link == WORLD:
            link, T = chain.base_link, inverse(np.array(bases[name])) @ T
        frames.append(FixedFrame(frame.translate(_PLAIN), link, frozen(T)))
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
    lines = []
    for frame in frames:
        T = frame.T_parent_frame
        numbers = zip(_NUMBERS, [*T[:3, 3], *pin.Quaternion(T[:3, :3]).coeffs()], strict=True)
        words = [f"--{name} {float(value) + 0.0!r}" for name, value in numbers]
        arguments = " ".join([*words, f"--frame-id {frame.parent} --child-frame-id {frame.name}"])
        node = f"{frame.name}_publisher".replace("-", "_").replace(".", "_")
        lines.append(f'  <node pkg="tf2_ros" exec="static_transform_publisher" name={quoteattr(node)}')
        lines.append(f"        args={quoteattr(arguments)}/>")
    return {LAUNCH: "\n".join(["<launch>", *lines, "</launch>", ""])}


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
        if frame.name in urdf.links or frame.joint in urdf.joints:
            raise OutputError(
                f"there is a link {frame.name!r} or a joint {frame.joint!r} already",
                where=str(urdf.path or urdf.name),
                remedy="Rename the LED or the camera in the session.",
            )
    new_line = b"\r\n" if b"\r\n" in urdf.data else b"\n"
    text = "\n".join(_xml(frame) for frame in frames) + "\n"
    end = _end_of_root(urdf.data)
    data = apply_edits(urdf.data, [Edit(end, end, text.encode("ascii", "xmlcharrefreplace").replace(b"\n", new_line))])
    written = Urdf.parse(data, urdf.path)
    for frame in frames:
        T = written.joints[frame.joint].T_parent_joint
        if not np.allclose(T, frame.T_parent_frame, rtol=0.0, atol=_READ_BACK):
            raise OutputError(
                f"frame {frame.name!r} does not read back as written",
                where=str(urdf.path or urdf.name),
                remedy="This is a defect of urdfcal: please report it with the file.",
            )
    stem = urdf.path.stem if urdf.path else urdf.name
    return {f"{stem}_frames.urdf": data}


def _xml(frame: FixedFrame) -> str:
    T = frame.T_parent_frame
    xyz, rpy = (
        " ".join(repr(float(value) + 0.0) for value in values) for values in (T[:3, 3], matrix_to_rpy(T[:3, :3]))
    )
    return f"""\
  <link name="{frame.name}"/>
  <joint name="{frame.joint}" type="fixed">
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
