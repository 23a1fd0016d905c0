"""A session in memory, read-only: a robot, its LEDs and cameras, and what was measured."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from urdfcal.arrays import Floats, Ints, ReadOnly, Rebuilt, finite_array, frozen, keep
from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.names import check_known, check_names
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.attachments import Attachments, CameraMount, attach
from urdfcal.session.knowledge import Estimate, Excluded, Led, LedDistance, Noise, Tolerances
from urdfcal.session.trajectory import AT_REST, Motion, Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from typing_extensions import Self

    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.target import Target

# Three positions are the fewest that fix a base pose.
MIN_POSES = 3
# Readings of mimic joints are computed, not measured: they agree to rounding.
_MIMIC_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Measurements(Rebuilt, ABC):
    """Measurements of one kind, sorted by their keys; what was not measured is a missing row.

    A kind is a frozen dataclass with an index array (S,) for each of its ``keys``, the first one ``pose``, an array
    (S, D) of what was measured, and ``sigma`` (S,), the standard deviation of each number. A kind that measures that
    something is zero, such as a contact, has no such array.

    Attributes:
        pose: (S,) index of the pose.
        names: what the indices of a key stand for that only this table names, such as places.
        kind: the table's key in session.yaml, and the stem of its CSV file.
        keys: the columns that name things, which together are unique.
        dimension: D, the numbers of one measurement.
        columns: the columns that hold these; none where they are zero.
        array: the field that holds these; empty where there is none.
        noise: the key of ``noise`` that says the usual standard deviation.
        usual: its default.
        unit: of the numbers.
        report: unit and factor in which they are reported.
    """

    kind: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]
    dimension: ClassVar[int]
    columns: ClassVar[tuple[str, ...]] = ()
    array: ClassVar[str] = ""
    noise: ClassVar[str]
    usual: ClassVar[float]
    unit: ClassVar[str]
    report: ClassVar[tuple[str, float]]

    pose: Ints
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict, kw_only=True)

    if TYPE_CHECKING:

        @property
        def sigma(self) -> Floats:
            """(S,) standard deviation of each number."""

    def __post_init__(self) -> None:
        """Check the columns, sort them by the keys and make them read-only."""
        index = {key: np.asarray(getattr(self, key)) for key in self.keys}
        count = len(index["pose"]) if index["pose"].ndim == 1 else 0
        if count == 0:
            raise SessionError("there is no measurement", where=self.kind)
        for key, column in index.items():
            if column.shape != (count,) or column.dtype.kind not in "iu" or column.min() < 0:
                raise SessionError(f"{key} is not an array of {count} indices", where=self.kind)
        try:
            sigma = finite_array(np.broadcast_to(self.arrays["sigma"], (count,)), (count,), "sigma", self.kind)
        except ValueError as error:
            what = f"sigma has shape {np.shape(self.arrays['sigma'])}, not ({count},)"
            raise SessionError(what, where=self.kind) from error
        if sigma.min() <= 0.0:
            raise SessionError(f"sigma is {sigma.min():g}; it must be positive", where=self.kind)
        columns = {**self.arrays, **index, "sigma": sigma}
        if self.array:
            columns[self.array] = finite_array(self.values, (count, self.dimension), self.array, self.kind)
        order = np.lexsort([index[key] for key in reversed(self.keys)])
        for name, column in columns.items():
            keep(self, **{name: frozen(np.asarray(column)[order], np.intp if name in index else float)})
        keep(self, names=ReadOnly(self.names))
        twice = np.logical_and.reduce([np.diff(getattr(self, key)) == 0 for key in self.keys])
        if twice.any():
            first = int(np.flatnonzero(twice)[0])
            names = ", ".join(f"{key} {getattr(self, key)[first]}" for key in self.keys)
            raise SessionError(f"there are two measurements of {names}", where=self.kind)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.pose)

    @property
    def values(self) -> Floats:
        """What was measured, (S, D)."""
        result: Floats = getattr(self, self.array) if self.array else np.zeros((len(self), self.dimension))
        return result

    @property
    def index(self) -> dict[str, Ints]:
        """The index array (S,) of each key."""
        return {key: getattr(self, key) for key in self.keys}

    def rows(self, chosen: Any) -> Self:
        """Return some of the rows, by an index or a mask (S,)."""
        return replace(self, **{name: column[chosen] for name, column in self.arrays.items()})

    def with_sigma(self, sigma: float) -> Self:
        """Return the same measurements with one standard deviation for all. [unit]."""
        changed: dict[str, Any] = {"sigma": np.full(len(self), sigma)}
        return replace(self, **changed)

    def at(self, poses: Ints) -> Self | None:
        """Return the rows at some poses, (K,) in ascending order, numbered by these; None if there are none."""
        kept = np.isin(self.pose, poses)
        if not kept.any():
            return None
        rows = self.rows(kept)
        return replace(rows, pose=np.searchsorted(poses, rows.pose))

    def check(self, counts: Mapping[str, int]) -> None:
        """Refuse indices of things that do not exist.

        Args:
            counts: how many there are of what a key names; others are not checked.

        Raises:
            SessionError: an index is too large.
        """
        for key, column in self.index.items():
            largest = int(column.max())
            if key in counts and largest >= counts[key]:
                raise SessionError(f"{key} {largest} does not exist: there are {counts[key]}", where=self.kind)

    @property
    def arrays(self) -> dict[str, Any]:
        """The columns by the names of their fields, each with S rows."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "names"}


