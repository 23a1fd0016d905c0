"""A table of joint readings and of what was measured with them, whose columns have names and units of their own."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import RootModel

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points, Poses
from urdfcal.files import Source
from urdfcal.importing.decimals import with_points
from urdfcal.io.csv_table import Table, repeats
from urdfcal.io.yaml_document import Document
from urdfcal.names import listed, suggest
from urdfcal.rotations import matrix_to_quaternion, rotation_vector_to_matrix, rpy_to_matrix
from urdfcal.session.knowledge import Led
from urdfcal.session.model import Session
from urdfcal.session.pattern import FramePattern
from urdfcal.session.target import Target

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from urdfcal.arrays import Bools, Floats
    from urdfcal.cameras.rig import Rig
    from urdfcal.importing.decimals import Decimal
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "m": 1.0, "mm": 1e-3, "px": 1.0, "": 1.0}
"""What a column's numbers are multiplied by."""

_ANGLES, _LENGTHS = ("rad", "deg"), ("m", "mm")
_PLACE = ("x", "y", "z")
# Orientations: a unit quaternion, a rotation vector (as UR's controllers write), and URDF's angles about fixed axes.
_TURNS = (("qx", "qy", "qz", "qw"), ("rx", "ry", "rz"), ("roll", "pitch", "yaw"))
# A unit in a column's own name: "X [mm]", "J1 (deg)". Anything in brackets at its end is meant as one.
_IN_NAME = re.compile(r"[\[(]([^\])]+)[\])]\s*$")
# A quaternion of six digits.
_UNIT_LENGTH = 1e-3


class _ColumnsFile(RootModel[dict[str, str]]):
    """Names, and the column of each."""


def read_columns(path: Path) -> dict[str, Column]:
    """Read which columns are what: a YAML file of NAME: COLUMN or NAME: COLUMN:UNIT.

    Raises:
        SessionError: it cannot be read, or is none.
    """
    document = Document.read(path)
    return {name: Column.parse(text) for name, text in document.validate(_ColumnsFile).root.items()}


@dataclass(frozen=True)
class Column:
    """A column of a foreign table.

    Attributes:
        name: as the table's header has it.
        unit: of its numbers; empty where nothing says it, and they are in rad, m or px.
    """

    name: str
    unit: str = ""

    @classmethod
    def parse(cls, text: str) -> Column:
        """Read COLUMN or COLUMN:UNIT."""
        name, colon, unit = text.rpartition(":")
        return cls(name, unit) if colon and unit in UNITS else cls(text)


def columns_session(
    path: Path,
    said: Mapping[str, Column],
    chain: Mechanism,
    urdf: Urdf,
    urdf_reference: str,
    rig: Rig,
    leds: tuple[Led, ...] = (),
    decimal: Decimal | None = None,
) -> tuple[Session, tuple[str, ...]]:
    """Make a session of a table, one row a pose.

    What is measured are points (x, y, z of an LED), poses of a probe on the tip link (x, y, z and an orientation: qx to
    qw, rx to rz or roll, pitch, yaw) or detections (CAMERA.u and CAMERA.v). Where a row's cells are all empty, nothing
    was measured.

    Args:
        path: comma-separated values, or separated by semicolons or tabs.
        said: the column of each quantity, by its name: pose, joints and what is measured. What is not said has the
            column of its own name.
        chain: the robot's.
        urdf: its description.
        urdf_reference: what session.yaml calls that.
        rig: the cameras that saw the LED, if any did.
        leds: the one that was seen or measured, if anything is said of it.
        decimal: what stands before decimals; None where the numbers are to tell.

    Returns:
        The session, and which columns were read as what.

    Raises:
        SessionError: a column is missing, a number or a unit is none or may be two, with file, line and column.
    """
    measured = [*_PLACE, *(name for turn in _TURNS for name in turn), *(f"{c}.{k}" for c in rig.names for k in "uv")]
    known = ["pose", *chain.actuated, *measured]
    for name in said:
        if name not in known:
            raise SessionError(
                f"there is nothing called {name!r}", where="--column", remedy=suggest(name, known, "names")
            )
    table = Table.parse(with_commas(Source.read(path)), (), (), None)
    columns = {name: said.get(name, Column(name)) for name in known}
    _refuse_twice({name: column for name, column in columns.items() if column.name in table.columns}, said, str(path))
    for name, column in columns.items():
        if column.name not in table.columns and (name in said or name in chain.actuated):
            remedy = suggest(column.name, list(table.columns), "columns")
            if name not in said:
                remedy = f"Say which it is: --column '{name}=COLUMN'. {remedy}"
            raise SessionError(f"there is no column {column.name!r} for {name}", where=f"{path}:1", remedy=remedy)
    here = {name: column for name, column in columns.items() if column.name in table.columns}
    numbers = [column.name for name, column in here.items() if name != "pose"]
    reader = _Reader(with_points(table, numbers, decimal), here)
    poses = reader.labels()
    prismatic = {joint.name for joint in chain.joints if joint.type == "prismatic"}
    kinds = [_LENGTHS if name in prismatic else _ANGLES for name in chain.actuated]
    readings = np.column_stack([reader.numbers(name, kind) for name, kind in zip(chain.actuated, kinds, strict=True)])
    found = reader.measured(rig)
    if not found:
        remedy = f"Name columns with --column, of: {listed(measured)}; cameras need --cameras FILE."
        raise SessionError("no column holds what was measured", where=f"{path}:1", remedy=remedy)
    probe = any(isinstance(each, Poses) for each in found)
    if probe and leds:
        what = f"it has poses of a probe on {chain.tip_link!r}, and nothing of the LED {leds[0].name!r}"
        raise SessionError(what, where=f"{path}:1", remedy="Leave --led out, or the columns of the orientation.")
    session = Session(
        chain=chain,
        urdf=urdf,
        urdf_reference=urdf_reference,
        rig=rig,
        leds=() if probe else leds or (Led("led"),),
        targets=(Target("probe", FramePattern(), chain.tip_link),) if probe else (),
        poses=poses,
        q=chain.joint_values(readings),
        measurements=found,
    )
    return session, reader.said()


