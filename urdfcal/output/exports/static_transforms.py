"""ROS 2: a launch file that publishes the cameras' and LEDs' frames as static transforms."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import pinocchio as pin

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.output.exports.frames import Frame

FILE = "static_transforms.launch.xml"


def static_transforms(frames: Sequence[Frame]) -> dict[str, str]:
    """Write one ``static_transform_publisher`` a frame.

    Args:
        frames: what to publish.

    Returns:
        The launch file, by name.
    """
    lines = [_node(frame) for frame in frames]
    return {FILE: "\n".join(["<launch>", *lines, "</launch>", ""])}


def _node(frame: Frame) -> str:
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
