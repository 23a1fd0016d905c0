"""Whether to trust a calibration: a verdict, and the one number behind it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from urdfcal.estimation.blocks.arm import ArmBlock

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.pipeline import FittedCalibration

Level: TypeAlias = Literal["good", "doubtful", "bad"]
Document: TypeAlias = "Mapping[str, Any]"
"""What is in ``calibration.json``."""

# Noise declared three times too small is a mistake in the session or an effect that the model does not have;
# either way the standard deviations mean nothing.
_MISFIT_BAD, _MISFIT_DOUBTFUL = 9.0, 2.0
# The arm bends to explain what it is not to blame for: corrections many tolerances long that still leave a misfit.
_FAR = 5.0


@dataclass(frozen=True)
class Headline:
    """The number that says what the calibration is worth, and where it stands in ``calibration.json``.

    Attributes:
        before: key of the arm as drawn's figure.
        after: key of the calibrated arm's.
        unit: of both.
        meaning: what they are.
        interval: key of the 95 % interval of ``after``, where there is one.
    """

    before: str
    after: str
    unit: str
    meaning: str
    interval: str | None = None

    @classmethod
    def of(cls, document: Document) -> Headline:
        """The figure on held-out poses."""
        interval = "validation.interval_mm" if "interval_mm" in document["validation"] else None
        meaning = "rms error on held-out poses"
        return cls("validation.rms_nominal_mm", "validation.rms_mm", "mm", meaning, interval)

    def text(self, document: Document) -> str:
        """Both figures in a line."""
        return f"{look_up(document, self.before):.3g} -> {look_up(document, self.after):.3g} {self.unit}"


@dataclass(frozen=True)
class Verdict:
    """Whether to trust a calibration.

    Attributes:
        level: good, doubtful or bad.
        sentence: one sentence that says so, without the number.
        headline: the number.
        reasons: what speaks against it, the gravest first; empty when good.
    """

    level: Level
    sentence: str
    headline: Headline
    reasons: tuple[str, ...]


def judge(calibration: FittedCalibration, document: Document) -> Verdict:
    """Judge a calibration by its own evidence.

    Bad: the calibration's own failures, no better than the arm as drawn on held-out poses, residuals of more than three
    times the declared noise, or corrections of many tolerances that still leave a misfit. Doubtful: any warning.
    """
    headline, fit = Headline.of(document), document["fit"]
    before, after = look_up(document, headline.before), look_up(document, headline.after)
    misfit = float(np.sqrt(fit["reduced_chi2"]))
    bad = list(calibration.failures)
    if not bad and after >= before:
        bad.append(f"it is no better than the arm as drawn: {headline.text(document)} {headline.meaning}")
    if not bad and fit["reduced_chi2"] > _MISFIT_BAD:
        bad.append(f"the residuals are {misfit:.1f} times the declared noise: the model does not explain them")
    if not bad and fit["reduced_chi2"] > _MISFIT_DOUBTFUL and (far := _far(calibration)):
        bad.append(
            f"{far} of the corrections more than {_FAR:g} times their tolerance, and still the residuals are "
            f"{misfit:.1f} times the declared noise: the arm is bent to explain what is not its fault"
        )
    if bad:
        # What comes after the colon is the remedy; the first sentence only says what is wrong.
        return Verdict(
            "bad", f"Do not use it: {bad[0].split(':')[0].split(';')[0]}.", headline, (*bad, *calibration.warnings)
        )
    warnings = calibration.warnings
    if warnings:
        counted = "a warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
        return Verdict("doubtful", f"Better than as drawn, with {counted} to check first.", headline, tuple(warnings))
    return Verdict("good", "Trust it: the residuals are what the declared noise explains.", headline, ())


def look_up(document: Document, key: str | Sequence[str]) -> Any:
    """The value at a key such as ``fit.rms_px`` or ``dh.3.offset``, or at its parts where names have dots."""
    parts = key.split(".") if isinstance(key, str) else key
    return reduce(lambda value, part: value[int(part)] if isinstance(value, list) else value[part], parts, document)


def _far(calibration: FittedCalibration) -> int:
    """How many parameters are corrected by more than ``_FAR`` tolerances; joints' zeros may be anywhere."""
    fit, count = calibration.fit, 0
    for block in fit.parameters.blocks:
        if isinstance(block, ArmBlock):
            offsets, _ = block.local(fit.state[block.key])
            zeros = np.array([row in block.arm.zeros for row in block.rows])
            count += int(np.count_nonzero(block.active & ~zeros & (np.abs(offsets) > _FAR * block.sigma)))
    return count
