"""A CSV file: read fast, and refused with file, line and column."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.names import flaw, listed, suggest
from urdfcal.source import Source

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
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
        source = Source.read(path)
        lines = source.text.split("\n")
        while lines and not lines[-1].strip():
            lines.pop()
        if not lines:
            raise SessionError(
                "the file is empty",
                where=str(path),
                remedy=f"Its first line names the columns: {','.join(required)}.",
            )
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
        index, line = list(self.columns).index(column), self.lines[row + 1]
        position = 0
        for _ in range(index):
            # A comma inside quotes separates nothing.
            quoted = False
            while quoted or line[position] != ",":
                quoted ^= line[position] == '"'
                position += 1
            position += 1
        position += len(line[position:]) - len(line[position:].lstrip(" "))
        return f"{self.path}:{row + 2}:{position + 1}"

    def labels(self, column: str) -> tuple[str, ...]:
        """The cells of a column of names, without blanks around them.

        Raises:
            SessionError: a cell is empty or cannot be printed.
        """
        labels = tuple(cell.strip() for cell in self.columns[column])
        for row, label in enumerate(labels):
            if problem := flaw(label):
                what = problem if label else "the cell is empty"
                raise SessionError(f"{column}: {what}", where=self.place(row, column))
        return labels

    def numbers(self, columns: Sequence[str], remedy: str = "") -> Floats:
        """The cells of some columns as numbers, (rows, columns).

        Args:
            columns: their names.
            remedy: what to do about a number that is not there.

        Raises:
            SessionError: a cell is empty, no number, or not finite.
        """
        result = np.empty((len(self.columns[columns[0]]), len(columns)))
        for i, column in enumerate(columns):
            cells = self.columns[column]
            try:
                result[:, i] = list(map(float, cells))
            except ValueError:
                self._refuse_text(column, remedy)
            # Python reads 1_000 as a number; a table that has it is damaged.
            if "_" in "".join(cells):
                self._refuse_text(column, remedy)
        bad = np.argwhere(~np.isfinite(result))
        if bad.size:
            row, column = int(bad[0, 0]), columns[bad[0, 1]]
            cell = self.columns[column][row].strip()
            raise SessionError(f"{column}: {cell} is not a finite number", where=self.place(row, column), remedy=remedy)
        return result

    def positive(self, column: str) -> Floats:
        """The cells of a column of standard deviations, (rows,).

        Raises:
            SessionError: a cell is no positive number.
        """
        result: Floats = self.numbers([column])[:, 0]
        bad = np.flatnonzero(result <= 0.0)
        if bad.size:
            row = int(bad[0])
            raise SessionError(
                f"{column}: {self.columns[column][row].strip()} is not positive", where=self.place(row, column)
            )
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
            found = [index.get(label, -1) for label in self.labels(column)]
            if -1 in found:
                row = found.index(-1)
                name = self.columns[column][row].strip()
                raise SessionError(
                    f"there is no {column} {name!r}",
                    where=self.place(row, column),
                    remedy=suggest(name, known, kind),
                ) from None
        return np.array(found, dtype=np.intp)

    def _refuse_text(self, column: str, remedy: str) -> NoReturn:
        for row, cell in enumerate(self.columns[column]):
            text = cell.strip()
            try:
                if "_" not in text:
                    float(text)
                    continue
            except ValueError:
                pass
            what = f"{text!r} is not a number" if text else "the cell is empty"
            raise SessionError(f"{column}: {what}", where=self.place(row, column), remedy=remedy)
        raise SessionError(f"{column}: there are cells that are not numbers", where=str(self.path))


def _split(path: Path, lines: Sequence[str]) -> tuple[list[str], list[int]]:
    """The cells of all lines, one after the other, and how many each line has."""
    # Without quotes a cell ends at a comma, and one split of the whole text is several times faster.
    if not any('"' in line for line in lines):
        return ",".join(lines).split(","), [line.count(",") + 1 for line in lines]
    reader = csv.reader(lines, strict=True, skipinitialspace=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        _check_quotes(path, lines)
        raise SessionError(f"this is no CSV: {error}", where=f"{path}:{reader.line_num}") from error
    if len(rows) != len(lines):
        _check_quotes(path, lines)
    return [cell for row in rows for cell in row], [len(row) for row in rows]


def _check_quotes(path: Path, lines: Sequence[str]) -> None:
    for number, line in enumerate(lines, 1):
        if line.count('"') % 2:
            raise SessionError(
                "a quote is opened and not closed in this line", where=f"{path}:{number}", remedy="Close it."
            )


def _check_header(
    path: Path,
    header: Sequence[str],
    required: Sequence[str],
    optional: Sequence[str],
    ignored: Collection[str] | None,
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
        plural = "columns are" if len(missing) > 1 else "column is"
        raise SessionError(
            f"the {plural} missing: {', '.join(repr(name) for name in missing)}", where=where, remedy=needs
        )
