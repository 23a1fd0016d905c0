"""What report, recording and command line say of a calibration: its assessment, the one number, and the data behind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.estimation.alignment import kabsch
from urdfcal.output.scene import CalibrationScene, build_scene
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.estimation.assessment import Assessment
    from urdfcal.result.fitted import FittedCalibration

ResultData: TypeAlias = "Mapping[str, Any]"
"""What is in ``calibration.json``."""

# Enough for a map of 20 x 20 cells; drawing more takes longer and shows the same.
_SAMPLES = 1500
HEADLINE = "rms error on held-out poses"
"""What the one number means that says what a calibration is worth."""


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
    def errors(self) -> dict[str, Floats]:
        """(M,) of the nominal and of the calibrated arm. [m]."""
        return {"nominal": self.before, "calibrated": self.after}

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


@dataclass(frozen=True, eq=False)
class Overview:
    """A calibration and everything that report and recording show of it, worked out once for both.

    Attributes:
        calibration: the result.
        document: what ``calibration.json`` holds.
        scene: where everything is.
        workspace: tip errors over the workspace.
    """

    calibration: FittedCalibration
    document: ResultData
    scene: CalibrationScene
    workspace: Workspace

    @classmethod
    def of(cls, calibration: FittedCalibration) -> Overview:
        """Work it out."""
        return cls(calibration, calibration.to_dict(), build_scene(calibration), sample_workspace(calibration))

    @property
    def assessment(self) -> Assessment:
        """Whether to trust it."""
        return self.calibration.assessment


def headline(document: ResultData) -> str:
    """The rms error on held-out poses, nominal and calibrated."""
    validation = document["validation"]
    return f"{validation['rms_nominal_mm']:.3g} -> {validation['rms_mm']:.3g} mm"


def look_up(document: ResultData, key: str | Sequence[str]) -> Any:
    """The value at a key such as ``fit.rms_px`` or ``dh.3.offset``, or at its parts where names have dots."""
    parts = key.split(".") if isinstance(key, str) else key
    return reduce(lambda value, part: value[int(part)] if isinstance(value, list) else value[part], parts, document)
