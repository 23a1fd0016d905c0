"""A session in memory: a robot, its LEDs and cameras, and what was measured. All of it read-only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.errors import SessionError
from urdfcal.names import check_names, suggest
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.attachments import CameraMount, Frames, fasten

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike

    from urdfcal.cameras.rig import Rig
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.trajectory import Trajectory

Geometry: TypeAlias = Literal["dh", "offsets", "full", "none"]
Freedom: TypeAlias = Literal["fixed", "refine", "free"]
TimeOffset: TypeAlias = Literal["free", "fixed"]

Table = TypeVar("Table", "Detections", "Points")

# Three positions are the fewest that fix a base pose.
MIN_POSES = 3
# Readings of mimic joints are computed, not measured: they agree to rounding.
_MIMIC_ROUNDING = 1e-9


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
        object.__setattr__(self, "name", str(self.name))
        if self.position is not None:
            object.__setattr__(self, "position", _finite(self.position, (3,), "position", where))
        if self.sigma is not None:
            if self.position is None:
                raise SessionError("sigma is given without a position", where=where)
            object.__setattr__(self, "sigma", _number(self.sigma, "sigma", where, zero=True))


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
        where = f"distance of LEDs {self.leds[0]!r} and {self.leds[1]!r}"
        if self.leds[0] == self.leds[1]:
            raise SessionError("an LED has no distance to itself", where=where)
        object.__setattr__(self, "distance", _number(self.distance, "distance", where, zero=False))
        object.__setattr__(self, "sigma", _number(self.sigma, "sigma", where, zero=False))


@dataclass(frozen=True)
class Noise:
    """What was measured, how well: one standard deviation of each number.

    Attributes:
        pixel: of u and of v. [px]
        point: of each coordinate of a measured point. [m]
        joint: of each joint reading; 0 where it does not matter. [rad or m]
    """

    pixel: float = 0.1
    point: float = 1e-4
    joint: float = 0.0

    def __post_init__(self) -> None:
        for name in ("pixel", "point", "joint"):
            object.__setattr__(self, name, _number(getattr(self, name), name, "noise", zero=name == "joint"))


@dataclass(frozen=True)
class Estimate:
    """What is to be estimated; None leaves it to the calibration.

    Attributes:
        geometry: of the arm: DH rows, zero offsets only, every placement, or nothing.
        intrinsics: of all cameras, or of each by name.
        extrinsics: of all cameras, or of each by name.
        time_offset: of every camera's clock from the robot's, where the arm moves; None is free.
    """

    geometry: Geometry | None = None
    intrinsics: Freedom | Mapping[str, Freedom] | None = None
    extrinsics: Freedom | Mapping[str, Freedom] | None = None
    time_offset: TimeOffset | None = None

    def of(self, what: Literal["intrinsics", "extrinsics"], camera: str) -> Freedom | None:
        """What the session says of one camera; None leaves it to the calibration."""
        said: Freedom | Mapping[str, Freedom] | None = getattr(self, what)
        return said if said is None or isinstance(said, str) else said.get(camera)

    def __post_init__(self) -> None:
        known_words = {"geometry": Geometry, "intrinsics": Freedom, "extrinsics": Freedom, "time_offset": TimeOffset}
        for name, known in known_words.items():
            value, choices = getattr(self, name), get_args(known)
            by_camera = name in ("intrinsics", "extrinsics") and isinstance(value, Mapping)
            for word in value.values() if by_camera else (value,) * (value is not None):
                if word not in choices:
                    raise SessionError(
                        f"{name} is {word!r}", where="estimate", remedy=f"Use {', '.join(choices)}, or None."
                    )


@dataclass(frozen=True)
class Tolerances:
    """How far the robot may be from its drawing, one standard deviation; 0 is exactly as drawn.

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
        for name in ("length", "angle", "zero"):
            object.__setattr__(self, name, _number(getattr(self, name), name, "tolerances", zero=True))
        read_only = {}
        for joint, values in self.joints.items():
            where = f"tolerances of joint {joint!r}"
            for parameter in values:
                if parameter not in PARAMETERS:
                    raise SessionError(
                        f"there is no parameter {parameter!r}",
                        where=where,
                        remedy=suggest(parameter, PARAMETERS, "parameters"),
                    )
            numbers = {str(name): _number(value, name, where, zero=True) for name, value in values.items()}
            read_only[str(joint)] = MappingProxyType(numbers)
        object.__setattr__(self, "joints", MappingProxyType(read_only))

    def __reduce__(self) -> tuple[Any, ...]:
        # Read-only mappings do not travel to other processes; plain ones do.
        joints = {joint: dict(values) for joint, values in self.joints.items()}
        return type(self), (self.length, self.angle, self.zero, joints)


