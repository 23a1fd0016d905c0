"""The XML of a URDF: reading its elements with their byte offsets, and editing their tags in place.

Expat is driven directly: unlike ElementTree it reports where in the bytes an element starts, which rewriting
needs, and lets document types be refused before anything in them is looked at. What an edit does not name
stays byte for byte.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple
from xml.parsers import expat

from urdfcal.errors import RobotError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

# The largest of example-robot-data's 69 URDFs (TIAGo with two arms) has 0.2 MB.
MAX_BYTES = 16 * 2**20
# The deepest of them nests 7 elements; tinyxml2, Pinocchio's reader, stops at 100 (before 9.0) or 500.
MAX_DEPTH = 100


@dataclass(frozen=True)
class Element:
    """One element.

    Attributes:
        tag: its name as written, with any prefix.
        attributes: their values, character references replaced.
        offset: of its ``<`` in the file's bytes.
        line: where it starts, from 1.
        children: in document order.
    """

    tag: str
    attributes: Mapping[str, str]
    offset: int
    line: int
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> list[Element]:
        """Return its children of a tag; those deeper down are another's."""
        return [child for child in self.children if child.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return its first child of a tag; URDF readers look at no other."""
        return next((child for child in self.children if child.tag == tag), None)


class ElementReader:
    """Expat, and the elements that are open; subclasses look at what starts.

    Attributes:
        source: what to call the file in messages.
        root: of the elements read.
        opened: the elements that the next one is in, from the root on.
    """

    def __init__(self, source: str) -> None:
        """Prepare to read one file."""
        self.source = source
        self.root: Element
        self.opened: list[Element] = []
        self._parser = expat.ParserCreate()
        self._parser.StartDoctypeDeclHandler = self.doctype
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = lambda _tag: self.opened.pop()

    def read(self, data: bytes) -> None:
        """Read a file's bytes.

        Raises:
            RobotError: they are no well-formed XML in an encoding that expat reads, or a subclass refuses them.
        """
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as error:
            raise RobotError(
                f"not well-formed XML: {expat.ErrorString(error.code)}",
                where=f"{self.source}:{error.lineno}, column {error.offset + 1}",
                remedy="`xmllint --noout FILE` shows the place.",
            ) from error
        except (LookupError, ValueError) as error:
            # Raised by pyexpat for an encoding that is unknown to Python or takes several bytes a character.
            what = f"its declared encoding cannot be read: {error}"
            raise RobotError(what, where=self.source, remedy=_UTF8) from error

    def refusal(self, what: str, remedy: str) -> RobotError:
        """Make the error that something is wrong at the place that is being read."""
        return RobotError(what, where=f"{self.source}:{self._parser.CurrentLineNumber}", remedy=remedy)

    def doctype(self, name: str, system_id: str | None, public_id: str | None, internal_subset: int) -> None:
        """Look at a document type, before expat reads its declarations: entities are never even defined."""

    def started(self, element: Element) -> None:
        """Look at an element, which is not yet among the opened ones."""

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self._parser.CurrentByteIndex, self._parser.CurrentLineNumber)
        self.started(element)
        if self.opened:
            self.opened[-1].children.append(element)
        else:
            self.root = element
        self.opened.append(element)


def parse(data: bytes, source: str) -> Element:
    """Read the elements of a URDF, and return the root.

    Args:
        data: the file's bytes, in UTF-8 (with or without byte order mark), ASCII, or a declared
            single-byte encoding such as ISO-8859-1.
        source: what to call the file in messages.

    Raises:
        RobotError: the bytes are no well-formed XML, in an encoding that Pinocchio cannot read, too large,
            too deeply nested, declare a document type with entities, or hold xacro macros.
    """
    _refuse_foreign_bytes(data, source)
    reader = _UrdfReader(source)
    reader.read(data)
    return reader.root


_UTF8 = "Save it as UTF-8."


class _UrdfReader(ElementReader):
    def doctype(self, name: str, system_id: str | None, public_id: str | None, internal_subset: int) -> None:
        if internal_subset or system_id or public_id:
            raise self.refusal(
                f"the document type <!DOCTYPE {name} ...> declares entities or names an external file",
                "Remove it: a URDF needs none, and entities can hide gigabytes or other files.",
            )

    def started(self, element: Element) -> None:
        if element.tag.startswith("xacro:"):
            raise xacro_error(f"<{element.tag}> is not expanded", f"{self.source}:{element.line}")
        if len(self.opened) == MAX_DEPTH:
            raise self.refusal(
                f"elements are nested more than {MAX_DEPTH} deep, <{element.tag}> in <{self.opened[-1].tag}>",
                "Is it a URDF?",
            )


def xacro_error(what: str, where: str) -> RobotError:
    """Make the error that a file is the xacro source of a URDF."""
    return RobotError(
        f"this is a xacro file, not a URDF: {what}",
        where=where,
        remedy="Run xacro first: xacro robot.urdf.xacro > robot.urdf",
    )


def _refuse_foreign_bytes(data: bytes, source: str) -> None:
    if len(data) > MAX_BYTES:
        raise too_large(len(data), source)
    if not data.strip():
        raise RobotError("the file is empty", where=source)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" in data:
        raise RobotError(
            "the file is UTF-16, UTF-32 or binary, which Pinocchio cannot read", where=source, remedy=_UTF8
        )
    # What no declaration explains is UTF-8 or a mistake; expat's "invalid token" would help nobody.
    declared = _ENCODING.match(data)
    if declared and declared[1].lower() != b"utf-8":
        return
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise RobotError(
            f"byte 0x{data[error.start]:02x} is not UTF-8, and no other encoding is declared",
            where=f"{source}:{line}",
            remedy='Save it as UTF-8, or declare <?xml version="1.0" encoding="ISO-8859-1"?> for Latin-1.',
        ) from error


_ENCODING = re.compile(rb"(?:\xef\xbb\xbf)?<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']+)")


def too_large(size: int, source: str) -> RobotError:
    """Make the error that a file is larger than any robot description."""
    return RobotError(
        f"the file has {size / 2**20:.0f} MB, more than {MAX_BYTES // 2**20} MB", where=source, remedy="Is it a URDF?"
    )


def numbers_text(values: Iterable[float]) -> bytes:
    """Write numbers as an attribute's value: the shortest ones that read back exactly."""
    return " ".join(repr(float(value) + 0.0) for value in values).encode()  # + 0.0: no "-0.0"


class Edit(NamedTuple):
    """Bytes from ``start`` up to ``stop`` that become ``text``."""

    start: int
    stop: int
    text: bytes


def apply_edits(data: bytes, edits: Iterable[Edit]) -> bytes:
    """Replace the bytes of edits that do not overlap."""
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
    """A start tag's attributes by name (groups gap, name, quote, value), and where it ends."""

    attributes: dict[str, re.Match[bytes]]
    end_of_attributes: int
    end: int


def start_tag(data: bytes, element: Element) -> StartTag:
    """Parse an element's start tag.

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
    """Edit the values of attributes, in their own quotes; missing attributes are added to the tag."""
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
