"""The parts of the result document that hold the evidence on it, and what all its parts are made of."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

# Rotations are written with all their digits.
_RIGID = 1e-9


def _rigid(T: list[list[float]]) -> list[list[float]]:
    M = np.array(T)
    if (
        not np.allclose(M[:3, :3].T @ M[:3, :3], np.eye(3), rtol=0.0, atol=_RIGID)
        or np.linalg.det(M[:3, :3]) < 0.0
        or M[3].tolist() != [0.0, 0.0, 0.0, 1.0]
    ):
        raise ValueError("it is no rigid transform")
    return T


Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Interval = Annotated[list[float], Field(min_length=2, max_length=2)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Transform = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
Sigmas = list[float | None]
"""Standard deviations; None where a value is fixed."""


class Section(BaseModel):
    """Keys that are absent from the file stay absent: ``model_dump(exclude_unset=True)`` gives what was read."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class LeftOutEntry(Section):
    """The error in poses that the user left out of the calibration. [mm]."""

    poses: int
    rms_mm: float
    max_mm: float


class ValidationSection(Section):
    """Prediction errors on held-out poses, nominal and calibrated arm with the same cameras. [mm, px]."""

    folds: int
    rms_nominal_mm: float
    rms_mm: float
    interval_mm: Interval
    max_mm: float
    p95_mm: float
    rms_nominal_px: float | None = None
    rms_px: float | None = None
    left_out: LeftOutEntry | None = None


class IdentifiabilitySection(Section):
    """What the measurements identify: condition number, observability indices, unidentifiable directions."""

    condition_number: float
    O1: float
    O2: float
    O3: float
    O4: float
    O5: float
    lost: list[str]


class MorePosesEntry(Section):
    """What further poses like those measured would bring. [mm].

    ``rms_mm`` is None where the residuals exceed the noise: the model is the limit then, not the poses.
    """

    poses: int
    rms_mm: float | None


class SizeEntry(Section):
    """The part of the tip's expected error that is one factor of all lengths, and what is left without. [1, mm]."""

    sigma: float
    rms_mm: float
    rms_without_mm: float
    is_limit: bool


class TipSection(Section):
    """The error of the calibrated tip that is to be expected over the workspace, the bases aligned. [mm]."""

    rms_mm: float
    interval_mm: Interval
    more: MorePosesEntry | None = None
    size: SizeEntry | None = None


class RegionsSection(Section):
    """Prediction errors in regions left out of the estimate; the interval is that of a further region. [mm]."""

    count: int
    rms_nominal_mm: float | None
    rms_mm: float
    interval_mm: Annotated[list[float | None], Field(min_length=2, max_length=2)]


class ScaleSection(Section):
    """What 0.1 % of the length unit is at the tip, whose unit it is, and the common factor of all lengths. [mm, 1]."""

    tip_mm_per_permille: float
    factor: float
    factor_sigma: float | None
    declared_sigma: float | None = None
    unit: Literal["instrument", "distances", "nothing"] = "instrument"


class NoiseEntry(Section):
    """The standard deviation of one kind of reading; found to that share of itself.

    ``apart``: how surely the residuals contradict what is declared, in standard deviations; None where nothing is.
    """

    unit: str
    declared: float | None
    found: float
    relative_sigma: float
    apart: float | None = None


class FindingEntry(Section):
    """An effect or event that explains a share of the squared residuals; from a pose on, or in all of them."""

    name: str
    sentence: str
    share: float
    pose: str | None
    alike: list[str]


class ContributionEntry(Section):
    """How far a joint's geometry, or a joint model of it, moves the tip over the workspace, root mean square. [mm]."""

    joint: str
    what: str
    tip_mm: float
    sigma_mm: float


class CandidateEntry(Section):
    """What a parameter that is no part of the estimate would come out as, in its SI unit."""

    value: float
    sigma: float


class JointModelTrialEntry(Section):
    """What a joint model of some joints brings, or would bring: of poses left out at random, and of regions. [mm].

    ``candidates`` are its parameters that were looked for and are no part of the estimate, by their names.
    """

    model: str
    joints: list[str]
    included: bool
    log_evidence: float
    inside_mm: float
    elsewhere_mm: float
    candidates: dict[str, CandidateEntry] = Field(default_factory=dict)


class DomainSection(Section):
    """The ranges of the joint values that were measured. [rad or m]."""

    joints: dict[str, Interval]