@dataclass(frozen=True, eq=False)
class Detections:
    """LEDs seen by cameras, sorted by pose, camera and LED. A missing sighting is a missing row.

    Attributes:
        pose: (S,) index of the pose.
        camera: (S,) index of the camera.
        led: (S,) index of the LED.
        uv: (S, 2) where it was seen. [px]
        sigma: (S,) standard deviation of u and of v; one number serves all. [px]
    """

    pose: Ints
    camera: Ints
    led: Ints
    uv: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        _freeze_sightings(self, "detections", ("pose", "camera", "led"), "uv", 2)

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True, eq=False)
class Points:
    """LEDs measured in 3-D, sorted by pose and LED.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        xyz: (S, 3) in the tracker's frame. [m]
        sigma: (S,) standard deviation of each coordinate; one number serves all. [m]
    """

    pose: Ints
    led: Ints
    xyz: Floats
    sigma: Floats

    def __post_init__(self) -> None:
        _freeze_sightings(self, "points", ("pose", "led"), "xyz", 3)

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False, kw_only=True)
class Setup:
    """What a rig and a session share: a robot, its LEDs, its cameras, and what is thought of them.

    Attributes:
        chain: the joints that are calibrated; a tree of them where LEDs and cameras are on different links.
        leds: on links of the robot, or in the world.
        led_distances: measured between them.
        rig: the cameras; None where points were measured instead.
        mounts: of the cameras that ride on the robot.
        urdf: the robot description; None for a chain from elsewhere.
        urdf_reference: how the file names it: a path or ``package://``.
        noise: of the measurements.
        estimate: what is to be estimated.
        tolerances: of the robot.
        sha256: hash of every input file, by the name that the session gives it.
        folder: where it was read from.
    """

    chain: Mechanism
    leds: tuple[Led, ...]
    led_distances: tuple[LedDistance, ...] = ()
    rig: Rig | None = None
    mounts: tuple[CameraMount, ...] = ()
    urdf: Urdf | None = None
    urdf_reference: str = ""
    noise: Noise = field(default_factory=Noise)
    estimate: Estimate = field(default_factory=Estimate)
    tolerances: Tolerances = field(default_factory=Tolerances)
    sha256: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "leds", tuple(self.leds))
        object.__setattr__(self, "led_distances", tuple(self.led_distances))
        for name in (name for distance in self.led_distances for name in distance.leds):
            if name not in self.led_names:
                raise SessionError(
                    f"there is no LED {name!r}", where="led_distances", remedy=suggest(name, self.led_names, "LEDs")
                )
        object.__setattr__(self, "sha256", MappingProxyType(dict(self.sha256)))
        if not self.leds:
            raise SessionError("there is no LED", remedy="Name at least one.")
        check_names("LEDs", [led.name for led in self.leds])
        rows = rows_of(self.chain).labels if self.tolerances.joints else ()
        for joint in self.tolerances.joints:
            if joint not in rows:
                raise SessionError(
                    f"there is no joint {joint!r} between {self.chain.base_link!r} and {self.chain.tip_link!r}",
                    where="tolerances",
                    remedy=suggest(joint, rows, "joints"),
                )
        object.__setattr__(self, "mounts", tuple(self.mounts))
        names = self.rig.names if self.rig is not None else ()
        for mount in self.mounts:
            if mount.camera not in names:
                raise SessionError(
                    f"there is no camera {mount.camera!r}",
                    where="cameras",
                    remedy=suggest(mount.camera, names, "cameras"),
                )
        check_names("cameras on links", [mount.camera for mount in self.mounts])
        for said in (self.estimate.intrinsics, self.estimate.extrinsics):
            for name in () if said is None or isinstance(said, str) else said:
                if name not in names:
                    raise SessionError(
                        f"there is no camera {name!r}", where="estimate", remedy=suggest(name, names, "cameras")
                    )
        _ = self.frames  # a link that is none of the robot's is told now, not when it is first needed

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return _rebuilt, (type(self), {**values, "sha256": dict(self.sha256)})

    @cached_property
    def frames(self) -> Frames:
        """What LEDs and cameras are fastened to."""
        return fasten(self.chain, [led.link for led in self.leds], self.rig, {m.camera: m for m in self.mounts})

    @property
    def led_names(self) -> tuple[str, ...]:
        """The LEDs' names, in order."""
        return tuple(led.name for led in self.leds)


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a camera stands and looks.

    Attributes:
        position: (3,) in the base link's frame. [m]
        look_at: (3,) point on its optical axis, in the base link's frame. [m]
    """

    position: Floats
    look_at: Floats

    def __post_init__(self) -> None:
        for name in ("position", "look_at"):
            object.__setattr__(self, name, _finite(getattr(self, name), (3,), name, "stand"))
        if np.array_equal(self.position, self.look_at):
            raise SessionError("the camera looks at its own place", where="stand")


@dataclass(frozen=True, eq=False, kw_only=True)
class RigDescription(Setup):
    """A rig: a setup and where it stands, enough to simulate a session.

    Attributes:
        stand: of the first camera that stands still; None where all ride on the robot.
    """

    stand: Stand | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stand is None and len(self.frames.standing):
            raise SessionError("where the first camera stands is not given", where="stand")
        if self.stand is not None and self.mounts and not len(self.frames.standing):
            raise SessionError(
                "no camera stands: all ride on the robot", where="stand", remedy="Leave the key 'stand' out."
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class Positions(Setup):
    """A rig in the positions at which something is measured, or will be: a session whose images are not read yet.

    Attributes:
        poses: (N) labels.
        q: (N, n) value of every joint of the chain in every pose, mimic joints included. [rad or m]
        time: (N,) of each pose, where recorded. [s]
        trajectory: of an arm that moved: each pose is a frame of one camera, q what the log says of it.
        warnings: what looked odd when it was read.
    """

    poses: tuple[str, ...]
    q: Floats
    time: Floats | None = None
    trajectory: Trajectory | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "poses", tuple(map(str, self.poses)))
        object.__setattr__(self, "warnings", tuple(self.warnings))
        count = len(self.poses)
        if count < MIN_POSES:
            raise SessionError(f"{count} poses are too few", remedy=f"Measure at least {MIN_POSES}, better 30 or more.")
        check_names("poses", self.poses)
        object.__setattr__(self, "q", _finite(self.q, (count, len(self.chain.joints)), "q", "session"))
        if not np.allclose(self.chain.joint_values(self.readings), self.q, rtol=0.0, atol=_MIMIC_ROUNDING):
            raise SessionError("a mimic joint's value in q is not what it follows from", where="session")
        if self.time is not None:
            object.__setattr__(self, "time", _finite(self.time, (count,), "time", "session"))

    @property
    def readings(self) -> Floats:
        """(N, k) values [rad or m] of the joints that have a reading of their own, as in joints.csv."""
        return self.chain.readings(self.q)

    def label(self, pose: int) -> str:
        """What the tables and the pictures' file names call a pose: a frame goes by the name its camera gave it."""
        return self.poses[pose] if self.trajectory is None else self.trajectory.label(pose)


