"""A CSV file: read fast, and refused with file, line and column."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.files import Source
from urdfcal.names import flaw, listed, suggest

if TYPE_CHECKING:
    from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
    from pathlib import Path

    from urdfcal.arrays import Floats, Ints

_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


@dataclass(frozen=True, eq=False)
class Table:
    """A CSV file as text, its header checked.

    Attributes:
        source: the file.
        columns: the cells of each column by its name, below the header.
        lines: the file's lines; row i is line i + 2 as people count.
    """

    source: Source
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[str]

    @classmethod
    def read(
        cls, path: Path, required: Sequence[str], optional: Sequence[str] = (), ignored: Collection[str] | None = ()
    ) -> Table:
        """Read ``path``.

        Args:
            path: a file of comma-separated values in UTF-8, its first line naming the columns.
            required: names of columns that must be there, in any order.
            optional: names of columns that may be.
            ignored: names of columns that may be, and do not matter; None for any others.

        Raises:
            SessionError: the file cannot be read, its header is not as expected, or rows are ragged or missing.
        """
        return cls.parse(Source.read(path), required, optional, ignored)

    @classmethod
    def parse(
        cls, source: Source, required: Sequence[str], optional: Sequence[str] = (), ignored: Collection[str] | None = ()
    ) -> Table:
        """Read a file's content; see :meth:`read`."""
        path, lines = source.path, source.text.split("\n")
        while lines and not lines[-1].strip():
            lines.pop()
        if not lines:
            remedy = f"Its first line names the columns: {','.join(required)}."
            raise SessionError("the file is empty", where=str(path), remedy=remedy)
        cells, widths = _split(path, lines)
        header = [name.strip() for name in cells[: widths[0]]]
        _check_header(path, header, required, optional, ignored)
        if len(widths) == 1:
            raise SessionError("there are no rows below the header", where=f"{path}:1")
        for number, width in enumerate(widths, 1):
            if width != len(header):
                blank = not lines[number - 1].strip()
                what = "the line is empty" if blank else f"{width} cells where the header names {len(header)}"
                raise SessionError(what, where=f"{path}:{number}", remedy="Every row has one cell per column.")
        columns = {name: cells[len(header) + i :: len(header)] for i, name in enumerate(header)}
        return cls(source, columns, lines)

    @property
    def path(self) -> Path:
        """The file's path."""
        return self.source.path

    def place(self, row: int, column: str) -> str:
        """Where a cell is: file:line:column, counted from 1."""
        # A comma inside quotes separates nothing.
        cells = list(re.finditer(r'(?:^|,) *((?:"[^"]*"|[^,])*)', self.lines[row + 1]))
        return f"{self.path}:{row + 2}:{cells[list(self.columns).index(column)].start(1) + 1}"

    def wrong(self, what: str, row: int, column: str, remedy: str = "") -> SessionError:
        """The error to raise about a cell."""
        return SessionError(what, where=self.place(row, column), remedy=remedy)

    def labels(self, column: str) -> tuple[str, ...]:
        """The cells of a column of names, without blanks around them.

        Raises:
            SessionError: a cell is empty or cannot be printed.
        """
        labels = tuple(cell.strip() for cell in self.columns[column])
        for row, label in enumerate(labels):
            if problem := flaw(label):
                raise self.wrong(f"{column}: {problem if label else 'the cell is empty'}", row, column)
        return labels

    def numbers(self, columns: Sequence[str], remedy: str = "", *, positive: bool = False) -> Floats:
        """The cells of some columns as numbers, (rows, columns).

        Args:
            columns: their names.
            remedy: what to do about a number that is not there.
            positive: whether they are standard deviations, which are.

        Raises:
            SessionError: a cell is empty, no number, not finite, or not positive where it has to be.
        """
        result = np.empty((len(self.lines) - 1, len(columns)))
        for i, column in enumerate(columns):
            cells = self.columns[column]
            try:
                result[:, i] = list(map(float, cells))
                # Python reads 1_000 as a number; a table that has it is damaged.
                good = np.isfinite(result[:, i]).all() and "_" not in "".join(cells)
            except ValueError:
                good = False
            if not good or (positive and result[:, i].min() <= 0.0):
                problems = ((row, _problem(cell.strip(" "), positive)) for row, cell in enumerate(cells))
                row, what = next((row, problem) for row, problem in problems if problem)
                raise self.wrong(f"{column}: {what}", row, column, remedy)
        return result

    def indices(self, column: str, known: Sequence[str], kind: str) -> Ints:
        """The cells of a column of names as indices into ``known``, (rows,).

        Args:
            column: its name.
            known: the names that there are.
            kind: what they name, in the plural, for the message.

        Raises:
            SessionError: a name is not among them.
        """
        index = {name: i for i, name in enumerate(known)}
        try:
            found = [index[cell] for cell in self.columns[column]]
        except KeyError:
            labels = self.labels(column)
            found = [index.get(label, -1) for label in labels]
            if -1 in found:
                row = found.index(-1)
                remedy = suggest(labels[row], known, kind)
                raise self.wrong(f"there is no {column} {labels[row]!r}", row, column, remedy) from None
        return np.array(found, dtype=np.intp)


