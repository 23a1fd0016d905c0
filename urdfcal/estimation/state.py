"""Everything an estimate moves, as one immutable value."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen

if TYPE_CHECKING:
    from urdfcal.cameras.camera import Camera


@dataclass(frozen=True, eq=False)
class State:
    """One hypothesis about the robot, the LEDs and the cameras.

    Attributes:
        offsets: (rows, 5) added to the DH rows, columns as ``dh.PARAMETERS``. [rad, m]
        T_world_base: (4, 4) the base link in the world. [m]
        leds: (L, 3) LED positions, each in the frame of what it is fastened to. [m]
        cameras: lenses, in the rig's order.
        T_cam_world: (C, 4, 4) in each camera the frame that it is fixed in: the world, or the link it rides on. [m]
        time_offsets: (C,) of the cameras' clocks, t_robot = t_camera + offset; empty where the arm stood still. [s]
    """

    offsets: Floats
    T_world_base: Floats
    leds: Floats
    cameras: tuple[Camera, ...] = ()
    T_cam_world: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    time_offsets: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, entry.name, frozen(value))

    @property
    def without_cameras(self) -> State:
        """The same where points in space are estimated from, and cameras have no part."""
        return replace(self, cameras=(), T_cam_world=np.zeros((0, 4, 4)))