def _refuse_twice(columns: Mapping[str, Column], said: Mapping[str, Column], path: str) -> None:
    """Refuse a column that would be two quantities: a gantry's joint x, and the x of what was measured."""
    first: dict[str, str] = {}
    for name, column in columns.items():
        if column.name in first:
            raise SessionError(
                f"column {column.name!r} would be both {first[column.name]} and {name}",
                where=f"{path}:1",
                remedy=f"Say which column is {name if name not in said else first[column.name]}: --column NAME=COLUMN.",
            )
        first[column.name] = name


@dataclass(frozen=True, eq=False)
class _Reader:
    """A table, and what its columns mean."""

    table: Table
    columns: Mapping[str, Column]

    def labels(self) -> tuple[str, ...]:
        """The poses' labels; their numbers where no column has them."""
        if "pose" not in self.columns:
            return tuple(str(k + 1) for k in range(len(self.table.lines) - 1))
        column = self.columns["pose"].name
        labels = self.table.labels(column)
        for first, row in repeats(labels):
            what = f"the pose {labels[row]!r} is in line {first + 2} already"
            raise self.table.wrong(what, row, column, "One row a pose: leave out the column, and rows are numbered.")
        return labels

    def unit(self, name: str) -> str:
        """The unit of a quantity's column: as said, or in brackets in its name."""
        column, known = self.columns[name], list(filter(None, UNITS))
        found = None if column.unit else _IN_NAME.search(column.name)
        if found is None:
            return column.unit
        unit = found[1].strip().replace("°", "deg")
        if unit not in known:
            raise SessionError(
                f"the unit {found[0].strip()} of {name} is not known",
                where=f"{self.table.path}:1, column {column.name!r}",
                remedy=f"Say which it is: --column '{name}={column.name}:UNIT', of {', '.join(known)}.",
            )
        return unit

    def numbers(self, name: str, units: Sequence[str], rows: Bools | None = None) -> Floats:
        """A quantity's numbers (N,), or those of some rows (N,), in SI units."""
        unit, column = self.unit(name), self.columns[name].name
        if unit and unit not in units:
            remedy = f"It is in {' or '.join(units)}: --column '{name}={column}:{units[-1]}'." if units[0] else ""
            raise SessionError(
                f"{name} cannot be in {unit}", where=f"{self.table.path}:1, column {column!r}", remedy=remedy
            )
        cells = self.table.columns[column]
        if rows is not None and not rows.all():
            filled = [cell if used else "0" for cell, used in zip(cells, rows.tolist(), strict=True)]
            values = Table(self.table.source, {**self.table.columns, column: filled}, self.table.lines).numbers(
                [column]
            )
            return np.asarray(values[rows, 0] * UNITS[unit])
        return np.asarray(self.table.numbers([column])[:, 0] * UNITS[unit])

    def rows(self, names: Sequence[str]) -> Bools:
        """In which rows something was measured: not all of these cells are empty."""
        cells = zip(*(self.table.columns[self.columns[name].name] for name in names), strict=True)
        return np.array([any(cell.strip() for cell in of) for of in cells], dtype=bool)

    def whole(self, names: Sequence[str]) -> bool:
        """Whether there are all of some quantities; refuses some of them."""
        there = [name for name in names if name in self.columns]
        if there and len(there) < len(names):
            missing = [name for name in names if name not in there]
            remedy = f"Say which columns they are: --column '{missing[0]}=COLUMN'."
            what = f"there is {listed(there)}, but not {listed(missing)}"
            raise SessionError(what, where=f"{self.table.path}:1", remedy=remedy)
        return bool(there)

    def measured(self, rig: Rig) -> tuple[Points | Poses | Detections, ...]:
        """The points or poses, and the detections."""
        found: list[Points | Poses | Detections] = []
        turns = [turn for turn in _TURNS if self.whole(turn)]
        if self.whole(_PLACE):
            rows = self.rows([*_PLACE, *(turns[0] if turns else ())])
            pose, place = np.flatnonzero(rows), np.column_stack([self.numbers(name, _LENGTHS, rows) for name in _PLACE])
            if turns:
                place = np.column_stack([place, self._quaternions(turns[0], rows)])
                found.append(Poses(pose, pose * 0, place, *(np.array(of.usual) for of in Poses.spreads.values())))
            else:
                found.append(Points(pose, pose * 0, place, np.array(Points.usual)))
        elif turns:
            raise SessionError(
                f"there is {listed(turns[0])}, but no x, y, z",
                where=f"{self.table.path}:1",
                remedy="Say which columns they are: --column 'x=COLUMN' and so on.",
            )
        seen = []
        for c, camera in enumerate(rig.names):
            names = [f"{camera}.u", f"{camera}.v"]
            if self.whole(names):
                rows = self.rows(names)
                uv = np.column_stack([self.numbers(name, ("px",), rows) for name in names])
                seen.append((np.flatnonzero(rows), np.full(len(uv), c), np.zeros(len(uv), np.intp), uv))
        if seen:
            pose, camera_index, led, uv = (np.concatenate(of) for of in zip(*seen, strict=True))
            found.append(Detections(pose, camera_index, led, uv, np.array(Detections.usual)))
        return tuple(found)

    def said(self) -> tuple[str, ...]:
        """Which columns were read as what, those whose name or unit is not its own."""
        return tuple(
            f"{name} is column {column.name!r}" + (f" in {self.unit(name)}" if self.unit(name) else "")
            for name, column in self.columns.items()
            if column.name != name or self.unit(name)
        )

    def _quaternions(self, names: Sequence[str], rows: Bools) -> Floats:
        if len(names) == 4:
            q = np.column_stack([self.numbers(name, ("",), rows) for name in names])
            length = np.linalg.norm(q, axis=1)
            for k in np.flatnonzero(np.abs(length - 1.0) > _UNIT_LENGTH)[:1].tolist():
                what = f"the quaternion is of length {length[k]:.4g}, not 1"
                raise self.table.wrong(what, int(np.flatnonzero(rows)[k]), self.columns[names[0]].name)
            return np.asarray(q / length[:, None])
        angles = np.column_stack([self.numbers(name, _ANGLES, rows) for name in names])
        R = rotation_vector_to_matrix(angles) if names[0] == "rx" else np.array([rpy_to_matrix(of) for of in angles])
        return np.array([matrix_to_quaternion(of) for of in R])


def with_commas(source: Source) -> Source:
    """The same file with its columns separated by commas, and cells with commas of their own in quotes."""
    header = source.text.split("\n", 1)[0]
    separator = next((mark for mark in (";", "\t") if mark in header), None)
    if separator is None or "," in header:
        return source
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for number, line in enumerate(source.text.split("\n"), 1):
        # Each line for itself: an open quote does not swallow the next one.
        try:
            writer.writerow(next(csv.reader([line], delimiter=separator, skipinitialspace=True), []))
        except csv.Error as error:
            raise SessionError(f"this is no table: {error}", where=f"{source.path}:{number}") from error
    return Source(source.path, text.getvalue().encode())
