"""Time offsets: the clocks of the cameras that film a moving arm differ from the robot's."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.joint_models.base import JointModel
from urdfcal.estimation.state import Key
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models.base import Readings
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Positions

TIME_OFFSETS: Key[Floats] = Key("time_offset")
"""(C,) of the cameras' clocks, t_robot = t_camera + offset; where a shutter rolls (2 C,), followed by the line times,
t_robot = t_camera + offset + line time x (row - the middle one); zeros where the arm stood still. [s]"""

CLOCK = 1.0
"""Standard deviation of a camera's time offset: driver and transport delay a frame by 10 to 100 ms, clocks that are set
by hand or seldom differ by a second; a moving arm determines it to a fraction of a millisecond whatever it is. [s]"""


class TimeOffsets(JointModel):
    """The joints have run on by the time that a camera's clock differs from the robot's."""

    name: ClassVar[str] = "time_offset"
    needs: ClassVar[str] = "an arm that moved while it was filmed"
    order: ClassVar[int] = 2
    own_section: ClassVar[bool] = True

    @classmethod
    def of(cls, session: Positions) -> Self | None:
        """Take one offset of each camera, where the arm moved."""
        if not isinstance(session.motion, Trajectory):
            return None
        names, fixed = [f"{name}.time_offset" for name in session.rig.names], dict[int, str]()
        nominal, sigma = nominal_clocks(session), [CLOCK] * len(names)
        if session.estimate.time_offset == "fixed":
            fixed = dict.fromkeys(range(len(names)), "as the session says")
        if len(nominal) > len(names):
            for camera in session.rig.cameras:
                if not camera.line_time_sigma:
                    fixed[len(names)] = "its shutter is known"
                names.append(f"{camera.name}.line_time")
                sigma.append(camera.line_time_sigma or np.inf)
        return cls(
            key=TIME_OFFSETS,
            names=tuple(names),
            units=("s",) * len(session.rig.cameras) + ("s/row",) * (len(names) - len(session.rig.cameras)),
            nominal=nominal,
            sigma=np.array(sigma),
            fixed=fixed,
            phrase="",
        )

    @classmethod
    def enabled(cls, session: Positions, geometry: str) -> bool:
        """Return whether the session leaves the time offsets free."""
        del geometry
        return session.estimate.time_offset != "fixed" or any(camera.rolling for camera in session.rig.cameras)

    def values(self, readings: Readings, p: Floats) -> Floats:
        """Return how far the joints move between the frame's time on the two clocks."""
        return readings.motion.joint_values(readings.q, p) - readings.q

    def jacobian(self, readings: Readings, p: Floats) -> Floats:
        """Return the joints' velocities, for the camera that took the frame."""
        motion = readings.motion
        J = np.zeros((*readings.q.shape, len(p)))
        if isinstance(motion, Trajectory):
            each = np.arange(len(motion.camera))
            J[each, :, motion.camera], by_line = motion.velocities(p)
            if len(p) > len(motion.frames):
                J[each, :, len(motion.frames) + motion.camera] = by_line
        return J

    def unidentifiable(self, index: int, partners: Sequence[int]) -> str | None:
        """A camera in whose frames the arm stands still does not determine its time offset, nor its line time."""
        if partners:
            return None
        return f"{self.label(index)} is unidentifiable: the arm does not move in that camera's frames"


def nominal_clocks(session: Positions, offset: float = 0.0) -> Floats:
    """Return what :data:`TIME_OFFSETS` is before it is estimated, all cameras' clocks being off by ``offset`` in s."""
    offsets = np.full(len(session.rig.cameras), offset)
    if not any(camera.rolling for camera in session.rig.cameras):
        return offsets
    return np.concatenate([offsets, [camera.line_time for camera in session.rig.cameras]])


def time_offsets(state: State) -> Floats:
    """Return the time offsets (C,) of a state; none where the arm stood still. [s]."""
    return state[TIME_OFFSETS] if TIME_OFFSETS in state else np.zeros(0)
