"""A session in memory, read-only: a robot, its LEDs and cameras, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, Ints, ReadOnly, Rebuilt, finite_array, finite_number, frozen, keep
from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.names import check_known, check_names
from urdfcal.robot.gravity import STANDARD_GRAVITY
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.attachments import Attachments, CameraMount, attach
from urdfcal.session.knowledge import (
    Estimate,
    Excluded,
    JointModelSaid,
    Led,
    LedDistance,
    Noise,
    Payload,
    PlaceDistance,
    Tolerances,
)
from urdfcal.session.measurements import Kind, Measurements, numbered_alike
from urdfcal.session.moves import check_moves, moves_at
from urdfcal.session.trajectory import AT_REST, Motion, Trajectory

if TYPE_CHECKING:
    from pathlib import Path

    from typing_extensions import Self

    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.obstacle import Obstacle
    from urdfcal.session.target import Target

# Three positions are the fewest that fix a base pose.
MIN_POSES = 3
# Readings of mimic joints are computed, not measured: they agree to rounding.
_MIMIC_ROUNDING = 1e-9


# From the poles to the equator it is 9.832 to 9.764; that of some units, axes or signs of payloads is not. [m/s^2]
_GRAVITY = (9.7, 9.9)


def before(values: Floats, time: Floats | None) -> Floats:
    """Return the values (N, ...) of the pose before each, by time (N,) if there is one; of the first its own."""
    order = np.arange(len(values)) if time is None else np.argsort(time, kind="stable")
    earlier = np.empty_like(order)
    earlier[order] = order[[0, *range(len(order) - 1)]]
    result: Floats = values[earlier]
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class Setup(Rebuilt):
    """What a rig and a session share: a robot, its LEDs, its cameras, and what is thought of them.

    Attributes:
        chain: the joints that are calibrated; a tree of them where LEDs and cameras are on different links.
        leds: on links of the robot, or in the world.
        targets: boards, tags and other rigid bodies with points, there as well.
        led_distances: measured between them.
        place_distances: known between the places that measurements name.
        rig: the cameras; none where something else measures.
        mounts: of the eye-in-hand cameras.
        urdf: the robot description; None for a chain from elsewhere.
        urdf_reference: how the file names it: a path or ``package://``.
        noise: of the measurements.
        estimate: what is to be estimated.
        tolerances: of the robot.
        joint_models: by name, which are estimated (True) or not (False), of all joints or of each by name; of the
            others the measurements decide, of bending only where ``"auto"`` is said.
        payload: what the arm carries.
        payloads: what it carries in each part, where that differs.
        gravity: (3,) in the base link's frame. [m/s^2]
        gear_ratio: turns of the motor for one of the joint, by the joint's name.
        scale_sigma: of the share that the instrument's lengths may be too long by; where nothing is said the rig's,
            or None.
        scene: what stands around the arm, which simulated and planned poses keep clear of.
        about: what else is to be known of it, such as the arm's serial number, the operator and the site.
        sha256: hash of every input file, by the name that the session gives it.
        folder: where it was read from.
        parts: names of what it was measured in: between parts the base, or what the cameras are on, was moved.
    """

    chain: Mechanism
    leds: tuple[Led, ...] = ()
    targets: tuple[Target, ...] = ()
    led_distances: tuple[LedDistance, ...] = ()
    place_distances: tuple[PlaceDistance, ...] = ()
    rig: Rig = field(default_factory=Rig)
    mounts: tuple[CameraMount, ...] = ()
    urdf: Urdf | None = None
    urdf_reference: str = ""
    noise: Noise = field(default_factory=Noise)
    estimate: Estimate = field(default_factory=Estimate)
    tolerances: Tolerances = field(default_factory=Tolerances)
    joint_models: Mapping[str, JointModelSaid] = field(default_factory=dict)
    payload: Payload | None = None
    payloads: tuple[Payload | None, ...] = ()
    gravity: Floats = field(default_factory=lambda: STANDARD_GRAVITY)
    gear_ratio: Mapping[str, float] = field(default_factory=dict)
    scale_sigma: float | None = None
    scene: tuple[Obstacle, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)
    sha256: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None
    parts: tuple[str, ...] = ("",)

    def __post_init__(self) -> None:
        several = ("leds", "targets", "led_distances", "place_distances", "mounts", "scene")
        keep(self, **{name: tuple(getattr(self, name)) for name in several})
        keep(self, **{name: ReadOnly(getattr(self, name)) for name in ("about", "sha256", "joint_models")})
        keep(self, gravity=finite_array(self.gravity, (3,), "gravity", "gravity"), gear_ratio=ReadOnly(self.gear_ratio))
        self._check_load()
        by_joint = {name: of for name, of in self.joint_models.items() if isinstance(of, Mapping)}
        for name, joint in ((name, joint) for name, of in by_joint.items() for joint in of):
            check_known(joint, self.chain.actuated, "joints", f"joint_models.{name}")
        if self.scale_sigma is None:
            keep(self, scale_sigma=self.rig.scale_sigma)
        for name in (name for distance in self.led_distances for name in distance.leds):
            check_known(name, [led.name for led in self.leds], "LEDs", "led_distances")
        check_names("LEDs", self.led_names)
        check_names("boxes of the scene", [box.name for box in self.scene])
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

    def _check_load(self) -> None:
        """Refuse a gravity, payload or gear ratio that cannot be."""
        strength = float(np.linalg.norm(self.gravity))
        if not _GRAVITY[0] <= strength <= _GRAVITY[1]:
            remedy = "Write its vector in the base link's frame, in m/s^2: [0, 0, -9.81] of a base that stands upright."
            raise SessionError(f"gravity of {strength:.4g} m/s^2 is not the Earth's", where="gravity", remedy=remedy)
        if self.payload is not None and self.urdf is None:
            remedy = "Give the setup its URDF, or leave the payload out."
            raise SessionError("without a URDF nothing is known of its link", where="payload", remedy=remedy)
        if self.payload is not None and self.urdf is not None:
            check_known(self.payload.link, tuple(self.urdf.links), "links", "payload.link")
        for joint, ratio in self.gear_ratio.items():
            check_known(joint, self.chain.actuated, "joints", f"gear_ratio.{joint}")
            finite_number(ratio, "the ratio", f"gear_ratio.{joint}", zero=False)

    def of_setup(self, **changes: Any) -> dict[str, Any]:
        """Return what a setup says, by the fields' names, for another session of it, with changes."""
        return {**{entry.name: getattr(self, entry.name) for entry in fields(Setup)}, **changes}

    @cached_property
    def attachments(self) -> Attachments:
        """What LEDs, targets and cameras are attached to."""
        mounts = {mount.camera: mount for mount in self.mounts}
        return attach(self.chain, [led.link for led in self.leds], self.targets, self.rig, mounts, self.parts)

    @cached_property
    def led_names(self) -> tuple[str, ...]:
        """What the tables call the LEDs, then the targets' points, in order."""
        return (*(led.name for led in self.leds), *(name for of in self.targets for name in of.point_names))


