"""How far the tip is off over the workspace: the nominal arm, and what is left after calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.estimation.start import kabsch
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.pipeline import FittedCalibration

# Enough for a map of 20 x 20 cells; drawing more takes longer and shows the same.
_SAMPLES = 1500


@dataclass(frozen=True, eq=False)
class Workspace:
    """Tip errors at joint values drawn at random within the joints' limits.

    Attributes:
        tip: (M, 3) of the calibrated arm in the base link's frame. [m]
        before: (M,) distance of the nominal arm's tip, after the best rigid alignment at the base. [m]
        after: (M,) predicted standard deviation of the calibrated tip's place, aligned likewise. [m]
    """

    tip: Floats
    before: Floats
    after: Floats

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest error before and after. [m]."""
        both = np.concatenate([self.before, self.after])
        return float(both.min()), float(both.max())


def sample_workspace(calibration: FittedCalibration) -> Workspace:
    """Sample the workspace with the calibration's own seed."""
    chain = calibration.chain
    q = chain.random_values(_SAMPLES, np.random.default_rng(calibration.seed))
    tip = tip_poses(chain, q, calibration.placements)[:, :3, 3]
    nominal = tip_poses(chain, q)[:, :3, 3]
    T = kabsch(nominal, tip)
    before = np.linalg.norm(nominal @ T[:3, :3].T + T[:3, 3] - tip, axis=1)
    return Workspace(frozen(tip), frozen(before), frozen(calibration.tip_sigma(q)))
