"""The tables of a moving arm: joints.csv by time and frames.csv, and what they make together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.io.csv_table import Table, repeats
from urdfcal.io.tables import JointTable, read_joints
from urdfcal.names import listed, suggest
from urdfcal.session.model import MIN_POSES
from urdfcal.session.trajectory import LONGEST_GAP, MARGIN, JointLog, Trajectory

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.robot.mechanism import Mechanism

_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# Robots report their joints at 10 Hz to 1 kHz: in milliseconds that is 1 to 100 a reading.
_FASTEST = 0.9e-3
# Most frames of a camera lie within the log once their unit is right.
_MOST = 0.5


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
            raise SessionError(
                "no LED was seen in a frame for which there are joint readings",
                where=str(table.path),
                remedy="Do the times of cameras and robot count from the same moment?",
            )
        return np.array(poses, dtype=np.intp)


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
        raise SessionError(
            f"the joints were read every {usual:g} s, which is too seldom to interpolate between",
            where=str(path),
            remedy=f"Record them every {LONGEST_GAP:g} s or more often.",
        )
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
    outside = (time < log.time[0] + MARGIN) | (time > log.time[-1] - MARGIN)
    names = listed(sorted({cameras[c] for c in camera[outside]}))
    warnings = _left_out(table, joints.table, log, names, covered, outside)
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


def _left_out(
    frames: Table, joints: Table, log: JointLog, cameras: str, covered: Bools, outside: Bools
) -> Iterator[str]:
    if count := int(np.count_nonzero(outside)):
        yield (
            f"{frames.path}: {count} of {len(outside)} frames ({cameras}) lie outside of the joint readings' time, "
            f"or within {MARGIN:g} s of its ends, and were left out"
        )
    step = np.diff(log.time)
    gaps = np.flatnonzero(step > LONGEST_GAP)
    if gaps.size:
        yield (
            f"{joints.place(int(gaps[0]) + 1, 'time')}: {len(gaps)} gaps of up to {step.max():.3g} s in the joint "
            f"readings: {np.count_nonzero(~covered & ~outside)} frames in or beside them were left out"
        )
