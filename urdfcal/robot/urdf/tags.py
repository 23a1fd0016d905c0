"""Editing XML in place: what an edit does not name stays byte for byte."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

from urdfcal.errors import RobotError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from urdfcal.robot.urdf.markup import Element


class Edit(NamedTuple):
    """Bytes from ``start`` up to ``stop`` that become ``text``."""

    start: int
    stop: int
    text: bytes


def apply_edits(data: bytes, edits: Iterable[Edit]) -> bytes:
    """Make edits that do not overlap."""
    pieces, position = [], 0
    for edit in sorted(edits):
        pieces += [data[position : edit.start], edit.text]
        position = edit.stop
    return b"".join([*pieces, data[position:]])


# In a start tag that expat has accepted; a quoted value may hold ">", line ends and the other quote.
_NAME = re.compile(rb"<[^\s/>]+")
_ATTRIBUTE = re.compile(rb"(?P<gap>\s+)(?P<name>[^\s=]+)\s*=\s*(?P<quote>[\"'])(?P<value>.*?)(?P=quote)", re.DOTALL)
_CLOSE = re.compile(rb"\s*/?>")


class StartTag(NamedTuple):
    """A start tag taken apart: attributes by name (groups gap, name, quote, value), and where it ends."""

    attributes: dict[str, re.Match[bytes]]
    end_of_attributes: int
    end: int


def start_tag(data: bytes, element: Element) -> StartTag:
    """Take an element's start tag apart.

    Raises:
        RobotError: the element is not where it should be.
    """
    name = _NAME.match(data, element.offset)
    end = name.end() if name else element.offset
    attributes: dict[str, re.Match[bytes]] = {}
    while found := _ATTRIBUTE.match(data, end):
        attributes[found["name"].decode("latin-1")] = found
        end = found.end()
    close = _CLOSE.match(data, end)
    if not name or not close:
        raise RobotError(f"<{element.tag}> cannot be rewritten", where=f"line {element.line}")
    return StartTag(attributes, end, close.end())


def changed_attributes(data: bytes, element: Element, values: Mapping[str, bytes]) -> Iterator[Edit]:
    """Give attributes other values, in their own quotes; those that are not there are added to the tag."""
    tag = start_tag(data, element)
    last = list(tag.attributes.values())[-1] if tag.attributes else None
    # A new attribute follows the last one in its style: same quotes, on a line of its own if that is.
    gap, quote = (last["gap"], last["quote"]) if last else (b" ", b'"')
    added = b""
    for name, value in values.items():
        if name in tag.attributes:
            yield Edit(*tag.attributes[name].span("value"), value)
        else:
            added += gap + name.encode() + b"=" + quote + value + quote
    if added:
        yield Edit(tag.end_of_attributes, tag.end_of_attributes, added)
