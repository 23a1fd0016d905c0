"""The result document: ``calibration.json`` as one typed model, read and written by the same code."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from urdfcal.errors import OutputError
from urdfcal.result.evidence_sections import (
    ContributionEntry,
    DomainSection,
    FindingEntry,
    IdentifiabilitySection,
    JointModelTrialEntry,
    NoiseEntry,
    RegionsSection,
    Row,
    ScaleSection,
    Section,
    Sigmas,
    TipSection,
    Transform,
    Triple,
    ValidationSection,
)
from urdfcal.result.joint_model_sections import JointModelEntry, LoadSection, check_joint_models
from urdfcal.robot.tree_dh import MOUNT

FORMAT, FORMAT_1 = "urdfcal/2", "urdfcal/1"
"""What is written, and what earlier versions wrote."""


class MimicEntry(Section):
    """The joint that another one follows."""

    joint: str
    multiplier: float
    offset: float


class JointEntry(Section):
    """A joint with its nominal and its calibrated placement in the frame of its parent joint, or of the base link."""

    parent: str | None
    type: Literal["revolute", "continuous", "prismatic"]
    axis: Triple
    lower: float | None
    upper: float | None
    mimic: MimicEntry | None
    nominal: Transform
    calibrated: Transform


class TipEntry(Section):
    """A link that carries something, in the frame of the last joint before it."""

    joint: str | None
    T_joint_link: Transform


class RobotSection(Section):
    """The joints that were calibrated."""

    name: str
    urdf: str
    base_link: str
    tip_link: str
    joints: Annotated[dict[str, JointEntry], Field(min_length=1)]
    tips: Annotated[dict[str, TipEntry], Field(min_length=1)]

    @model_validator(mode="after")
    def _consistent(self) -> RobotSection:
        before: set[str | None] = {None}
        for name, joint in self.joints.items():
            if joint.parent not in before:
                raise ValueError(f"the parent of joint {name!r} is {joint.parent!r}, which does not come before it")
            before.add(name)
            if joint.mimic is not None and joint.mimic.joint not in self.joints:
                raise ValueError(f"joint {name!r} follows {joint.mimic.joint!r}, which is not there")
        for link, tip in self.tips.items():
            if tip.joint not in before:
                raise ValueError(f"the joint of link {link!r} is {tip.joint!r}, which is not there")
        if next(iter(self.tips)) != self.tip_link:
            raise ValueError(f"tip_link is {self.tip_link!r}, but the first of the tips another")
        if len(self.tips) == 1 and [joint.parent for joint in self.joints.values()] != [None, *self.joints][:-1]:
            raise ValueError("the joints do not form a chain to the only tip")
        return self


class DHEntry(Section):
    """One parameter of one row; sigma where it was estimated, else the reason why not."""

    joint: str
    parameter: str
    unit: Literal["m", "rad"]
    nominal: float
    offset: float
    sigma: float | None = None
    status: Literal["estimated", "fixed"]
    reason: str | None = None


class OriginEntry(Section):
    """An origin as the corrected URDF has it."""

    xyz: Triple
    rpy: Triple


class LedEntry(Section):
    """The position of an LED on its link, or in the world."""

    link: str
    position: Triple
    sigma: Sigmas


class PlaceEntry(Section):
    """The position in the world of something that never moves; where no camera or tracker is it is the base link's."""

    position: Triple
    sigma: Sigmas


class PlaneEntry(Section):
    """A plane of points p in the world with normal.p = offset; sigma of two tilts in rad, and of the offset in m."""

    normal: Triple
    offset: float
    sigma: Sigmas


class TargetEntry(Section):
    """The pose of a target on its link, or in the world; sigma of a small motion x, y, z, rx, ry, rz of the target."""

    link: str
    T_link_target: Transform
    rpy: Triple | None = None  # absent from earlier files
    sigma: Sigmas


class TimeOffsetEntry(Section):
    """The time offset of a camera's clock, in s; sigma is None where it was fixed."""

    value: float
    sigma: float | None


class LineTimeEntry(Section):
    """How much later each row of a camera's images is taken than the one above, in s; sigma is None where given."""

    value: float
    sigma: float | None


