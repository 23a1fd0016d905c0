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


def claims(document: ResultData) -> tuple[str, ...]:
    """What error of the tip is claimed, and what that is conditional on; nothing in files that do not say it."""
    if "tip" not in document:
        return ()
    tip, regions, scale = document["tip"], document["regions"], document["scale"]
    low, high = tip["interval_mm"]
    expected = (
        f"tip {tip['rms_mm']:.2g} mm rms expected over the workspace (95 %: {low:.2g} to {high:.2g}), "
        f"{regions['rms_mm']:.2g} mm found in regions left out"
    )
    permille = scale["tip_mm_per_permille"]
    if not permille:
        return (
            expected,
            "lengths are those of the nominal arm within its tolerances: nothing measured has one",
        )
    factor = ""
    if scale["factor_sigma"] is not None:
        factor = f"; all lengths come out {1e2 * scale['factor']:+.2g} +- {1e2 * scale['factor_sigma']:.1g} %"
    if (declared := scale["declared_sigma"]) is not None:
        known = f"the scale is known to {1e2 * declared:.2g} %, which is in the interval"
        return expected, f"{known}: 0.1 % of it is {permille:.2g} mm at the tip{factor}"
    if scale.get("unit") == "distances":
        return expected, f"if the known distances are right: 0.1 % of them is {permille:.2g} mm at the tip{factor}"
    return expected, f"if the scale is right: 0.1 % of it is {permille:.2g} mm at the tip{factor}"


def look_up(document: ResultData, key: str | Sequence[str]) -> Any:
    """The value at a key such as ``fit.rms_px`` or ``dh.3.offset``, or at its parts where names have dots."""
    parts = key.split(".") if isinstance(key, str) else key
    return reduce(lambda value, part: value[int(part)] if isinstance(value, list) else value[part], parts, document)
