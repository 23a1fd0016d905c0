"""The tables of a session: joint readings, and measurements of every kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, frozen
from urdfcal.errors import SessionError
from urdfcal.io.csv_table import Table
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
    """joints.csv.

    Attributes:
        table: its text.
        poses: (N) labels.
        readings: (N, k) of the chain's actuated joints, in the chain's order. [rad or m]
        time: (N,) where recorded. [s]
        warnings: columns that were ignored.
    """

    table: Table
    poses: tuple[str, ...]
    readings: Floats
    time: Floats | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MeasurementTable:
    """A table of measurements of one kind, sorted by its keys.

    Attributes:
        kind: of what was measured.
        table: its text.
        rows: (S,) row of the table that each measurement comes from.
        index: the indices by column: pose, camera, led, ..., each (S,).
        names: what the indices stand for, by column.
        values: (S, D) what was measured. [unit of the kind]
        sigma: (S,) of each number; where the table has none, the same for all. [unit of the kind]
    """

    kind: type[Measurement]
    table: Table
    rows: Ints
    index: Mapping[str, Ints]
    names: Mapping[str, tuple[str, ...]]
    values: Floats
    sigma: Floats

    def place(self, measurement: int, column: str) -> str:
        """Where a cell of a measurement is: file:line:column."""
        return self.table.place(int(self.rows[measurement]), column)

    @property
    def measurements(self) -> Measurement:
        """The measurements of the table."""
        own = {key: names for key, names in self.names.items() if key not in _KNOWN}
        values = {self.kind.array: self.values} if self.kind.array else {}
        return self.kind(**{**self.index, **values, "sigma": self.sigma, "names": own})  # type: ignore[arg-type]


def read_joints(path: Path, chain: Mechanism, robot_joints: Collection[str]) -> JointTable:
    """Read joints.csv.

    Args:
        path: the file.
        chain: whose actuated joints must each have a column.
        robot_joints: names of all joints of the robot; columns of those off the chain are ignored, with a warning.

    Raises:
        SessionError: with the place in the file.
    """
    names = chain.actuated
    others = set(robot_joints) - set(names)
    table = Table.read(path, ["pose", *names], ["time"], others)
    poses = table.labels("pose")
    first: dict[str, int] = {}
    for row, pose in enumerate(poses):
        if first.setdefault(pose, row) != row:
            raise SessionError(
                f"pose {pose!r} is already in line {first[pose] + 2}",
                where=table.place(row, "pose"),
                remedy="Give every pose its own label.",
            )
    if len(poses) < MIN_POSES:
        raise SessionError(
            f"{len(poses)} poses are too few",
            where=str(path),
            remedy=f"Measure at least {MIN_POSES}, better 30 or more.",
        )
    return JointTable(
        table,
        poses,
        frozen(table.numbers(names)),
        frozen(table.numbers(["time"])[:, 0]) if "time" in table.columns else None,
        ignored_columns(table, chain, others),
    )


def ignored_columns(table: Table, chain: Mechanism, others: Collection[str]) -> tuple[str, ...]:
    """Say which columns of joint readings do not matter, those of ``others``, and why."""
    following = {joint.name: joint.mimic.joint for joint in chain.joints if joint.mimic}
    return tuple(
        f"{table.path}: the column {name!r} is ignored: "
        + (
            f"the joint follows {following[name]!r}"
            if name in following
            else f"the joint is not between {chain.base_link!r} and {chain.tip_link!r}"
        )
        for name in table.columns
        if name in others
    )


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
    names: Mapping[str, tuple[str, ...]],
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
    count = len(table.lines) - 1
    numbers = table.numbers(kind.columns, _MISSING) if kind.columns else np.zeros((count, kind.dimension))
    spread = table.positive("sigma") if "sigma" in table.columns else np.full(count, sigma)
    order = np.lexsort([index[key] for key in reversed(list(index))])
    order = order[np.logical_and.reduce([index[key][order] >= 0 for key in index])]
    index = {key: frozen(column[order], np.intp) for key, column in index.items()}
    twice = np.flatnonzero(np.logical_and.reduce([np.diff(column) == 0 for column in index.values()]))
    if twice.size:
        # lexsort is stable: of equal measurements the second comes later in the file.
        first, second = int(order[twice[0]]), int(order[twice[0] + 1])
        what = ", ".join(f"{key} {table.columns[key][second].strip()!r}" for key in index)
        raise SessionError(
            f"{what} is already in line {first + 2}", where=table.place(second, "pose"), remedy="Keep one."
        )
    numbers, spread = frozen(numbers[order]), frozen(spread[order])
    return MeasurementTable(kind, table, frozen(order, np.intp), index, names, numbers, spread)
