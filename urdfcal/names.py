"""Names of poses, LEDs and joints: what is allowed, and what a misspelt one was probably meant to be."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Collection

# Enough to show every camera, LED or joint of a usual rig without filling the terminal.
_SHOWN = 12
PASS = "pass"  # noqa: S105  # no word of secrecy
"""What a pose is called that an arm only passes through, with a number after it."""


def is_passed(label: str) -> bool:
    """Return whether a label is of a pose that the arm only passes through."""
    return re.fullmatch(rf"{PASS}\d+", label) is not None


def flaw(name: str) -> str:
    """Say what keeps ``name`` from being written to a table and read back as itself; empty if nothing does."""
    if not name.strip():
        return "an empty name"
    if name != name.strip():
        return f"the name {name!r} begins or ends with a blank"
    if not name.isprintable():
        return f"the name {name!r} has characters that cannot be printed"
    return ""


def check_names(kind: str, names: Collection[str]) -> None:
    """Refuse names that are flawed or not unique.

    Args:
        kind: what they name, in the plural: "poses", "LEDs".
        names: all of them.

    Raises:
        SessionError: naming the first offender.
    """
    seen: set[str] = set()
    for name in names:
        if problem := flaw(name):
            raise SessionError(problem, where=kind)
        if name in seen:
            raise SessionError(f"two {kind} are named {name!r}", remedy="Names must differ.")
        seen.add(name)


def check_known(name: str, known: Collection[str], kind: str, where: str, among: str = "") -> None:
    """Refuse the name of what there is not.

    Args:
        name: to be looked for.
        known: those that exist.
        kind: what they name, in the plural: "cameras".
        where: it is named.
        among: what else is to be said of those that exist.

    Raises:
        SessionError: it is not among them.
    """
    if name not in known:
        raise SessionError(f"there is no {kind[:-1]} {name!r}{among}", where=where, remedy=suggest(name, known, kind))


def listed(names: Collection[str]) -> str:
    """Join ``names`` for a message; of many, the first ones and the count."""
    shown = ", ".join(list(names)[:_SHOWN])
    return f"{shown}, ... ({len(names)} in all)" if len(names) > _SHOWN else shown


def suggest(wanted: str, known: Collection[str], kind: str) -> str:
    """Say which names there are, and which one ``wanted`` is probably a misspelling of.

    Args:
        wanted: the name that was not found.
        known: those that exist.
        kind: what they are, in the plural: "cameras".
    """
    from difflib import get_close_matches

    near = get_close_matches(wanted, known, n=5, cutoff=0.5)
    # Of many names the likely ones are among those shown.
    there_are = f"The {kind} are: {listed(dict.fromkeys([*near, *known]) if len(known) > _SHOWN else known)}."
    for name in known:
        if name.casefold() == wanted.casefold():
            return f"Did you mean {name!r}? Upper and lower case differ. {there_are}"
        if _same_number(name, wanted):
            return f"Did you mean {name!r}? Labels are text. {there_are}"
    near = get_close_matches(wanted, near, n=1)
    return f"Did you mean {near[0]!r}? {there_are}" if near else there_are


def _same_number(a: str, b: str) -> bool:
    try:
        return float(a) == float(b)
    except ValueError:
        return False
