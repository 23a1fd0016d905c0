"""The error in poses that a session's user left out: the plainest check there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.estimation.problem import Problem
from urdfcal.session.model import MIN_POSES
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session


@dataclass(frozen=True)
class LeftOut:
    """Poses that were left out, and the estimate's error there.

    Attributes:
        poses: how many.
        rms: of the distances, for pixels across the ray; the measurements' own noise counts. [m]
        largest: of them. [m]
    """

    poses: int
    rms: float
    largest: float


def find_left_out(session: Session, problem: Problem, state: State) -> LeftOut | None:
    """Predict the poses that were left out, base, LEDs and cameras as estimated from the others.

    Args:
        session: what was measured, less what its user left out.
        problem: of its measurements.
        state: the estimate.

    Returns:
        None where next to none were left out, whole cameras or LEDs went with them, the arm moved, or something was
        bumped: where it stands in the poses that were left out is then not known.
    """
    whole = session.excluded.whole
    if whole is None or isinstance(session.motion, Trajectory) or whole.moved or whole.parts != session.parts:
        return None
    if (whole.led_names, whole.rig.names) != (session.led_names, session.rig.names):
        return None
    spared = np.flatnonzero(np.isin(whole.poses, session.excluded.poses))
    if len(spared) < MIN_POSES:
        return None
    others = Problem.of(whole.at(spared), problem.arm)
    if not {of.table.kind for of in others.observations} <= {of.table.kind for of in problem.observations}:
        return None  # points were triangulated, and the estimate has no cameras
    off = np.concatenate([others.off(of, state)[of.valid] for of in others.observations])
    return LeftOut(len(spared), rms(off), float(off.max()))
