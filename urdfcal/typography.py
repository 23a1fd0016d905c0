"""How numbers are written, and where lines must not break: before a unit, or a standard deviation."""

from __future__ import annotations

import re
import textwrap

_UNIT = re.compile(r"(\d(?:</data>)?) (?=±|%|(?:mm|mrad|px|deg|rad|kg)\b)")
_SIGMA = re.compile(r"± (?=[\d<])")
_UNBROKEN = "\N{NO-BREAK SPACE}"


def tied(text: str) -> str:
    """Put no-break spaces between numbers of a text, or a page, and their units or standard deviations."""
    return _SIGMA.sub(f"±{_UNBROKEN}", _UNIT.sub(rf"\1{_UNBROKEN}", text)).replace("(N m)", f"(N{_UNBROKEN}m)")


def lines_of(text: str, width: int, indent: str) -> list[str]:
    """Break a line of text into such as are no wider, the first excepted indented; what is copied stays whole."""
    broken = textwrap.wrap(
        tied(text), width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )  # fmt: skip
    return [line.replace(_UNBROKEN, " ") for line in broken] or [""]


def millimetres(metres: float) -> str:
    """Write a length in mm with two digits, of large ones those before the point."""
    length = round(1e3 * metres, 6)  # what is less is rounding
    return f"{length:.2g}" if length < 99.5 else f"{length:.0f}"
