"""What report, recording and command line say of a calibration: its assessment, the one number, and the data behind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from urdfcal.output.fitted import far_corrections
from urdfcal.output.scene import CalibrationScene, Workspace, build_scene, sample_workspace

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.pipeline import FittedCalibration

Level: TypeAlias = Literal["good", "doubtful", "bad"]
ResultData: TypeAlias = "Mapping[str, Any]"
"""What is in ``calibration.json``."""

# Noise declared three times too small is a mistake in the session or an effect that the model does not have;
# either way the standard deviations mean nothing.
_MISFIT_BAD, _MISFIT_DOUBTFUL = 9.0, 2.0
# The arm bends to explain what it is not to blame for: corrections many tolerances long that still leave a misfit.
_FAR = 5.0
HEADLINE = "rms error on held-out poses"
"""What the one number means that says what a calibration is worth."""


@dataclass(frozen=True)
class Judgement:
    """Whether to trust a calibration.

    Attributes:
        level: good, doubtful or bad.
        sentence: one sentence that says so, without numbers and reasons.
        failures: why it should not be used, the gravest first.
        warnings: what to check first.
    """

    level: Level
    sentence: str
    failures: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """All that speaks against it, the gravest first."""
        return (*self.failures, *self.warnings)


@dataclass(frozen=True, eq=False)
class Overview:
    """A calibration and everything that report and recording show of it, worked out once for both.

    Attributes:
        calibration: the result.
        document: what ``calibration.json`` holds.
        verdict: whether to trust it.
        scene: where everything is.
        workspace: tip errors over the workspace.
    """

    calibration: FittedCalibration
    document: ResultData
    verdict: Judgement
    scene: CalibrationScene
    workspace: Workspace

    @classmethod
    def of(cls, calibration: FittedCalibration) -> Overview:
        """Work it out."""
        document = calibration.to_dict()
        return cls(
            calibration,
            document,
            verdict(calibration, document),
            build_scene(calibration),
            sample_workspace(calibration),
        )


def verdict(calibration: FittedCalibration, document: ResultData | None = None) -> Judgement:
    """Judge a calibration by its own evidence.

    Bad: the calibration's own failures, no better than the nominal arm on held-out poses, residuals of more than three
    times the declared noise, or corrections of many tolerances that still leave a misfit. Doubtful: any warning.

    Args:
        calibration: the result.
        document: ``calibration.to_dict()``, if it is there already.
    """
    document = document or calibration.to_dict()
    fit, validation = document["fit"], document["validation"]
    misfit = float(np.sqrt(fit["reduced_chi2"]))
    failures = list(calibration.failures)
    if not failures and validation["rms_mm"] >= validation["rms_nominal_mm"]:
        failures.append(f"it is no better than the nominal arm: {headline(document)} {HEADLINE}")
    if not failures and fit["reduced_chi2"] > _MISFIT_BAD:
        failures.append(f"the residuals are {misfit:.1f} times the declared noise: the model does not explain them")
    if not failures and fit["reduced_chi2"] > _MISFIT_DOUBTFUL and (far := far_corrections(calibration, _FAR)):
        failures.append(
            f"{far} of the corrections are more than {_FAR:g} times their tolerance, and still the residuals are "
            f"{misfit:.1f} times the declared noise: the corrections explain an effect that is not the arm's"
        )
    warnings = tuple(calibration.warnings)
    if failures:
        return Judgement("bad", "Do not use it.", tuple(failures), warnings)
    if warnings:
        counted = "a warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
        return Judgement("doubtful", f"Better than the nominal arm, with {counted} to check first.", (), warnings)
    return Judgement("good", "Trust it: the residuals are what the declared noise explains.", (), ())


def headline(document: ResultData) -> str:
    """The rms error on held-out poses, nominal and calibrated."""
    validation = document["validation"]
    return f"{validation['rms_nominal_mm']:.3g} -> {validation['rms_mm']:.3g} mm"


def look_up(document: ResultData, key: str | Sequence[str]) -> Any:
    """The value at a key such as ``fit.rms_px`` or ``dh.3.offset``, or at its parts where names have dots."""
    parts = key.split(".") if isinstance(key, str) else key
    return reduce(lambda value, part: value[int(part)] if isinstance(value, list) else value[part], parts, document)
