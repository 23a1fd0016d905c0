"""The tables of a session: joint readings, frames of a moving arm, and measurements of every kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Points
from urdfcal.estimation.measurements.points import SPREAD, CorrelatedPoints
from urdfcal.io.csv_table import Table, repeats
from urdfcal.names import listed, suggest
from urdfcal.session.model import MIN_POSES
from urdfcal.session.trajectory import LONGEST_GAP, MARGIN, JointLog, Trajectory

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.robot.mechanism import Mechanism

_MISSING = "Leave the row out where nothing was measured."
# What is named elsewhere: in joints.csv, the camera file and session.yaml.
_KNOWN = {"pose": "poses of joints.csv", "camera": "cameras", "led": "LEDs", "target": "targets"}
_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# Robots report their joints at 10 Hz to 1 kHz: in milliseconds that is 1 to 100 a reading.
_FASTEST = 0.9e-3
# Most frames of a camera lie within the log once their unit is right.
_MOST = 0.5


@dataclass(frozen=True, eq=False)
class JointTable:
    """joints.csv, of an arm at rest by pose and of a moving one by time.

    Attributes:
        table: its text.
        readings: (N, k) of the chain's actuated joints, in the chain's order. [rad or m]
        warnings: columns that were ignored.
        poses: (N) labels; none of a moving arm.
        time: (N,) where recorded. [s]
    """

    table: Table
    readings: Floats
    warnings: tuple[str, ...]
    poses: tuple[str, ...] = ()
    time: Floats | None = None


@dataclass(frozen=True, eq=False)
class FrameTable:
    """frames.csv, with the joint values of its frames.

    Attributes:
        table: its text.
        trajectory: the frames for which there are joint values.
        pose: which of them each frame of the table is, by camera and label; -1 if none.
        warnings: of the others.
    """

    table: Table
    trajectory: Trajectory
    pose: Mapping[tuple[int, str], int]
    warnings: tuple[str, ...]

    def poses(self, table: Table, camera: Ints, cameras: Sequence[str]) -> Ints:
        """The pose of each row (S,) of a table that has a column of frames.

        Args:
            table: with a column ``pose`` of labels.
            camera: (S,) of each row.
            cameras: their names.

        Raises:
            SessionError: there is no such frame, or there are joint values for none, with the place in the file.
        """
        poses = []
        for row, key in enumerate(zip(camera.tolist(), table.labels("pose"), strict=True)):
            if key not in self.pose:
                c, name = key
                known = [frame for of, frame in self.pose if of == c]
                remedy = suggest(name, known, f"frames in {self.table.path.name}")
                raise table.wrong(f"camera {cameras[c]!r} has no frame {name!r}", row, "pose", remedy)
            poses.append(self.pose[key])
        if max(poses) < 0:
            what = "no LED was seen in a frame for which there are joint readings"
            remedy = "Do the times of cameras and robot count from the same moment?"
            raise SessionError(what, where=str(table.path), remedy=remedy)
        return np.array(poses, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class MeasurementTable:
    """A table of measurements of one kind.

    Attributes:
        table: its text.
        rows: (S,) row of the table that each measurement comes from.
        measurements: sorted by their keys.
        names: what their indices stand for, by column.
    """

    table: Table
    rows: Ints
    measurements: Measurement
    names: Mapping[str, Sequence[str]]

    def place(self, measurement: int, column: str) -> str:
        """Where a cell of a measurement is: file:line:column."""
        return self.table.place(int(self.rows[measurement]), column)

    def only(self, kept: Bools) -> MeasurementTable:
        """Return some of the measurements, by a mask (S,) that is true somewhere."""
        return self if kept.all() else replace(self, rows=self.rows[kept], measurements=self.measurements.rows(kept))

    def first(self, measurements: Ints) -> int:
        """Which of some measurements comes first in the file."""
        return int(measurements[np.argmin(self.rows[measurements])])


def read_joints(path: Path, chain: Mechanism, robot_joints: Collection[str], *, moving: bool = False) -> JointTable:
    """Read joints.csv.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored, with a warning.
        moving: whether the arm moved: its readings have times instead of poses.

    Raises:
        SessionError: with the place in the file.
    """
    others = set(robot_joints) - set(chain.actuated)
    table = Table.read(path, ["time" if moving else "pose", *chain.actuated], () if moving else ["time"], others)
    follow = {joint.name: f"follows {joint.mimic.joint!r}" for joint in chain.joints if joint.mimic}
    elsewhere = f"is not between {chain.base_link!r} and {chain.tip_link!r}"
    warnings = tuple(
        f"{path}: the column {name!r} is ignored: the joint {follow.get(name, elsewhere)}"
        for name in table.columns
        if name in others
    )
    poses = () if moving else table.labels("pose")
    for first, row in repeats(poses)[:1]:
        what = f"pose {poses[row]!r} is already in line {first + 2}"
        raise table.wrong(what, row, "pose", "Give every pose its own label.")
    if not moving and len(poses) < MIN_POSES:
        remedy = f"Measure at least {MIN_POSES}, better 30 or more."
        raise SessionError(f"{len(poses)} poses are too few", where=str(path), remedy=remedy)
    time = frozen(table.numbers(["time"])[:, 0]) if "time" in table.columns else None
    return JointTable(table, frozen(table.numbers(chain.actuated)), warnings, poses, time)


def read_by_pose(
    path: Path, chain: Mechanism, robot_joints: Collection[str], poses: Sequence[str]
) -> tuple[Table, Ints, Floats]:
    """Read a table with a number for each joint in some poses: torques.csv or previous.csv.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored.
        poses: labels of joints.csv.

    Returns:
        The table, the pose (R,) of each row, and the numbers (R, k) of the actuated joints.

    Raises:
        SessionError: a pose is unknown or has two rows, or a number is none, with the place in the file.
    """
    table = Table.read(path, ["pose", *chain.actuated], (), set(robot_joints) - set(chain.actuated))
    rows = table.indices("pose", poses, _KNOWN["pose"])
    for first, row in repeats(rows.tolist())[:1]:
        what = f"pose {poses[rows[row]]!r} is already in line {first + 2}"
        raise table.wrong(what, row, "pose", "Keep one.")
    return table, rows, table.numbers(chain.actuated)


def read_measurements(
    path: Path,
    kind: type[Measurement],
    known: Mapping[str, Sequence[str]],
    sigma: float | Mapping[str, float],
    frames: FrameTable | None = None,
) -> MeasurementTable:
    """Read a table of measurements, and sort it.

    Args:
        path: the file.
        kind: of the measurements.
        known: the names that there are, by column; columns without an entry take those in the file, as they come.
        sigma: standard deviation where the table has no such column, or of each such column. [unit of the kind]
        frames: of a moving arm, which its poses are; what was seen in those without joint values is left out.

    Raises:
        SessionError: a name is unknown, a number is none, or there are two measurements of the same, with the place
            in the file.
    """
    correlated = SPREAD if kind is Points else ()
    table = Table.read(path, [*kind.keys, *kind.columns], [*kind.spread_of(), *correlated])
    names = {key: tuple(known[key] if key in known else dict.fromkeys(table.labels(key))) for key in kind.keys}
    looked_up = [key for key in kind.keys if frames is None or key != "pose"]
    index = {key: table.indices(key, names[key], _KNOWN.get(key, f"{key}s")) for key in looked_up}
    if frames is not None:
        index["pose"] = frames.poses(table, index["camera"], names["camera"])
    numbers = table.numbers(kind.columns, _MISSING, positive=kind.positive)
    usual = sigma if isinstance(sigma, Mapping) else dict.fromkeys(kind.spread_of(), sigma)
    spread = {
        name: table.numbers([name], positive=True)[:, 0]
        if name in table.columns
        else np.full(len(numbers), usual[name])
        for name in kind.spread_of()
    }
    covariance = _covariances(table) if set(correlated) & set(table.columns) else None
    order = np.lexsort([index[key] for key in reversed(kind.keys)])
    order = order[index["pose"][order] >= 0]
    # lexsort is stable: of equal measurements the second comes later in the file.
    same = np.logical_and.reduce([np.diff(column[order]) == 0 for column in index.values()])
    for first, second in zip(order[:-1][same].tolist(), order[1:][same].tolist(), strict=True):
        what = ", ".join(f"{key} {table.columns[key][second].strip()!r}" for key in kind.keys)
        raise table.wrong(f"{what} is already in line {first + 2}", second, "pose", "Keep one.")
    columns = {key: column[order] for key, column in index.items()} | {name: of[order] for name, of in spread.items()}
    if kind.array:
        columns[kind.array] = numbers[order]
    own_names = {key: of for key, of in names.items() if key not in _KNOWN}
    measured: Measurement
    if covariance is None:
        measured = kind(**columns, names=own_names)  # type: ignore[arg-type]
    else:
        measured = CorrelatedPoints.of_spread(covariance[order], **columns)
    return MeasurementTable(table, frozen(order, np.intp), measured, names)


def _covariances(table: Table) -> Floats:
    """The covariances of points, (rows, 6) as in ``SPREAD``; each positive definite. [m^2]."""
    missing = [name for name in SPREAD if name not in table.columns]
    if missing or "sigma" in table.columns:
        what = f"the columns are missing: {', '.join(missing)}" if missing else "sigma and a covariance say the same"
        remedy = f"Write sigma, or {', '.join(SPREAD)}: a covariance in m^2."
        raise SessionError(what, where=f"{table.path}:1", remedy=remedy)
    found = table.numbers(SPREAD, _MISSING)
    least = np.linalg.eigvalsh(found[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])[:, 0]
    for row in np.flatnonzero(least <= 0.0)[:1].tolist():
        what = "the covariance is not positive definite: along some direction its variance is none"
        raise table.wrong(what, row, "sxx", f"Write {', '.join(SPREAD)} in m^2.")
    return found


def read_log(path: Path, chain: Mechanism, robot_joints: Collection[str]) -> tuple[JointTable, JointLog]:
    """Read joints.csv of a moving arm.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored, with a warning.

    Returns:
        The table, and the motion of all joints of the chain, those without limits without jumps of a turn.

    Raises:
        SessionError: with the place in the file: time that repeats, runs backward, or is not in seconds.
    """
    joints = read_joints(path, chain, robot_joints, moving=True)
    table, time = joints.table, np.asarray(joints.time)
    if len(time) < 2:
        raise SessionError("one reading is no motion", where=str(path), remedy="Record the joints at their own rate.")
    _check_increasing(table, time, np.arange(len(time)), "the joints")
    usual = float(np.median(np.diff(time)))
    if usual > LONGEST_GAP:
        unit = next((name for name, factor in _UNITS.items() if _FASTEST <= usual * factor <= LONGEST_GAP), None)
        if unit is not None:
            what = f"time: it advances by {usual:g} a reading, which looks like {unit}"
            raise table.wrong(what, 1, "time", f"Write seconds, with a reading every {LONGEST_GAP:g} s or more often.")
        what = f"the joints were read every {usual:g} s, which is too seldom to interpolate between"
        raise SessionError(what, where=str(path), remedy=f"Record them every {LONGEST_GAP:g} s or more often.")
    endless = [joint.type == "continuous" for joint in chain.joints if joint.mimic is None]
    readings = np.where(endless, np.unwrap(joints.readings, axis=0), joints.readings)
    return joints, JointLog(time, chain.joint_values(readings))


def read_frames(path: Path, cameras: Sequence[str], joints: JointTable, log: JointLog) -> FrameTable:
    """Read frames.csv, and find the joint values of every frame, as far as they were recorded.

    Args:
        path: the file.
        cameras: names that there are.
        joints: the joint readings.
        log: the motion that they tell.

    Raises:
        SessionError: with the place in the file: a label that comes twice, time that repeats or runs backward, or
            there are joint values for next to none.
    """
    table = Table.read(path, ["camera", "frame", "time"])
    camera, frame = table.indices("camera", cameras, "cameras"), table.labels("frame")
    time = table.numbers(["time"])[:, 0]
    row, labels = np.empty(len(time), dtype=np.intp), []
    for c, name in enumerate(cameras):
        mine = np.flatnonzero(camera == c)
        row[mine] = np.arange(len(mine))
        labels.append(tuple(frame[i] for i in mine))
        _check_increasing(table, time[mine], mine, f"camera {name!r}")
    keys = list(zip(camera.tolist(), frame, strict=True))
    for first, i in repeats(keys)[:1]:
        what = f"frame {frame[i]!r} of camera {cameras[camera[i]]!r} is already in line {first + 2}"
        raise table.wrong(what, i, "frame", "Give every frame of a camera its own label.")
    covered = log.covers(time)
    if np.count_nonzero(covered) < MIN_POSES:
        raise _apart(table, time, log, int(np.count_nonzero(covered)))
    trajectory = Trajectory(log, tuple(labels), camera[covered], row[covered], time[covered])
    pose = np.where(covered, np.cumsum(covered) - 1, -1).tolist()
    warnings = []
    outside = (time < log.time[0] + MARGIN) | (time > log.time[-1] - MARGIN)
    if count := int(np.count_nonzero(outside)):
        names = listed(sorted({cameras[c] for c in camera[outside]}))
        warnings.append(
            f"{path}: {count} of {len(outside)} frames ({names}) lie outside of the joint readings' time, "
            f"or within {MARGIN:g} s of its ends, and were left out"
        )
    step = np.diff(log.time)
    for gap in np.flatnonzero(step > LONGEST_GAP)[:1]:
        warnings.append(
            f"{joints.table.place(int(gap) + 1, 'time')}: {np.count_nonzero(step > LONGEST_GAP)} gaps of up to "
            f"{step.max():.3g} s in the joint readings: {np.count_nonzero(~covered & ~outside)} frames in or beside "
            "them were left out"
        )
    return FrameTable(table, trajectory, dict(zip(keys, pose, strict=True)), tuple(warnings))


def _check_increasing(table: Table, time: Floats, rows: Ints, whose: str) -> None:
    step = np.diff(time)
    for i in np.flatnonzero(step <= 0.0)[:1]:
        what = "is the same as" if step[i] == 0.0 else f"is {-step[i]:g} s before that"
        what = f"time: that of {whose} {what} in line {rows[i] + 2}"
        raise table.wrong(what, int(rows[i + 1]), "time", "Rows come in the order of time, each time once.")


def _apart(table: Table, time: Floats, log: JointLog, count: int) -> SessionError:
    """Why frames and joint readings do not belong together: another unit, or another clock."""
    first, last = log.time[[0, -1]]
    for unit, factor in _UNITS.items():
        if np.mean((time * factor >= first) & (time * factor <= last)) > _MOST:
            return table.wrong(f"time: {time[0]:g} looks like {unit}", 0, "time", "Write seconds.")
    return SessionError(
        f"for {count} of {len(time)} frames there are joint readings: frames are from {time.min():.10g} "
        f"to {time.max():.10g} s, readings from {first:.10g} to {last:.10g} s",
        where=str(table.path),
        remedy="Both times must count from the same moment, give or take a second, and overlap.",
    )
