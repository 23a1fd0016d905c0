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

    @classmethod
    def read(
        cls, path: Path, chain: Mechanism, robot_joints: Collection[str], required: str, optional: Sequence[str] = ()
    ) -> JointTable:
        """Read joint readings, with a warning for each column that does not matter and why.

        Args:
            path: the file.
            chain: whose actuated joints must each have a column.
            robot_joints: names of all joints of the robot; columns of those off the chain are ignored.
            required: name of the column that must be there, too, pose or time.
            optional: names of columns that may be there.

        Raises:
            SessionError: with the place in the file.
        """
        others = set(robot_joints) - set(chain.actuated)
        table = Table.read(path, [required, *chain.actuated], optional, others)
        follow = {joint.name: f"follows {joint.mimic.joint!r}" for joint in chain.joints if joint.mimic}
        elsewhere = f"is not between {chain.base_link!r} and {chain.tip_link!r}"
        warnings = tuple(
            f"{path}: the column {name!r} is ignored: the joint {follow.get(name, elsewhere)}"
            for name in table.columns
            if name in others
        )
        time = frozen(table.numbers(["time"])[:, 0]) if "time" in table.columns else None
        poses = table.labels("pose") if "pose" in table.columns else ()
        return cls(table, frozen(table.numbers(chain.actuated)), warnings, poses, time)


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


def read_joints(path: Path, chain: Mechanism, robot_joints: Collection[str]) -> JointTable:
    """Read joints.csv.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored, with a warning.

    Raises:
        SessionError: with the place in the file.
    """
    joints = JointTable.read(path, chain, robot_joints, "pose", ["time"])
    for first, row in repeats(joints.poses)[:1]:
        what = f"pose {joints.poses[row]!r} is already in line {first + 2}"
        raise joints.table.wrong(what, row, "pose", "Give every pose its own label.")
    if len(joints.poses) < MIN_POSES:
        remedy = f"Measure at least {MIN_POSES}, better 30 or more."
        raise SessionError(f"{len(joints.poses)} poses are too few", where=str(path), remedy=remedy)
    return joints


def read_measurements(
    path: Path, kind: type[Measurement], known: Mapping[str, Sequence[str]], sigma: float
) -> MeasurementTable:
    """Read a table of measurements.

    Args:
        path: the file.
        kind: of the measurements.
        known: the names that there are, by column; columns without an entry take those in the file, as they come.
        sigma: standard deviation where the table has no such column. [unit of the kind]

    Raises:
        SessionError: with the place in the file.
    """
    table = Table.read(path, [*kind.keys, *kind.columns], ["sigma"])
    names = {key: tuple(known[key] if key in known else dict.fromkeys(table.labels(key))) for key in kind.keys}
    index = {key: table.indices(key, names[key], _KNOWN.get(key, f"{key}s")) for key in kind.keys}
    return sorted_measurements(table, kind, index, names, sigma)


def sorted_measurements(
    table: Table,
    kind: type[Measurement],
    index: Mapping[str, Ints],
    names: Mapping[str, Sequence[str]],
    sigma: float,
) -> MeasurementTable:
    """Read the numbers of a table of measurements, and sort it.

    Args:
        table: the file.
        kind: of the measurements.
        index: what is measured, by column, each of all rows; rows with a negative one are left out.
        names: what the indices stand for.
        sigma: standard deviation where the table has no such column. [unit of the kind]

    Raises:
        SessionError: a number is none, or there are two measurements of the same, with the place in the file.
    """
    numbers = table.numbers(kind.columns, _MISSING)
    own = "sigma" in table.columns
    spread = table.numbers(["sigma"], positive=True)[:, 0] if own else np.full(len(numbers), sigma)
    order = np.lexsort([index[key] for key in reversed(list(index))])
    order = order[np.logical_and.reduce([index[key][order] >= 0 for key in index])]
    # lexsort is stable: of equal measurements the second comes later in the file.
    same = np.logical_and.reduce([np.diff(column[order]) == 0 for column in index.values()])
    for first, second in zip(order[:-1][same].tolist(), order[1:][same].tolist(), strict=True):
        what = ", ".join(f"{key} {table.columns[key][second].strip()!r}" for key in index)
        raise table.wrong(f"{what} is already in line {first + 2}", second, "pose", "Keep one.")
    columns = {key: column[order] for key, column in index.items()} | {"sigma": spread[order]}
    if kind.array:
        columns[kind.array] = numbers[order]
    own_names = {key: of for key, of in names.items() if key not in _KNOWN}
    measurements = kind(**columns, names=own_names)  # type: ignore[arg-type]
    return MeasurementTable(table, frozen(order, np.intp), measurements, names)
