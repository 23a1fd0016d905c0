"""The length unit of the instrument: what it means at the tip, and what the arm itself says of it (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from urdfcal.estimation.blocks.scale import SCALE
from urdfcal.estimation.blocks.targets import print_key
from urdfcal.estimation.diagnosis.residuals import Part
from urdfcal.estimation.uncertainty import tip_change

if TYPE_CHECKING:
    from urdfcal.estimation.diagnosis.residuals import Unexplained
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution

LengthUnit: TypeAlias = Literal["instrument", "distances", "nothing"]


@dataclass(frozen=True)
class LengthScale:
    """What the unit of the instrument's lengths does.

    Attributes:
        tip_per_permille: rms displacement of the calibrated tip over the workspace if these lengths were 0.1 % longer.
            [m]
        factor: by which share the instrument's lengths are too long if the arm is as nominal as its tolerances say.
        sigma: standard deviation of that; infinite where the tolerances say nothing.
        declared: how well the scale was said to be known; None where nothing was said, and intervals do not hold it.
        unit: what the lengths are measured by: cameras or a tracker ("instrument"), known distances, or nothing.
    """

    tip_per_permille: float
    factor: float
    sigma: float
    declared: float | None = None
    unit: LengthUnit = "instrument"

    @property
    def sigmas(self) -> float:
        """How many standard deviations the factor is from none: its own, or those of what was declared."""
        return abs(self.factor) / (self.declared or self.sigma)


def find_scale(problem: Problem, fit: Solution, unexplained: Unexplained) -> LengthScale:
    """Compute what 0.1 % of scale is at the tip, and test the common factor of all lengths against the tolerances.

    Args:
        problem: what was measured.
        fit: the estimate.
        unexplained: its residuals.
    """
    # A target's print is a length unit, too.
    every = unexplained.parts[0].parameters
    printed = (key for target in problem.attachments.targets if every.has_active(key := print_key(target)))
    keys = (SCALE, *printed)
    columns = sum((unexplained.columns(partial(Part.by, key=key)) for key in keys), start=np.zeros(1))
    unit: LengthUnit = "instrument"
    if not np.any(columns):
        known = np.concatenate([np.zeros(0), *(of.by_scale for of in fit.parameters.distances)])
        columns[len(columns) - len(known) :, 0] = known  # the last of the priors
        unit = "distances" if len(known) else "nothing"
    own = next((key for key in keys if fit.parameters.has_active(key)), SCALE)
    where, active = fit.parameters.active_columns(own)
    tip = tip_change(problem, fit, unexplained.response(columns, where)) if np.any(columns) else 0.0
    if active.any():
        block = next(block for block in fit.parameters.blocks if block.key == own)
        sigma = float(np.sqrt(fit.covariance[where, where][0, 0]))
        return LengthScale(1e-3 * tip, float(fit.state[own][0]), sigma, float(block.sigma[0]), unit)
    _, size, covariance = unexplained.explained(columns)
    variance = float(covariance[0, 0])
    sigma = float(np.sqrt(variance)) if variance > 0.0 else float("inf")
    return LengthScale(1e-3 * tip, float(size[0]), sigma, 0.0 if SCALE in fit.state else None, unit)