Kind = TypeVar("Kind", bound=Measurements)


@dataclass(frozen=True, eq=False, kw_only=True)
class Setup(Rebuilt):
    """What a rig and a session share: a robot, its LEDs, its cameras, and what is thought of them.

    Attributes:
        chain: the joints that are calibrated; a tree of them where LEDs and cameras are on different links.
        leds: on links of the robot, or in the world.
        targets: boards, tags and other rigid bodies with points, there as well.
        led_distances: measured between them.
        rig: the cameras; none where something else measures.
        mounts: of the eye-in-hand cameras.
        urdf: the robot description; None for a chain from elsewhere.
        urdf_reference: how the file names it: a path or ``package://``.
        noise: of the measurements.
        estimate: what is to be estimated.
        tolerances: of the robot.
        joint_models: by name, which are estimated (True) or not (False); of the others each decides itself.
        scale_sigma: of the share that the instrument's lengths may be too long by; where nothing is said the rig's,
            or None.
        sha256: hash of every input file, by the name that the session gives it.
        folder: where it was read from.
    """

    chain: Mechanism
    leds: tuple[Led, ...] = ()
    targets: tuple[Target, ...] = ()
    led_distances: tuple[LedDistance, ...] = ()
    rig: Rig = field(default_factory=Rig)
    mounts: tuple[CameraMount, ...] = ()
    urdf: Urdf | None = None
    urdf_reference: str = ""
    noise: Noise = field(default_factory=Noise)
    estimate: Estimate = field(default_factory=Estimate)
    tolerances: Tolerances = field(default_factory=Tolerances)
    joint_models: Mapping[str, bool] = field(default_factory=dict)
    scale_sigma: float | None = None
    sha256: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None

    def __post_init__(self) -> None:
        keep(self, **{name: tuple(getattr(self, name)) for name in ("leds", "targets", "led_distances", "mounts")})
        keep(self, sha256=ReadOnly(self.sha256), joint_models=ReadOnly(self.joint_models))
        if self.scale_sigma is None:
            keep(self, scale_sigma=self.rig.scale_sigma)
        for name in (name for distance in self.led_distances for name in distance.leds):
            check_known(name, [led.name for led in self.leds], "LEDs", "led_distances")
        check_names("LEDs", self.led_names)
        rows = rows_of(self.chain).labels if self.tolerances.joints else ()
        for joint in self.tolerances.joints:
            between = f" between {self.chain.base_link!r} and {self.chain.tip_link!r}"
            check_known(joint, rows, "joints", f"tolerances.{joint}", between)
        for mount in self.mounts:
            check_known(mount.camera, self.rig.names, "cameras", f"cameras.{mount.camera}")
        check_names("cameras on links", [mount.camera for mount in self.mounts])
        for said in (self.estimate.intrinsics, self.estimate.extrinsics):
            for name in () if said is None or isinstance(said, str) else said:
                check_known(name, self.rig.names, "cameras", "estimate")
        _ = self.attachments  # a link that is none of the robot's is refused now, not when it is first needed

    @cached_property
    def attachments(self) -> Attachments:
        """What LEDs, targets and cameras are attached to."""
        mounts = {mount.camera: mount for mount in self.mounts}
        return attach(self.chain, [led.link for led in self.leds], self.targets, self.rig, mounts)

    @cached_property
    def led_names(self) -> tuple[str, ...]:
        """What the tables call the LEDs, then the targets' points, in order."""
        return (*(led.name for led in self.leds), *(name for of in self.targets for name in of.point_names))


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
        places = {name: finite_array(getattr(self, name), (3,), name, "stand") for name in ("position", "look_at")}
        keep(self, **places)
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
        if self.stand is None and len(self.attachments.eye_to_hand):
            raise SessionError("where the first camera stands is not given", where="stand")
        if self.stand is not None and self.mounts and not len(self.attachments.eye_to_hand):
            remedy = "Leave the key 'stand' out."
            raise SessionError("no camera stands: all ride on the robot", where="stand", remedy=remedy)


