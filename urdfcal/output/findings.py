"""What report, recording and command line say of a calibration: its assessment, the one number, and the data behind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

from urdfcal.output.scene import CalibrationScene, Workspace, build_scene, sample_workspace

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.estimation.assessment import Assessment
    from urdfcal.result.fitted import FittedCalibration

ResultData: TypeAlias = "Mapping[str, Any]"
"""What is in ``calibration.json``."""

HEADLINE = "rms error on held-out poses"
"""What the one number means that says what a calibration is worth."""


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