@dataclass(frozen=True, eq=False, kw_only=True)
class Session(Positions):
    """A rig and what was measured with it: pixels, points, or both.

    Attributes:
        detections: LEDs in the cameras' images.
        points: LEDs in 3-D.
    """

    detections: Detections | None = None
    points: Points | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_measurements()

    def at(self, poses: Ints) -> Session:
        """The session of some of its poses, (K,) indices in ascending order."""
        return replace(
            self,
            poses=tuple(self.poses[k] for k in poses),
            q=self.q[poses],
            time=None if self.time is None else self.time[poses],
            trajectory=None if self.trajectory is None else self.trajectory.at(poses),
            detections=_at(self.detections, poses),
            points=_at(self.points, poses),
        )

    def with_clocks(self, time_offsets: Floats) -> Session:
        """The same, of an arm that moved with its joint values read at the cameras' time offsets (C,) in s."""
        return self if self.trajectory is None else replace(self, q=self.trajectory.values(time_offsets))

    def recorded(self, time_offsets: Floats) -> Session:
        """The same, of an arm that moved without frames that its log does not cover with time offsets (C,) in s.

        Frames are read before the offsets are known: with one of a second, some at the log's ends have no joint values.
        """
        if self.trajectory is None:
            return self
        covered = self.trajectory.log.covers(self.trajectory.robot_time(time_offsets))
        if covered.all():
            return self
        warning = (
            f"{np.count_nonzero(~covered)} of {len(covered)} frames have no joint readings at their time once the "
            "cameras' clocks are set, and were left out"
        )
        return replace(self.at(np.flatnonzero(covered)), warnings=(*self.warnings, warning))

    def unmeasured(self) -> Positions:
        """The same without its sightings."""
        return Positions(**{f.name: getattr(self, f.name) for f in fields(Positions)})

    def _check_measurements(self) -> None:
        if self.detections is None and self.points is None:
            raise SessionError("there are neither detections nor points", remedy="There is nothing to calibrate from.")
        counts = {"pose": len(self.poses), "led": len(self.leds)}
        if self.detections is not None:
            if self.rig is None:
                raise SessionError("there are detections, but no cameras", remedy="Give the session a rig.")
            _check_indices(self.detections, "detections", {**counts, "camera": len(self.rig.cameras)})
        if self.points is not None:
            _check_indices(self.points, "points", counts)
        if self.trajectory is not None:
            if self.points is not None or self.detections is None:
                raise SessionError("a moving arm is measured by cameras alone", where="session")
            if np.any(self.detections.camera != self.trajectory.camera[self.detections.pose]):
                raise SessionError("a sighting is by another camera than its frame", where="detections")


