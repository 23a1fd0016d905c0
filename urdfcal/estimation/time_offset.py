"""Where to start with a moving arm: cameras whose clocks are off by up to a second are found by trying."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly
from urdfcal.errors import CalibrationError
from urdfcal.estimation.start import View, first_state
from urdfcal.robot.kinematics import link_poses

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

# Offsets that are tried: the solver finds its way from 0.1 s off at 0.5 rad/s (7 cm at the tip), not from 1 s.
_FARTHEST, _STEP = 1.0, 0.1
# Frames of each camera that decide: ten times what fixes its pose.
_FRAMES = 60
# An offset is believed if with it the camera sees the arm so much better: within tens of milliseconds the arm's own
# errors decide which is best, and the solver needs no help.
_BETTER = 0.5


def start_state(session: Session, table: Geometry, offsets: Floats) -> State:
    """:func:`first_state`, of an arm that moved with the cameras' clocks set as nearly as the drawn arm tells.

    Args:
        session: what was measured.
        table: the arm's parameters.
        offsets: the arm to start from, of the table's shape; zeros for the arm as drawn.

    Raises:
        CalibrationError: too few sightings to place the base or a camera.
    """
    if session.trajectory is None or session.rig is None:
        return first_state(session, table, offsets)
    clocks = np.zeros(len(session.rig.cameras))
    if session.estimate.time_offset != "fixed":
        clocks = np.array([_search(session, table, offsets, c) for c in range(len(clocks))])
    return replace(first_state(session.with_clocks(clocks), table, offsets), time_offsets=clocks)


def _search(session: Session, table: Geometry, offsets: Floats, camera: int) -> float:
    """The time offset with which one camera's sightings fit the arm best; 0 if none is much better. [s]."""
    if session.detections is None:
        return 0.0
    mine = np.unique(session.detections.pose[session.detections.camera == camera])
    if len(mine) < 3:
        return 0.0
    session = session.at(evenly(mine, _FRAMES))
    steps: Ints = np.arange(-round(_FARTHEST / _STEP), round(_FARTHEST / _STEP) + 1)
    tried = np.array(sorted(_STEP * steps, key=abs))
    misses = np.array([_miss(session, table, offsets, camera, offset) for offset in tried])
    best = int(np.argmin(misses))
    return float(tried[best]) if misses[best] < _BETTER * misses[0] else 0.0


def _miss(session: Session, table: Geometry, offsets: Floats, camera: int, time_offset: float) -> float:
    """How far (median, px) the LEDs are seen from where the arm holds them, the camera put where that is least."""
    if session.rig is None:
        return np.inf
    session = session.with_clocks(np.full(len(session.rig.cameras), time_offset))
    links = np.array(link_poses(session.chain, session.q, session.frames.tips, table.placements(offsets)))
    leds = np.array([np.zeros(3) if led.position is None else led.position for led in session.leds])
    try:
        return View(session, links).miss(camera, leds)
    except CalibrationError:  # so far off that there is no such place
        return np.inf
