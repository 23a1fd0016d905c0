"""The tables of a moving arm: joints.csv by time and frames.csv, and what they make together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.csv_table import Table
from urdfcal.io.tables import MeasurementTable, ignored_columns, sorted_measurements
from urdfcal.names import listed, suggest
from urdfcal.session.model import MIN_POSES
from urdfcal.session.trajectory import LONGEST_GAP, MARGIN, JointLog, Trajectory

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from urdfcal.robot.mechanism import Mechanism

STILL = 1e-3
"""An arm whose joints move by less between two frames may look the same in both. [rad or m]"""

_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# Robots report their joints at 10 Hz to 1 kHz: in milliseconds that is 1 to 100 a reading.
_FASTEST = 0.9e-3
# Most frames of a camera lie within the log once their unit is right.
_MOST = 0.5


@dataclass(frozen=True, eq=False)
class LogTable:
    """joints.csv of a moving arm.

    Attributes:
        table: its text.
        time: (K,) strictly increasing. [s]
        readings: (K, k) of the chain's actuated joints, in the chain's order. [rad or m]
        warnings: columns that were ignored.
    """

    table: Table
    time: Floats
    readings: Floats
    warnings: tuple[str, ...]

    def log(self, chain: Mechanism) -> JointLog:
        """The motion of all joints of the chain, those without limits without jumps of a turn."""
        endless = [joint.type == "continuous" for joint in chain.joints if joint.mimic is None]
        return JointLog(
            self.time, chain.joint_values(np.where(endless, np.unwrap(self.readings, axis=0), self.readings))
        )


@dataclass(frozen=True, eq=False)
class FrameTable:
    """frames.csv.

    Attributes:
        table: its text.
        cameras: names that there are.
        camera: (F,) of each frame.
        frame: F labels, unique for each camera.
        row: (F,) which of its camera's frames it is.
        time: (F,) on the camera's clock; it increases for each camera. [s]
    """

    table: Table
    cameras: tuple[str, ...]
    camera: Ints
    frame: tuple[str, ...]
    row: Ints
    time: Floats


def read_log(path: Path, chain: Mechanism, robot_joints: Collection[str]) -> LogTable:
    """Read joints.csv of a moving arm.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored, with a warning.

    Raises:
        SessionError: with the place in the file: time that repeats, runs backward, or is not in seconds.
    """
    others = set(robot_joints) - set(chain.actuated)
    table = Table.read(path, ["time", *chain.actuated], (), others)
    time = table.numbers(["time"])[:, 0]
    if len(time) < 2:
        raise SessionError("one reading is no motion", where=str(path), remedy="Record the joints at their own rate.")
    _check_increasing(table, time, np.arange(len(time)), "the joints")
    usual = float(np.median(np.diff(time)))
    if usual > LONGEST_GAP:
        unit = next((name for name, factor in _UNITS.items() if _FASTEST <= usual * factor <= LONGEST_GAP), None)
        if unit is not None:
            raise SessionError(
                f"time: it advances by {usual:g} a reading, which looks like {unit}",
                where=table.place(1, "time"),
                remedy=f"Write seconds, with a reading every {LONGEST_GAP:g} s or more often.",
            )
        raise SessionError(
            f"the joints were read every {usual:g} s, which is too seldom to interpolate between",
            where=str(path),
            remedy=f"Record them every {LONGEST_GAP:g} s or more often.",
        )
    return LogTable(table, frozen(time), frozen(table.numbers(chain.actuated)), ignored_columns(table, chain, others))


def read_frames(path: Path, cameras: Sequence[str]) -> FrameTable:
    """Read frames.csv.

    Args:
        path: the file.
        cameras: names that there are.

    Raises:
        SessionError: with the place in the file: a label that comes twice, or time that repeats or runs backward.
    """
    table = Table.read(path, ["camera", "frame", "time"])
    camera, frame = table.indices("camera", cameras, "cameras"), table.labels("frame")
    time = table.numbers(["time"])[:, 0]
    row = np.empty(len(time), dtype=np.intp)
    for c, name in enumerate(cameras):
        mine = np.flatnonzero(camera == c)
        row[mine] = np.arange(len(mine))
        _check_increasing(table, time[mine], mine, f"camera {name!r}")
    first: dict[tuple[int, str], int] = {}
    for i, key in enumerate(zip(camera.tolist(), frame, strict=True)):
        if first.setdefault(key, i) != i:
            raise SessionError(
                f"frame {key[1]!r} of camera {cameras[key[0]]!r} is already in line {first[key] + 2}",
                where=table.place(i, "frame"),
                remedy="Give every frame of a camera its own label.",
            )
    return FrameTable(table, tuple(cameras), camera, frame, row, frozen(time))


def combine(log_table: LogTable, frames: FrameTable, chain: Mechanism) -> tuple[Trajectory, Ints, tuple[str, ...]]:
    """Find the joint values of every frame, as far as they were recorded.

    Returns:
        The frames for which there are joint values; (F,) which of them each frame of the table is, -1 if none;
        and warnings of the others.

    Raises:
        SessionError: there are next to none.
    """
    log = log_table.log(chain)
    covered = log.covers(frames.time)
    if np.count_nonzero(covered) < MIN_POSES:
        raise _apart(log_table, frames, int(np.count_nonzero(covered)))
    labels = tuple(
        tuple(frames.frame[i] for i in np.flatnonzero(frames.camera == c)) for c in range(len(frames.cameras))
    )
    trajectory = Trajectory(log, labels, frames.camera[covered], frames.row[covered], frames.time[covered])
    pose = np.where(covered, np.cumsum(covered) - 1, -1)
    return trajectory, pose, tuple(_left_out(log_table, frames, covered))


def read_frame_detections(
    path: Path, frames: FrameTable, pose: Ints, leds: Sequence[str], sigma: float
) -> MeasurementTable:
    """Read detections.csv of a moving arm; detections in frames without joint values are left out.

    Args:
        path: the file.
        frames: to which its labels refer.
        pose: (F,) index of the pose of each frame, -1 if it has none.
        leds: names that there are.
        sigma: standard deviation where the table has no such column. [px]

    Raises:
        SessionError: with the place in the file.
    """
    table = Table.read(path, ["pose", "camera", "led", "u", "v"], ["sigma"])
    camera, led = table.indices("camera", frames.cameras, "cameras"), table.indices("led", leds, "LEDs")
    row_of = {key: i for i, key in enumerate(zip(frames.camera.tolist(), frames.frame, strict=True))}
    rows = [row_of.get(key, -1) for key in zip(camera.tolist(), table.labels("pose"), strict=True)]
    if -1 in rows:
        unknown = rows.index(-1)
        name, c = table.columns["pose"][unknown].strip(), int(camera[unknown])
        known = [frame for frame, of in zip(frames.frame, frames.camera.tolist(), strict=True) if of == c]
        raise SessionError(
            f"camera {frames.cameras[c]!r} has no frame {name!r}",
            where=table.place(unknown, "pose"),
            remedy=suggest(name, known, f"frames in {frames.table.path.name}"),
        )
    index = {"pose": pose[rows], "camera": camera, "led": led}
    if np.all(index["pose"] < 0):
        raise SessionError(
            "no LED was seen in a frame for which there are joint readings",
            where=str(path),
            remedy="Do the times of cameras and robot count from the same moment?",
        )
    kept = tuple(frame for frame, k in zip(frames.frame, pose.tolist(), strict=True) if k >= 0)
    names = {"pose": kept, "camera": frames.cameras, "led": tuple(leds)}
    return sorted_measurements(table, Detections, index, names, sigma)


def _check_increasing(table: Table, time: Floats, rows: Ints, whose: str) -> None:
    step = np.diff(time)
    if not step.size or step.min() > 0.0:
        return
    i = int(np.flatnonzero(step <= 0.0)[0])
    what = "is the same as" if step[i] == 0.0 else f"is {-step[i]:g} s before that"
    raise SessionError(
        f"time: that of {whose} {what} in line {rows[i] + 2}",
        where=table.place(int(rows[i + 1]), "time"),
        remedy="Rows come in the order of time, each time once.",
    )


def _apart(log: LogTable, frames: FrameTable, count: int) -> SessionError:
    """Why frames and joint readings do not belong together: another unit, or another clock."""
    first, last = log.time[[0, -1]]
    for unit, factor in _UNITS.items():
        scaled = frames.time * factor
        if np.mean((scaled >= first) & (scaled <= last)) > _MOST:
            return SessionError(
                f"time: {frames.time[0]:g} looks like {unit}",
                where=frames.table.place(0, "time"),
                remedy="Write seconds.",
            )
    return SessionError(
        f"for {count} of {len(frames.time)} frames there are joint readings: frames are from {frames.time.min():.10g} "
        f"to {frames.time.max():.10g} s, readings from {first:.10g} to {last:.10g} s",
        where=str(frames.table.path),
        remedy="Both times must count from the same moment, give or take a second, and overlap.",
    )


def _left_out(log: LogTable, frames: FrameTable, covered: Bools) -> list[str]:
    outside = (frames.time < log.time[0] + MARGIN) | (frames.time > log.time[-1] - MARGIN)
    gaps = np.flatnonzero(np.diff(log.time) > LONGEST_GAP)
    warnings = []
    if count := int(np.count_nonzero(outside)):
        names = listed(sorted({frames.cameras[c] for c in frames.camera[outside]}))
        warnings.append(
            f"{frames.table.path}: {count} of {len(outside)} frames ({names}) lie outside of the joint readings' time, "
            f"or within {MARGIN:g} s of its ends, and were left out"
        )
    if gaps.size:
        longest = float(np.diff(log.time)[gaps].max())
        count = int(np.count_nonzero(~covered & ~outside))
        warnings.append(
            f"{log.table.place(int(gaps[0]) + 1, 'time')}: {len(gaps)} gaps of up to {longest:.3g} s in the joint "
            f"readings: {count} frames in or beside them were left out"
        )
    return warnings
