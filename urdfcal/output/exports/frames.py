"""Frames that a calibration found: where the cameras stand, and where the LEDs sit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import OutputError

if TYPE_CHECKING:
    from urdfcal.result import Calibration

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
    """The cameras' optical frames (z forward, x right, y down) in the base link's, and the LEDs' in the tip link's.

    A camera's is named as ROS drivers do, ``<camera>_optical_frame``, an LED's as the LED; LEDs have no orientation:
    theirs is the tip link's.

    Raises:
        OutputError: a name is none for a frame, or two frames have one name.
    """
    document, chain = calibration.to_dict(), calibration.chain
    T_world_base = np.array(document["T_world_base"])
    frames = []
    for name, camera in document["cameras"].items():
        T_cam_base = np.array(camera["T_cam_world"]) @ T_world_base
        frames.append(Frame(f"{name}_optical_frame", chain.base_link, frozen(inverse(T_cam_base))))
    for name, led in document["leds"].items():
        T = np.eye(4)
        T[:3, 3] = led["position"]
        frames.append(Frame(name, chain.tip_link, frozen(T)))
    names = [frame.name for frame in frames]
    for i, name in enumerate(names):
        if not _NAME.fullmatch(name):
            raise OutputError(f"{name!r} is no name for a frame", remedy="Use letters, digits, _, - and . in names.")
        if name in names[:i]:
            raise OutputError(f"two frames would be named {name!r}", remedy="Rename the LED or the camera.")
    return tuple(frames)