def repeats(rows: Iterable[Hashable]) -> list[tuple[int, int]]:
    """Each row that is equal to an earlier one, behind the first of these."""
    first: dict[Hashable, int] = {}
    return [(first[row], i) for i, row in enumerate(rows) if first.setdefault(row, i) != i]


def _problem(cell: str, positive: bool) -> str:
    """What keeps a cell from being a number; empty if nothing does."""
    try:
        number = float(cell if "_" not in cell else "")
    except ValueError:
        return f"{cell!r} is not a number" if cell else "the cell is empty"
    if not isfinite(number):
        return f"{cell} is not a finite number"
    return f"{cell} is not positive" if positive and number <= 0.0 else ""


def _split(path: Path, lines: Sequence[str]) -> tuple[list[str], list[int]]:
    """The cells of all lines, one after the other, and how many each line has."""
    # Without quotes a cell ends at a comma, and one split of the whole text is several times faster.
    if not any('"' in line for line in lines):
        return ",".join(lines).split(","), [line.count(",") + 1 for line in lines]
    reader, rows, problem = csv.reader(lines, strict=True, skipinitialspace=True), [], "a cell goes over several lines"
    try:
        rows = list(reader)
    except csv.Error as error:
        problem = f"this is no CSV: {error}"
    if len(rows) != len(lines):
        for number, line in enumerate(lines, 1):
            if line.count('"') % 2:
                where = f"{path}:{number}"
                raise SessionError("a quote is opened and not closed in this line", where=where, remedy="Close it.")
        raise SessionError(problem, where=f"{path}:{reader.line_num}")
    return [cell for row in rows for cell in row], [len(row) for row in rows]


def _check_header(
    path: Path, header: Sequence[str], required: Sequence[str], optional: Sequence[str], ignored: Collection[str] | None
) -> None:
    where = f"{path}:1"
    expected = [*required, *optional]
    needs = f"The columns are: {listed(required)}" + (f"; optional: {listed(optional)}." if optional else ".")
    if len(header) == 1:
        for character, name in _SEPARATORS.items():
            if character in header[0]:
                raise SessionError(f"the columns are separated by {name}", where=where, remedy="Use commas.")
    for i, name in enumerate(header):
        if name in header[:i]:
            raise SessionError(f"the column {name!r} is named twice", where=where, remedy=needs)
        if ignored is not None and name not in expected and name not in ignored:
            raise SessionError(f"unknown column {name!r}", where=where, remedy=suggest(name, expected, "columns"))
    missing = [name for name in required if name not in header]
    if missing:
        plural, names = "columns are" if len(missing) > 1 else "column is", ", ".join(map(repr, missing))
        raise SessionError(f"the {plural} missing: {names}", where=where, remedy=needs)
