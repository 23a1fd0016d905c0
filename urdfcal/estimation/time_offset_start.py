"""Start of a moving arm: time offsets of up to a second are found by trying (METHOD 10)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.errors import CalibrationError
from urdfcal.estimation.blocks.targets import point_places
from urdfcal.estimation.camera_start import Views
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS, TimeOffsets, nominal_clocks
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.start import Start, first_state, nominal_places
from urdfcal.estimation.state import State
from urdfcal.estimation.target_start import place_targets
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.session.model import Session

# Offsets that are tried: the solver finds its way from 0.1 s off at 0.5 rad/s (7 cm at the tip), not from 1 s.
_FARTHEST, _STEP = 1.0, 0.1
# Frames of each camera that decide: ten times what fixes its pose.
_FRAMES = 60
# An offset is believed if with it the camera sees the arm so much better: within tens of milliseconds the arm's own
# errors decide which is best, and the solver needs no help.
_BETTER = 0.5


def start_state(session: Session, arm: ArmParameterization, offsets: Floats) -> State:
    """:func:`first_state`; of an arm that moved with the time offsets set as nearly as the nominal arm determines them.

    Args:
        session: what was measured.
        arm: the arm's parameters.
        offsets: the arm to start from, of the arm's shape; zeros for the nominal arm.

    Raises:
        CalibrationError: too few measurements to place the base or a camera.
    """
    detections = session.find(Detections)
    if not isinstance(session.motion, Trajectory) or detections is None:
        return first_state(session, arm, offsets)
    time_offsets = nominal_clocks(session)
    if TimeOffsets.estimated(session, "none") and session.estimate.time_offset != "fixed":
        for c in range(len(session.rig.cameras)):
            time_offsets[c] = _search(session, detections, arm, offsets, c)
    return first_state(session.with_time_offsets(time_offsets), arm, offsets, {TIME_OFFSETS: time_offsets})


def _search(session: Session, detections: Detections, arm: ArmParameterization, offsets: Floats, camera: int) -> float:
    """The time offset with which one camera's detections fit the arm best; 0 if none is much better. [s]."""
    mine = np.unique(detections.pose[detections.camera == camera])
    part = session.part[mine]
    mine = mine[part == np.argmax(np.bincount(part, minlength=1))]  # between parts it moved, seen from the base
    if len(mine) < 3:
        return 0.0
    session = session.at(evenly(mine, _FRAMES))
    steps: Ints = np.arange(-round(_FARTHEST / _STEP), round(_FARTHEST / _STEP) + 1)
    tried = np.array(sorted(_STEP * steps, key=abs))
    misses = np.array([_miss(session, arm, offsets, camera, offset) for offset in tried])
    best = int(np.argmin(misses))
    return float(tried[best]) if misses[best] < _BETTER * misses[0] else 0.0


def _miss(session: Session, arm: ArmParameterization, offsets: Floats, camera: int, time_offset: float) -> float:
    """How far (median, px) the LEDs are seen from where the arm holds them, the camera put where that is least."""
    session = session.with_time_offsets(nominal_clocks(session, time_offset))
    at, detections = Start.of(session, arm, offsets), session.find(Detections)
    if detections is None:
        return np.inf
    try:
        state = place_targets(at, [detections], State(nominal_places(session)))
        return Views(at, detections, state).miss(camera, point_places(session.attachments, state))
    except CalibrationError:  # so far off that there is no such place
        return np.inf