@dataclass(frozen=True, eq=False, kw_only=True)
class Positions(Setup):
    """A rig in the positions at which something is measured, or will be: a session whose images are not read yet.

    Attributes:
        poses: (N) labels.
        q: (N, n) value of every joint of the chain in every pose, mimic joints included. [rad or m]
        time: (N,) of each pose, where recorded. [s]
        motion: at rest in every pose, or a trajectory: each pose is then a frame of one camera, q what its log says.
        warnings: what looked odd when it was read.
    """

    poses: tuple[str, ...]
    q: Floats
    time: Floats | None = None
    motion: Motion = AT_REST
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        keep(self, poses=tuple(map(str, self.poses)), warnings=tuple(self.warnings))
        count = len(self.poses)
        if count < MIN_POSES:
            raise SessionError(f"{count} poses are too few", remedy=f"Measure at least {MIN_POSES}, better 30 or more.")
        check_names("poses", self.poses)
        keep(self, q=finite_array(self.q, (count, len(self.chain.joints)), "q", "session"))
        if not np.allclose(self.chain.joint_values(self.readings), self.q, rtol=0.0, atol=_MIMIC_ROUNDING):
            raise SessionError("a mimic joint's value in q is not what it follows from", where="session")
        if self.time is not None:
            keep(self, time=finite_array(self.time, (count,), "time", "session"))

    @property
    def readings(self) -> Floats:
        """(N, k) values [rad or m] of the joints that have a reading of their own, as in joints.csv."""
        return self.chain.readings(self.q)

    def label(self, pose: int) -> str:
        """What the tables and the images' file names call a pose: a frame goes by the name its camera gave it."""
        return self.motion.label(pose, self.poses)

    def measured(self, measurements: tuple[Measurements, ...], **changes: Any) -> Session:
        """Return the same with what was measured, and with changes to other fields."""
        own = {entry.name: getattr(self, entry.name) for entry in fields(Positions)}
        return Session(**{**own, **changes}, measurements=measurements)


@dataclass(frozen=True, eq=False, kw_only=True)
class Session(Positions):
    """A rig and what was measured with it.

    Attributes:
        measurements: one table for each kind of measurement, such as detections in images or points of a tracker.
        excluded: what was left out of it.
    """

    measurements: tuple[Measurements, ...]
    excluded: Excluded = field(default_factory=Excluded)

    def __post_init__(self) -> None:
        super().__post_init__()
        keep(self, measurements=tuple(self.measurements))
        if not self.measurements:
            raise SessionError("there are no measurements", remedy="There is nothing to calibrate from.")
        counts = {"pose": len(self.poses), "led": len(self.led_names), "camera": len(self.rig.cameras)}
        for table in self.measurements:
            if "camera" in table.keys and not self.rig.cameras:
                raise SessionError(f"there are {table.kind}, but no cameras", remedy="Give the session a rig.")
            table.check(counts)
            if isinstance(self.motion, Trajectory):
                # Of a moving arm each pose is one camera's frame: what is measured is measured by that camera.
                if "camera" not in table.keys:
                    raise SessionError("a moving arm is measured by cameras alone", where="session")
                if np.any(table.index["camera"] != self.motion.camera[table.pose]):
                    raise SessionError("a detection is by another camera than its frame", where=table.kind)

    def find(self, kind: type[Kind]) -> Kind | None:
        """Return the measurements of a kind; None if there are none."""
        return next((table for table in self.measurements if isinstance(table, kind)), None)

    def at(self, poses: Ints) -> Session:
        """Return the session of some of its poses, (K,) indices in ascending order."""
        tables = (table.at(poses) for table in self.measurements)
        return replace(
            self,
            poses=tuple(self.poses[k] for k in poses),
            q=self.q[poses],
            time=None if self.time is None else self.time[poses],
            motion=self.motion.at(poses),
            measurements=tuple(table for table in tables if table is not None),
        )

    def with_time_offsets(self, time_offsets: Floats) -> Session:
        """Return the same with its joint values read at the cameras' time offsets (C,) in s, where the arm moved."""
        q = self.motion.joint_values(self.q, time_offsets)
        return self if q is self.q else replace(self, q=q)

    def recorded(self, time_offsets: Floats) -> Session:
        """Return the same without frames that the log of a moving arm does not cover with time offsets (C,) in s.

        Frames are read before the offsets are known: with one of a second, some at the log's ends have no joint values.
        """
        covered = self.motion.covered(len(self.poses), time_offsets)
        if covered.all():
            return self
        warning = (
            f"{np.count_nonzero(~covered)} of {len(covered)} frames have no joint readings at their time once the "
            "cameras' time offsets are known, and were left out"
        )
        return replace(self.at(np.flatnonzero(covered)), warnings=(*self.warnings, warning))

    @property
    def undeclared_noise(self) -> frozenset[str]:
        """Keys of ``noise`` of which neither the session nor a table of its measurements says anything."""
        tables = (table for table in self.measurements if np.all(table.sigma == table.usual))
        names = (*(table.noise for table in tables), "joint")
        return frozenset(name for name in names if self.noise.said(name) is None)

    def with_noise(self, sigmas: Mapping[str, float]) -> Self:
        """Return the session with standard deviations for some keys of ``noise``, the tables' own included."""
        own = {name: sigmas[name] for name in ("pixel", "point", "joint") if name in sigmas}
        other = {name: sigma for name, sigma in sigmas.items() if name not in own}
        tables = (
            table.with_sigma(sigmas[table.noise]) if table.noise in sigmas else table for table in self.measurements
        )
        noise = replace(self.noise, **own, other={**self.noise.other, **other})
        return replace(self, measurements=tuple(tables), noise=noise)

    def unmeasured(self) -> Positions:
        """Return the same without its measurements."""
        return Positions(**{f.name: getattr(self, f.name) for f in fields(Positions)})
