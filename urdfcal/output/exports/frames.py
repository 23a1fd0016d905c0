"""Frames that a calibration found: where the cameras stand, and where the LEDs sit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import OutputError
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from urdfcal.result.calibration import Calibration

# What tf2, URDF and a launch file's arguments all take.
_NAME = re.compile(r"\w[\w.-]*", re.ASCII)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame fixed to a link.

    Attributes:
        name: its own.
        parent: the link that carries it.
        T_parent_frame: (4, 4) where it is. [m]
    """

    name: str
    parent: str
    T_parent_frame: Floats


def found_frames(calibration: Calibration) -> tuple[Frame, ...]:
    """The cameras' optical frames (z forward, x right, y down) and the LEDs', each in that of the link it is fixed to.

    What stands in the world stands on the base link. A camera's is named as ROS drivers do,
    ``<camera>_optical_frame``, an LED's as the LED; LEDs have no orientation: theirs is their link's.

    Raises:
        OutputError: a name is none for a frame, that of a link, or two frames have one name.
    """
    document, chain = calibration.to_dict(), calibration.chain
    T_base_world = inverse(np.array(document["T_world_base"]))

    def fixed(name: str, link: str, T: Floats) -> Frame:
        if link == WORLD:
            return Frame(name, chain.base_link, frozen(T_base_world @ T))
        return Frame(name, link, frozen(T))

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
