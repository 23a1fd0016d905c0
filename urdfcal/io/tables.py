"""The tables of a session: joint readings, and measurements of every kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.errors import SessionError
from urdfcal.io.csv_table import Table, repeats
from urdfcal.session.model import MIN_POSES

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.frame_tables import FrameTable
    from urdfcal.robot.mechanism import Mechanism

_MISSING = "Leave the row out where nothing was measured."
# What is named elsewhere: in joints.csv, the camera file and session.yaml.
_KNOWN = {"pose": "poses of joints.csv", "camera": "cameras", "led": "LEDs"}


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


def read_measurements(
    path: Path,
    kind: type[Measurement],
    known: Mapping[str, Sequence[str]],
    sigma: float,
    frames: FrameTable | None = None,
) -> MeasurementTable:
    """Read a table of measurements, and sort it.

    Args:
        path: the file.
        kind: of the measurements.
        known: the names that there are, by column; columns without an entry take those in the file, as they come.
        sigma: standard deviation where the table has no such column. [unit of the kind]
        frames: of a moving arm, which its poses are; what was seen in those without joint values is left out.

    Raises:
        SessionError: a name is unknown, a number is none, or there are two measurements of the same, with the place
            in the file.
    """
    table = Table.read(path, [*kind.keys, *kind.columns], ["sigma"])
    names = {key: tuple(known[key] if key in known else dict.fromkeys(table.labels(key))) for key in kind.keys}
    looked_up = [key for key in kind.keys if frames is None or key != "pose"]
    index = {key: table.indices(key, names[key], _KNOWN.get(key, f"{key}s")) for key in looked_up}
    if frames is not None:
        index["pose"] = frames.poses(table, index["camera"], names["camera"])
    numbers = table.numbers(kind.columns, _MISSING)
    own = "sigma" in table.columns
    spread = table.numbers(["sigma"], positive=True)[:, 0] if own else np.full(len(numbers), sigma)
    order = np.lexsort([index[key] for key in reversed(kind.keys)])
    order = order[index["pose"][order] >= 0]
    # lexsort is stable: of equal measurements the second comes later in the file.
    same = np.logical_and.reduce([np.diff(column[order]) == 0 for column in index.values()])
    for first, second in zip(order[:-1][same].tolist(), order[1:][same].tolist(), strict=True):
        what = ", ".join(f"{key} {table.columns[key][second].strip()!r}" for key in kind.keys)
        raise table.wrong(f"{what} is already in line {first + 2}", second, "pose", "Keep one.")
    columns = {key: column[order] for key, column in index.items()} | {"sigma": spread[order]}
    if kind.array:
        columns[kind.array] = numbers[order]
    own_names = {key: of for key, of in names.items() if key not in _KNOWN}
    return MeasurementTable(table, frozen(order, np.intp), kind(**columns, names=own_names), names)  # type: ignore[arg-type]
