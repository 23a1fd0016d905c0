"""How far the tip is off over the workspace, and how far joint models move it there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.estimation.alignment import kabsch
from urdfcal.robot.kinematics import link_poses

if TYPE_CHECKING:
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.mechanism import Tip

# Enough for a map of 20 x 20 cells; drawing more takes longer and shows the same.
_SAMPLES = 1500
# Scales are logarithmic: what is below a hundredth of the largest counts as that. An arm that lags or has play alone
# is moved by nothing at rest. [share, m]
_LEAST, _NOTHING = 1e-2, 1e-9
MOVED = "joint models"
"""Name of what joint models move the tip by, beside the errors of the nominal and of the calibrated arm."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """Tip errors at joint values drawn at random within the joints' limits.

    Attributes:
        link: whose place it is.
        tip: (M, 3) of the calibrated arm, as its joint models have it, in the base link's frame. [m]
        before: (M,) distance of the nominal arm's tip, after the best rigid alignment at the base. [m]
        after: (M,) predicted standard deviation of the calibrated tip's place, aligned likewise. [m]
        measured: (M,) whether the joint values lie in the measured domain.
        moved: (M,) distance that joint models move the tip by, at rest: how far it sags, say; None of an arm without
            any that do, and where they follow from torques that were measured, and were not here. [m]
    """

    link: str
    tip: Floats
    before: Floats
    after: Floats
    measured: Bools
    moved: Floats | None = None

    @property
    def errors(self) -> dict[str, Floats]:
        """(M,) of the nominal and of the calibrated arm, and what joint models move. [m]."""
        return {
            "nominal": self.before,
            "calibrated": self.after,
            **({} if self.moved is None else {MOVED: self.moved}),
        }

    @property
    def range(self) -> tuple[float, float]:
        """The smallest and the largest of :attr:`errors`. [m]."""
        every = np.concatenate(list(self.errors.values()))
        return float(every.min()), float(every.max())


def sample_workspace(calibration: FittedCalibration, tip: Tip | None = None) -> Workspace:
    """Sample the workspace of the tip, or of another link, with the calibration's own seed."""
    chain, models = calibration.chain, calibration.joint_models
    of = tip or chain.tips[0]
    q = chain.random_values(_SAMPLES, np.random.default_rng(calibration.seed))
    (calibrated,), (nominal,) = (
        [T[:, :3, 3] for T in link_poses(chain, q, [of], placements)] for placements in (calibration.placements, None)
    )
    moved = None
    if models.found and not models.needs_torques:
        mechanism = calibration.mechanism
        (T_base_tip,) = link_poses(mechanism, calibration.joint_values(chain.readings(q)), [mechanism.tip(of.link)])
        rigid, calibrated = calibrated, T_base_tip[:, :3, 3]
        off = np.linalg.norm(calibrated - rigid, axis=1)
        moved = frozen(np.maximum(off, _LEAST * off.max())) if off.max() > _NOTHING else None
    T = kabsch(nominal, calibrated)
    before = np.linalg.norm(nominal @ T[:3, :3].T + T[:3, 3] - calibrated, axis=1)
    measured = calibration.in_domain(chain.readings(q))
    after = calibration.tip_sigma(q, of)
    return Workspace(of.link, frozen(calibrated), frozen(before), frozen(after), measured, moved)