@dataclass(frozen=True, eq=False, kw_only=True)
class Positions(Setup):
    """A rig in the positions at which something is measured, or will be: a session whose images are not read yet.

    Attributes:
        poses: (N) labels.
        q: (N, n) value of every joint of the chain in every pose, mimic joints included. [rad or m]
        time: (N,) of each pose, where recorded. [s]
        torques: (N, n) measured joint torques, with the sign that the maker gives them; None where there are none.
            [N m or N]
        previous: (N, n) values of the joints where the arm came from, perhaps in a pose in which nothing was measured;
            None for the poses in order, of time if there is one. [rad or m]
        motion: at rest in every pose, or a trajectory: each pose is then a frame of one camera, q what its log says.
        part: (N,) of each pose; left out: the first.
        moved: by name of an LED or a camera, or "base", the poses before which it moved.
        warnings: what looked odd when it was read.
    """

    poses: tuple[str, ...]
    q: Floats
    time: Floats | None = None
    torques: Floats | None = None
    previous: Floats | None = None
    motion: Motion = AT_REST
    part: Ints = field(default_factory=lambda: np.zeros(0, np.intp))
    moved: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        keep(self, poses=tuple(map(str, self.poses)), moved=ReadOnly(self.moved), warnings=tuple(self.warnings))
        count = len(self.poses)
        if count < MIN_POSES:
            raise SessionError(f"{count} poses are too few", remedy=f"Measure at least {MIN_POSES}, better 30 or more.")
        check_names("poses", self.poses)
        keep(self, q=finite_array(self.q, (count, len(self.chain.joints)), "q", "session"))
        if not np.allclose(self.chain.joint_values(self.readings), self.q, rtol=0.0, atol=_MIMIC_ROUNDING):
            raise SessionError("a mimic joint's value in q is not what it follows from", where="session")
        if self.time is not None:
            keep(self, time=finite_array(self.time, (count,), "time", "session"))
        keep(self, part=frozen(self.part if len(self.parts) > 1 else np.zeros(count), np.intp))
        if self.part.shape != (count,) or not np.isin(self.part, range(len(self.parts))).all():
            raise SessionError(f"part is not the index of one of {len(self.parts)} in each pose", where="session")
        for name in ("torques", "previous"):
            if getattr(self, name) is not None:
                keep(self, **{name: finite_array(getattr(self, name), self.q.shape, name, "session")})
        check_moves(self)

    @property
    def readings(self) -> Floats:
        """(N, k) values [rad or m] of the joints that have a reading of their own, as in joints.csv."""
        return self.chain.readings(self.q)

    @property
    def came_from(self) -> Floats:
        """(N, n) values of the joints before the arm moved to each pose; the first pose's own ones. [rad or m]."""
        return before(self.q, self.time) if self.previous is None else self.previous

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
        keep(self, measurements=numbered_alike(self.measurements))
        if not self.measurements:
            raise SessionError("there are no measurements", remedy="There is nothing to calibrate from.")
        counts = {"pose": len(self.poses), "led": len(self.led_names), "camera": len(self.rig.cameras)}
        counts["target"] = len(self.targets)
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
        places = self.named("place")
        for name in (name for known in self.place_distances for name in known.places if places):
            check_known(name, places, "places", "place_distances")

    def named(self, key: str) -> tuple[str, ...]:
        """Return what only tables name under a key, such as places; all tables of the session number it alike."""
        return next((table.names[key] for table in self.measurements if key in table.names), ())

    def measured_of(self, key: str) -> frozenset[int]:
        """Return the indices under a key of which there are measurements."""
        tables = (table.index[key] for table in self.measurements if key in table.index)
        return frozenset(i for column in tables for i in np.unique(column).tolist())

    def measured_names(self, key: str) -> dict[int, str]:
        """Return by index what tables name under a key, without that of which every measurement was left out."""
        measured = self.measured_of(key)
        return {k: name for k, name in enumerate(self.named(key)) if k in measured}

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
            torques=None if self.torques is None else self.torques[poses],
            previous=self.came_from[poses],
            motion=self.motion.at(poses),
            part=self.part[poses],
            moved=moves_at(self, poses),
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
        usual = {
            of.noise
            for table in self.measurements
            for name, of in table.spread_of().items()
            if np.all(getattr(table, name) == of.usual)
        }
        return frozenset(name for name in (*usual, "joint") if self.noise.said(name) is None)

    def with_noise(self, sigmas: Mapping[str, float]) -> Self:
        """Return the session with standard deviations for some keys of ``noise``, the tables' own included."""
        own = {name: sigmas[name] for name in ("pixel", "point", "joint") if name in sigmas}
        other = {name: sigma for name, sigma in sigmas.items() if name not in own}
        tables = (table.with_noise(sigmas) for table in self.measurements)
        noise = replace(self.noise, **own, other={**self.noise.other, **other})
        return replace(self, measurements=tuple(tables), noise=noise)

    def unmeasured(self) -> Positions:
        """Return the same without its measurements."""
        return Positions(**{f.name: getattr(self, f.name) for f in fields(Positions)})