def _rebuilt(kind: type[Setup], values: dict[str, Any]) -> Setup:
    return kind(**values)


def _number(value: Any, name: str, where: str, *, zero: bool) -> float:
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise SessionError(f"{name} is {value!r}, not a {'non-negative' if zero else 'positive'} number", where=where)
    return float(value)


def _finite(values: ArrayLike, shape: tuple[int, ...], name: str, where: str) -> Floats:
    try:
        array = frozen(values)
    except (TypeError, ValueError) as error:
        raise SessionError(f"{name} is not made of numbers", where=where) from error
    if array.shape != shape:
        raise SessionError(f"{name} has shape {array.shape}, not {shape}", where=where)
    if not np.isfinite(array).all():
        raise SessionError(f"{name} has values that are not finite", where=where)
    return array


def _freeze_sightings(table: Any, where: str, keys: tuple[str, ...], values: str, width: int) -> None:
    """Check the columns of a table of sightings, sort them by ``keys`` and make them read-only."""
    index = {key: np.asarray(getattr(table, key)) for key in keys}
    count = len(index[keys[0]]) if index[keys[0]].ndim == 1 else 0
    if count == 0:
        raise SessionError("there is no sighting", where=where)
    for key, column in index.items():
        if column.shape != (count,) or column.dtype.kind not in "iu" or column.min() < 0:
            raise SessionError(f"{key} is not an array of {count} indices", where=where)
    numbers = _finite(getattr(table, values), (count, width), values, where)
    try:
        sigma = _finite(np.broadcast_to(table.sigma, (count,)), (count,), "sigma", where)
    except ValueError as error:
        raise SessionError(f"sigma has shape {np.shape(table.sigma)}, not ({count},)", where=where) from error
    if sigma.min() <= 0.0:
        raise SessionError(f"sigma is {sigma.min():g}; it must be positive", where=where)
    order = np.lexsort([index[key] for key in reversed(keys)])
    for key, column in index.items():
        object.__setattr__(table, key, frozen(column[order], np.intp))
    object.__setattr__(table, values, frozen(numbers[order]))
    object.__setattr__(table, "sigma", frozen(sigma[order]))
    twice = np.logical_and.reduce([np.diff(getattr(table, key)) == 0 for key in keys])
    if twice.any():
        first = int(np.flatnonzero(twice)[0])
        names = ", ".join(f"{key} {getattr(table, key)[first]}" for key in keys)
        raise SessionError(f"there are two sightings of {names}", where=where)


def _at(table: Table | None, poses: Ints) -> Table | None:
    """Sightings at some poses, by which they are numbered anew; None if there are none."""
    if table is None:
        return None
    kept = np.isin(table.pose, poses)
    columns = {entry.name: getattr(table, entry.name)[kept] for entry in fields(table)}
    return replace(table, **{**columns, "pose": np.searchsorted(poses, columns["pose"])}) if kept.any() else None


def _check_indices(table: Detections | Points, where: str, counts: Mapping[str, int]) -> None:
    for key, count in counts.items():
        largest = int(getattr(table, key).max())
        if largest >= count:
            raise SessionError(f"{key} {largest} does not exist: there are {count}", where=where)
