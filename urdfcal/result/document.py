"""The keys of calibration.json, checked strictly before anything is made of them."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from urdfcal.errors import OutputError
from urdfcal.robot.tree_dh import MOUNT

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


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Transform = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
Plain = dict[str, Any]


class _Keys(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class MimicKeys(_Keys):
    """The joint that another one follows."""

    joint: str
    multiplier: float
    offset: float


class JointKeys(_Keys):
    """A joint as drawn and as built, in the frame of the joint it hangs on, or of the base link."""

    parent: str | None
    type: Literal["revolute", "continuous", "prismatic"]
    axis: Vector
    lower: float | None
    upper: float | None
    mimic: MimicKeys | None
    drawn: Transform
    built: Transform


class TipKeys(_Keys):
    """A link that carries something, in the frame of the last joint before it."""

    joint: str | None
    T_joint_link: Transform


class RobotKeys(_Keys):
    """The joints that were calibrated."""

    name: str
    urdf: str
    base_link: str
    tip_link: str
    joints: Annotated[dict[str, JointKeys], Field(min_length=1)]
    tips: Annotated[dict[str, TipKeys], Field(min_length=1)]

    @model_validator(mode="after")
    def _hang_together(self) -> RobotKeys:
        before: set[str | None] = {None}
        for name, joint in self.joints.items():
            if joint.parent not in before:
                raise ValueError(f"joint {name!r} hangs on {joint.parent!r}, which does not come before it")
            before.add(name)
            if joint.mimic is not None and joint.mimic.joint not in self.joints:
                raise ValueError(f"joint {name!r} follows {joint.mimic.joint!r}, which is not there")
        for link, tip in self.tips.items():
            if tip.joint not in before:
                raise ValueError(f"link {link!r} hangs on {tip.joint!r}, which is not there")
        if next(iter(self.tips)) != self.tip_link:
            raise ValueError(f"tip_link is {self.tip_link!r}, but the first of the tips another")
        if len(self.tips) == 1 and [joint.parent for joint in self.joints.values()] != [None, *self.joints][:-1]:
            raise ValueError("to a single tip its joints are no chain")
        return self


class RowKeys(_Keys):
    """One parameter of one joint."""

    joint: str
    parameter: str
    unit: Literal["m", "rad"]
    nominal: float
    offset: float
    sigma: float | None = None
    status: Literal["estimated", "fixed"]
    reason: str | None = None


class OriginKeys(_Keys):
    """An origin as the corrected URDF has it."""

    xyz: Vector
    rpy: Vector


class LedKeys(_Keys):
    """Where an LED is on its link, or in the world."""

    link: str
    position: Vector
    sigma: list[float | None]


class ClockKeys(_Keys):
    """The time offset of a camera's clock, in s; sigma null where it was held."""

    value: float
    sigma: float | None


class CameraKeys(_Keys):
    """A camera as it was used or found: standing in the world, or riding on a link."""

    intrinsics: Row
    distortion_model: str
    distortion: list[float]
    link: str
    T_cam_world: Transform | None = None
    T_link_camera: Transform | None = None
    sigma: dict[Literal["intrinsics", "distortion", "T_cam_world", "T_link_camera"], list[float | None]]
    time_offset: ClockKeys | None = None

    @model_validator(mode="after")
    def _somewhere(self) -> CameraKeys:
        if (self.T_cam_world is None) == (self.T_link_camera is None):
            raise ValueError("one of T_cam_world and T_link_camera is needed")
        return self


class CalibrationKeys(_Keys):
    """The whole file; what only people read is any plain data."""

    format: str
    robot: RobotKeys
    dh: list[RowKeys]
    placements: dict[str, OriginKeys]
    T_world_base: Transform
    T_world_base_sigma: list[float | None]  # of a small motion x y z rx ry rz after it; m, rad
    leds: dict[str, LedKeys]
    cameras: dict[str, CameraKeys]
    fit: Plain
    validation: Plain
    models: list[Plain]
    identifiability: Plain
    solutions: list[Plain]
    outliers: list[Plain]
    warnings: list[str]
    provenance: Plain

    @model_validator(mode="after")
    def _rows_of_joints(self) -> CalibrationKeys:
        for row in self.dh:
            if row.joint.removesuffix(MOUNT) not in self.robot.joints:
                raise ValueError(f"dh names joint {row.joint!r}, which the robot has not")
        return self


def check(text: str, where: str, file_format: str) -> Plain:
    """Parse calibration.json and check every key.

    Raises:
        OutputError: it is no JSON, of another format, or a key is missing, unknown or makes no sense.
    """
    try:
        document = json.loads(text, parse_constant=_no_number)
    except ValueError as error:
        raise OutputError(f"it is no JSON: {error}", where=where, remedy="Calibrate again.") from error
    found = document.get("format") if isinstance(document, dict) else None
    if found != file_format:
        raise OutputError(
            f"its format is {found!r}, not {file_format!r}",
            where=where,
            remedy="Read it with the urdfcal that wrote it, or calibrate again.",
        )
    try:
        CalibrationKeys.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        what = first["msg"].removeprefix("Value error, ")
        raise OutputError(
            f"{what[:1].lower()}{what[1:]}", where=f"{where}, {place}" if place else where, remedy="Calibrate again."
        ) from error
    checked: Plain = document
    return checked


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is no number")