class CameraSigmas(Section):
    """Standard deviations of what was estimated of a camera; its pose's of a small motion in its own frame."""

    intrinsics: Sigmas = Field(default_factory=list)
    distortion: Sigmas = Field(default_factory=list)
    T_cam_world: Sigmas = Field(default_factory=list)
    T_link_camera: Sigmas = Field(default_factory=list)


class CameraEntry(Section):
    """A camera: its lens, and its pose in the world or on its link; resolution is None in files of version 0.1."""

    intrinsics: Row
    distortion_model: str
    distortion: list[float]
    link: str
    T_cam_world: Transform | None = None
    T_link_camera: Transform | None = None
    sigma: CameraSigmas
    time_offset: TimeOffsetEntry | None = None
    resolution: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    line_time: LineTimeEntry | None = None

    @model_validator(mode="after")
    def _has_a_pose(self) -> CameraEntry:
        if (self.T_cam_world is None) == (self.T_link_camera is None):
            raise ValueError("one of T_cam_world and T_link_camera is needed")
        return self


class ParameterEntry(Section):
    """A coordinate of an unknown that has no section of its own."""

    name: str
    unit: str
    nominal: float | None = None
    offset: float
    sigma: float | None


class ResidualEntry(Section):
    """The rms residual of one kind of measurement, outliers left out, nominal and calibrated, in its own unit."""

    kind: str
    unit: str
    rms_nominal: float
    rms: float


class FitSection(Section):
    """Numbers of the fit; residuals of the measurements that are no outliers, nominal and calibrated. [px, mm]."""

    poses: int
    observations: int
    parameters: int
    rank: int
    iterations: int
    converged: bool
    reduced_chi2: float | None
    rms_nominal_px: float | None = None
    rms_nominal_mm: float | None = None
    rms_px: float | None = None
    rms_mm: float | None = None
    residuals: list[ResidualEntry] = Field(default_factory=list)


class SessionEntry(Section):
    """One of several sessions, or what was measured between two moves of the base: its base, and what it rests on."""

    T_world_base: Transform
    T_world_base_sigma: Sigmas
    poses: int
    leds: list[str]
    cameras: list[str]
    residuals: list[ResidualEntry]


class VerdictSection(Section):
    """Whether to trust the calibration, and what speaks against it, the gravest first."""

    level: Literal["good", "doubtful", "bad"]
    sentence: str
    reasons: list[str]


class ModelEntry(Section):
    """One of the models that were compared; without a held-out loss where it could not be the best.

    The loss is of poses left out at random, or of regions left out where the residuals are more than noise.
    """

    model: str
    parameters: int
    seen_loss: float
    held_out_loss: float | None
    chosen: bool


class SolutionEntry(Section):
    """A minimum that another start led to; without a cost where there was no start."""

    cost: float | None
    kept: bool
    reason: str


class OutlierEntry(Section):
    """A measurement taken out of the fit; residual in px, or in mm without a camera."""

    pose: str
    camera: str | None
    led: str
    residual: float
    sigmas: float


class ProvenanceSection(Section):
    """Versions, random seed, hashes of the input files, and by name what of them was left out, if anything."""

    urdfcal: str
    pinocchio: str
    seed: int
    sha256: dict[str, str]
    excluded: dict[Literal["poses", "cameras", "leds"], list[str]] = Field(default_factory=dict)


