"""Numbers with decimal points or decimal commas, and either mark between thousands: which it is, by a whole table."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Collection

    from urdfcal.io.csv_table import Table

Decimal = Literal["point", "comma"]
"""What stands before the decimals."""


def _number(decimal: str, group: str) -> re.Pattern[str]:
    whole = rf"(?:\d+|[1-9]\d{{0,2}}(?:{group}\d{{3}})+)"
    return re.compile(rf"[+-]?(?:{whole}(?:{decimal}\d*)?|{decimal}\d+)(?:[eE][+-]?\d+)?")


# Each mark, the one that may stand between thousands, and what a number looks like with them.
_WRITTEN: dict[Decimal, tuple[str, str, re.Pattern[str]]] = {
    "point": (".", ",", _number(r"\.", ",")),
    "comma": (",", ".", _number(",", r"\.")),
}


def with_points(table: Table, columns: Collection[str], decimal: Decimal | None) -> Table:
    """Return a table whose numbers have decimal points, and nothing between thousands.

    Args:
        table: as it was written.
        columns: names of those that hold numbers.
        decimal: what stands before their decimals; None where the numbers are to tell.

    Raises:
        SessionError: they do not, or one is written otherwise than others.
    """
    cells = [(row, name, cell.strip()) for name in columns for row, cell in enumerate(table.columns[name])]
    marked = [of for of in cells if "," in of[2] or "." in of[2]]
    read = [[mark for mark, (*_, number) in _WRITTEN.items() if number.fullmatch(cell)] for *_, cell in marked]
    told = {marks[0]: of for of, marks in zip(reversed(marked), reversed(read), strict=True) if len(marks) == 1}
    commas = [of for of, marks in zip(marked, read, strict=True) if marks and "," in of[2]]
    if decimal is None and commas and not told:
        row, name, cell = commas[0]
        what = f"{cell} may be {cell.replace(',', '.')} or {cell.replace(',', '')}, and no other number tells"
        raise table.wrong(what, row, name, "Say what stands before decimals: --decimal comma, or --decimal point.")
    decimal = decimal or ("comma" if "comma" in told else "point")
    for other, (row, name, cell) in told.items():
        if other != decimal:
            what = f"{cell} has a decimal {other}, where others have a decimal {decimal}"
            remedy = "Write all numbers alike" + ("." if len(told) > 1 else f", or say --decimal {other}.")
            raise table.wrong(what, row, name, remedy)
    mark, group, number = _WRITTEN[decimal]
    plain = {
        name: [
            cell.strip().replace(group, "").replace(mark, ".") if number.fullmatch(cell.strip()) else cell
            for cell in table.columns[name]
        ]
        for name in columns
    }
    return replace(table, columns={**table.columns, **plain})
