"""Where cameras, targets and the tracker were found to be, in words: all there is to say of an arm that is as drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.errors import OutputError
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.output.exports.frames import TRACKER, found_frames
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.fitted import FittedCalibration


def placed(calibration: FittedCalibration) -> list[str]:
    """Return a sentence for each frame that was found; none where something of the arm was estimated."""
    if np.isfinite(calibration.sigmas()).any():
        return []
    try:
        frames = found_frames(calibration)
    except OutputError:  # names that ROS does not take; the result has them all the same
        return []
    targets = {target.name: target.link for target in calibration.session.targets}
    sentences = []
    for frame in frames:
        sigma = np.zeros(0)
        if frame.name == TRACKER:
            sigma = _tracker_sigmas(calibration)
        elif frame.name in targets:
            sigma = calibration.sigmas_of(target_key(frame.name))
        x, y, z = frame.T_parent_frame[:3, 3]
        angles = " ".join(f"{angle:.3f}" for angle in np.degrees(matrix_to_rpy(frame.T_parent_frame[:3, :3])))
        spread = ""
        if np.isfinite(sigma).any():
            mm, degrees = 1e3 * np.nanmax(sigma[:3]), np.degrees(np.nanmax(sigma[3:]))
            spread = f" ± {mm:.2g} mm, {degrees:.2g} deg"
        sentences.append(f"{frame.name} in {frame.parent}: {x:.5f} {y:.5f} {z:.5f} m, rpy {angles} deg{spread}")
    return sentences


def _tracker_sigmas(calibration: FittedCalibration) -> Floats:
    """Standard deviations (6,) of a small motion of the world's frame in the base link, in its own axes. [m, rad]."""
    where, active = calibration.fit.parameters.active_columns(BASE)
    if not active.all():
        return np.full(6, np.nan)
    # If T_world_base moves by exp6(step) from the right, its inverse moves by exp6(-Ad step).
    adjoint = pin.SE3(calibration.estimate.T_world_base).action
    covariance = adjoint @ calibration.fit.covariance[where, where] @ adjoint.T
    return np.asarray(np.sqrt(np.diag(covariance)))