class ResultDocument(Section):
    """Everything a calibration says: the contract of ``calibration.json``.

    Lengths in m, angles in rad. ``T_world_base_sigma`` are standard deviations of a small motion x, y, z, rx, ry, rz
    after ``T_world_base``. Of several ``sessions`` it is the first one's; ``T_cam_world`` is in the camera's own world.
    ``warnings`` are those of the verdict's reasons that are no failures.
    """

    format: Literal["urdfcal/2"]
    robot: RobotSection
    about: dict[str, str] = Field(default_factory=dict)
    dh: list[DHEntry]
    placements: dict[str, OriginEntry]
    T_world_base: Transform
    T_world_base_sigma: Sigmas
    sessions: dict[str, SessionEntry] = Field(default_factory=dict)
    leds: dict[str, LedEntry]
    targets: dict[str, TargetEntry] = Field(default_factory=dict)
    cameras: dict[str, CameraEntry]
    places: dict[str, PlaceEntry] = Field(default_factory=dict)
    planes: dict[str, PlaneEntry] = Field(default_factory=dict)
    parameters: list[ParameterEntry] = Field(default_factory=list)
    fit: FitSection
    verdict: VerdictSection
    validation: ValidationSection
    tip: TipSection | None = None
    regions: RegionsSection | None = None
    scale: ScaleSection | None = None
    noise: dict[str, NoiseEntry] = Field(default_factory=dict)
    findings: list[FindingEntry] = Field(default_factory=list)
    joint_models: dict[str, dict[str, JointModelEntry]] = Field(default_factory=dict)
    load: LoadSection | None = None
    joint_model_trials: list[JointModelTrialEntry] = Field(default_factory=list)
    contributions: list[ContributionEntry] = Field(default_factory=list)
    domain: DomainSection | None = None
    models: list[ModelEntry]
    identifiability: IdentifiabilitySection
    solutions: list[SolutionEntry]
    outliers: list[OutlierEntry]
    warnings: list[str]
    provenance: ProvenanceSection

    @model_validator(mode="after")
    def _rows_of_joints(self) -> ResultDocument:
        for row in self.dh:
            if row.joint.removesuffix(MOUNT) not in self.robot.joints:
                raise ValueError(f"dh names joint {row.joint!r}, which the robot has not")
        check_joint_models(self.joint_models, self.load, self.robot.joints)
        return self

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as JSON has it."""
        return self.model_dump(exclude_unset=True)

    def to_json(self) -> str:
        """Return the text of the file; numbers read back exactly."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def read_document(text: str, where: str) -> ResultDocument:
    """Parse ``calibration.json`` and check every key; files of format ``urdfcal/1`` are converted.

    Args:
        text: of the file.
        where: its path, for messages.

    Raises:
        OutputError: it is no JSON, of another format, or a key is missing, unknown or makes no sense.
    """
    try:
        data = json.loads(text, parse_constant=_no_number)
    except ValueError as error:
        raise OutputError(f"it is no JSON: {error}", where=where, remedy="Calibrate again.") from error
    found = data.get("format") if isinstance(data, dict) else None
    if found not in (FORMAT, FORMAT_1):
        raise OutputError(
            f"its format is {found!r}, not {FORMAT!r}",
            where=where,
            remedy="Read it with the urdfcal that wrote it, or calibrate again.",
        )
    try:
        return ResultDocument.model_validate(_from_format_1(data) if found == FORMAT_1 else data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        what = first["msg"].removeprefix("Value error, ")
        raise OutputError(
            f"{what[:1].lower()}{what[1:]}", where=f"{where}, {place}" if place else where, remedy="Calibrate again."
        ) from error


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _from_format_1(data: dict[str, Any]) -> dict[str, Any]:
    """Convert plain data of format ``urdfcal/1`` to ``urdfcal/2``; what is malformed stays so, for the reader to name.

    Placements ``drawn`` and ``built`` become ``nominal`` and ``calibrated``. There was no verdict: failures and
    warnings stood in one list, so that a result is called doubtful where it has any.
    """
    robot, warnings = data.get("robot"), data.get("warnings")
    joints = robot.get("joints") if isinstance(robot, dict) else None
    if isinstance(robot, dict) and isinstance(joints, dict):
        data = {**data, "robot": {**robot, "joints": {name: _renamed(joint) for name, joint in joints.items()}}}
    verdict = {
        "level": "doubtful" if warnings else "good",
        "sentence": "Check the warnings first." if warnings else "There are no warnings.",
        "reasons": warnings,
    }
    return {**data, "verdict": verdict, "format": FORMAT}


def _renamed(joint: Any) -> Any:
    names = {"drawn": "nominal", "built": "calibrated"}
    return {names.get(key, key): value for key, value in joint.items()} if isinstance(joint, dict) else joint
