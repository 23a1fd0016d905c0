"""Everything that report and recording show, worked out once for both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from urdfcal.output.findings import Document, Verdict, judge
from urdfcal.output.scene import Scene, lay_out
from urdfcal.output.workspace import Workspace, survey

if TYPE_CHECKING:
    from urdfcal.pipeline import FittedCalibration


@dataclass(frozen=True, eq=False)
class Overview:
    """A calibration, and what there is to say and to see of it.

    Attributes:
        calibration: the result.
        document: what ``calibration.json`` holds.
        verdict: whether to trust it.
        scene: where everything stands.
        workspace: tip errors over the workspace.
    """

    calibration: FittedCalibration
    document: Document
    verdict: Verdict
    scene: Scene
    workspace: Workspace

    @classmethod
    def of(cls, calibration: FittedCalibration) -> Overview:
        """Work it out."""
        document = calibration.to_dict()
        return cls(calibration, document, judge(calibration, document), lay_out(calibration), survey(calibration))
