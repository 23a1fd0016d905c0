"""What is declared of a robot and its measurements: LEDs, noise, tolerances, and what is to be estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import numpy as np

from urdfcal.arrays import Bools, Floats, ReadOnly, finite_array, finite_number, keep
from urdfcal.errors import SessionError
from urdfcal.names import check_known
from urdfcal.robot.dh import PARAMETERS

if TYPE_CHECKING:
    from urdfcal.session.measurements import Measurements
    from urdfcal.session.model import Positions, Session

ArmGeometry: TypeAlias = Literal["dh", "offsets", "full", "none"]
Freedom: TypeAlias = Literal["fixed", "refine", "free"]
TimeOffset: TypeAlias = Literal["free", "fixed"]
JointError: TypeAlias = Literal["compliance", "eccentricity", "backlash", "lag", "gain", "gravity_backlash", "bending"]
ErrorSizes: TypeAlias = Mapping[JointError, float | Mapping[str, float] | Literal["default"]]
"""Sizes of what is wrong with the joints of a simulated robot: of all, of each by name, or realistic ones."""

AUTO: Literal["auto"] = "auto"
JointModelSaid: TypeAlias = bool | Literal["auto"] | Mapping[str, bool | Literal["auto"]]
"""Whether a joint model is estimated, or the measurements decide: of all joints, or of each by name."""


@dataclass(frozen=True, eq=False)
class Led:
    """A light on a link of the robot, or one that stands still.

    Attributes:
        name: in the tables.
        position: (3,) in its link's frame, None where unknown. [m]
        sigma: how well the position is known, one standard deviation: 0 exactly, None not said. [m]
        link: what it is fastened to; "world" for nothing of the robot, None for the tip link.
    """

    name: str
    position: Floats | None = None
    sigma: float | None = None
    link: str | None = None

    def __post_init__(self) -> None:
        where = f"LED {self.name!r}"
        keep(self, name=str(self.name))
        if self.position is not None:
            keep(self, position=finite_array(self.position, (3,), "position", where))
        if self.sigma is not None:
            if self.position is None:
                raise SessionError("sigma is given without a position", where=where)
            keep(self, sigma=finite_number(self.sigma, "sigma", where, zero=True))


@dataclass(frozen=True)
class LedDistance:
    """The measured distance of two LEDs, as on an LED bar.

    Attributes:
        leds: the two.
        distance: between them. [m]
        sigma: how well it is known, one standard deviation. [m]
    """

    leds: tuple[str, str]
    distance: float
    sigma: float

    def __post_init__(self) -> None:
        _check_distance(self, "LED", self.leds)

    @property
    def between(self) -> tuple[str, str]:
        """The names of its ends."""
        return self.leds


@dataclass(frozen=True)
class PlaceDistance:
    """The known distance of two places, as of sockets in one plate.

    Attributes:
        places: the two.
        distance: between them. [m]
        sigma: how well it is known, one standard deviation. [m]
    """

    places: tuple[str, str]
    distance: float
    sigma: float

    def __post_init__(self) -> None:
        _check_distance(self, "place", self.places)

    @property
    def between(self) -> tuple[str, str]:
        """The names of its ends."""
        return self.places


@dataclass(frozen=True)
class Noise:
    """What was measured, how well: one standard deviation of each number; None where nothing is said.

    What nothing is said of is estimated from the residuals.

    Attributes:
        pixel: of u and of v. [px]
        point: of each coordinate of a measured point. [m]
        joint: of each joint reading. [rad or m]
        other: of further kinds of measurement, by their ``noise`` key.
    """

    pixel: float | None = None
    point: float | None = None
    joint: float | None = None
    other: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        said = [name for name in ("pixel", "point", "joint") if getattr(self, name) is not None]
        for name in said:
            _keep_numbers(self, "noise", name, zero=name == "joint")
        keep(self, other=_numbers(self.other, "noise"))

    def said(self, name: str) -> float | None:
        """Return what is said under a key of ``noise``."""
        return getattr(self, name) if name in ("pixel", "point", "joint") else self.other.get(name)

    def of(self, kind: type[Measurements]) -> float:
        """Return the standard deviation of a kind of measurement, in its unit; its usual one where nothing is said."""
        declared = self.said(kind.noise)
        return kind.usual if declared is None else declared

    def spreads(self, kind: type[Measurements]) -> dict[str, float]:
        """Return the standard deviation of each of a kind's fields of them, its usual one where nothing is said."""
        said = {name: (self.said(of.noise), of.usual) for name, of in kind.spread_of().items()}
        return {name: usual if declared is None else declared for name, (declared, usual) in said.items()}

    @property
    def reading(self) -> float:
        """The standard deviation of joint readings; none where nothing is said. [rad or m]."""
        return self.joint or 0.0


@dataclass(frozen=True)
class Estimate:
    """What is to be estimated; None leaves it to the calibration.

    Attributes:
        geometry: of the arm: DH rows, zero offsets only, every placement, or nothing.
        intrinsics: of all cameras, or of each by name.
        extrinsics: of all cameras, or of each by name.
        time_offset: of every camera's clock from the robot's, where the arm moves; None is free.
        gravity: its direction in the base link's frame, if it is to be found from how the arm bends; None is as given.
    """

    geometry: ArmGeometry | None = None
    intrinsics: Freedom | Mapping[str, Freedom] | None = None
    extrinsics: Freedom | Mapping[str, Freedom] | None = None
    time_offset: TimeOffset | None = None
    gravity: Literal["free"] | None = None

    def of(self, what: Literal["intrinsics", "extrinsics"], camera: str) -> Freedom | None:
        """What the session says of one camera; None leaves it to the calibration."""
        said: Freedom | Mapping[str, Freedom] | None = getattr(self, what)
        return said if said is None or isinstance(said, str) else said.get(camera)

    def __post_init__(self) -> None:
        known_words = {"geometry": ArmGeometry, "intrinsics": Freedom, "extrinsics": Freedom, "time_offset": TimeOffset}
        for name, known in known_words.items():
            value, choices = getattr(self, name), get_args(known)
            by_camera = name in ("intrinsics", "extrinsics") and isinstance(value, Mapping)
            for word in value.values() if by_camera else (value,) * (value is not None):
                if word not in choices:
                    remedy = f"Use {', '.join(choices)}, or None."
                    raise SessionError(f"{name} is {word!r}", where="estimate", remedy=remedy)


@dataclass(frozen=True)
class Tolerances:
    """How far the robot may be from nominal, one standard deviation; 0 is exactly nominal.

    Attributes:
        length: of d and a. [m]
        angle: of theta, alpha and beta. [rad]
        zero: of a joint's zero offset. [rad or m]
        joints: exceptions, by joint (or mount of a branch) and DH parameter. [rad or m]
    """

    length: float = 0.001
    angle: float = 0.002
    zero: float = 0.005
    joints: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _keep_numbers(self, "tolerances", "length", "angle", "zero", zero=True)
        exceptions = {}
        for joint, values in self.joints.items():
            where = f"tolerances of joint {joint!r}"
            for parameter in values:
                check_known(parameter, PARAMETERS, "parameters", where)
            exceptions[str(joint)] = _numbers(values, where, zero=True)
        keep(self, joints=ReadOnly(exceptions))


@dataclass(frozen=True, eq=False)
class Payload:
    """What the arm carries beside its own links.

    Attributes:
        link: that it is fastened to.
        mass: of it. [kg]
        center: (3,) its centre of mass in the link's frame. [m]
    """

    link: str
    mass: float
    center: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        _keep_numbers(self, "payload", "mass")
        keep(self, link=str(self.link), center=finite_array(self.center, (3,), "center", "payload"))


@dataclass(frozen=True, eq=False)
class Excluded:
    """What is left out of a session, by name.

    Attributes:
        poses: their labels.
        cameras: their names.
        leds: their names.
        whole: what it was left out of, None where it still is in there.
    """

    poses: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    leds: tuple[str, ...] = ()
    whole: Session | None = None

    @property
    def named(self) -> dict[str, list[str]]:
        """The names by key, as in session.yaml; no key of which nothing is named."""
        said = {"poses": self.poses, "cameras": self.cameras, "leds": self.leds}
        return {key: list(names) for key, names in said.items() if names}

    def __bool__(self) -> bool:
        """Return whether anything is named."""
        return bool(self.named)

    def kept(self, of: Positions, table: Measurements) -> Bools:
        """Return which rows (S,) of a table of a session's measurements are of nothing that is named."""
        known = {
            "pose": (of.poses, self.poses),
            "camera": (of.rig.names, self.cameras),
            "led": (of.led_names, self.leds),
        }
        kept = np.ones(len(table), dtype=bool)
        for key, index in table.index.items():
            if key in known:
                names, left_out = known[key]
                kept &= ~np.isin(names, list(left_out))[index]
        return kept


def _numbers(values: Mapping[str, float], where: str, *, zero: bool = False) -> ReadOnly[str, float]:
    return ReadOnly({str(name): finite_number(value, name, where, zero=zero) for name, value in values.items()})


def _check_distance(distance: object, what: str, ends: tuple[str, str]) -> None:
    where = f"distance of {what}s {ends[0]!r} and {ends[1]!r}"
    if ends[0] == ends[1]:
        raise SessionError(f"{'an' if what == 'LED' else 'a'} {what} has no distance to itself", where=where)
    _keep_numbers(distance, where, "distance", "sigma")


def _keep_numbers(declared: object, where: str, *names: str, zero: bool = False) -> None:
    """Check that some fields are positive numbers, or 0 where that has a meaning."""
    keep(declared, **_numbers({name: getattr(declared, name) for name in names}, where, zero=zero))
