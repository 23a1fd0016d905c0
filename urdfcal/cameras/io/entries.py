"""Read the keys of camera and board files, each with the line and column of its value.

Files are parsed to PyYAML's nodes and no further: no value is guessed a type, nothing is constructed. OpenCV's XML
files become the same nodes.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING
from xml.parsers import expat

import numpy as np

from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    import yaml

    from urdfcal.arrays import Floats

# YAML 1.1 takes 1e-4 for text: it wants 1.0e-4. YAML 1.2, and everybody who types a number, does not.
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
# OpenCV writes two or three levels.
_DEEPEST_XML = 20
# Kalibr's own calibrations are orthonormal to 1e-15; a matrix typed with five digits is to about 1e-5.
_ORTHONORMAL = 1e-4
# Matrices this close are kept bit for bit, so that what urdfcal wrote comes back the same.
_EXACT = 1e-14
# Cameras around one arm stand at most a few metres apart; 20 m in millimetres would be 20 mm.
_LONGEST_BASELINE = 20.0
# Two lenses are never a micrometre apart; an identity left as a placeholder is.
_SHORTEST_BASELINE = 1e-6


@dataclass(frozen=True)
class Entry:
    """A mapping in a file: its keys, and where their values are.

    Attributes:
        path: the file.
        name: what messages call it; empty for the file itself.
        node: the mapping.
        fields: its values.
    """

    path: Path
    name: str
    node: yaml.Node
    fields: Mapping[str, yaml.Node]

    @classmethod
    def of(cls, path: Path, name: str, node: yaml.Node, what: str) -> Entry:
        """Read the keys of ``node``, which must be a mapping that holds ``what`` and has no key twice."""
        if _kind(node) != "mapping":
            raise CameraError(f"{what} are expected here, 'key: value' on each line", where=place(path, node))
        found: dict[str, yaml.Node] = {}
        for key, value in node.value:
            if not isinstance(key.value, str):
                raise CameraError("a key must be one word", where=place(path, key))
            if key.value in found:
                raise CameraError(f"'{key.value}' stands here a second time", where=place(path, key))
            found[key.value] = value
        return cls(path, name, node, found)

    @classmethod
    def read(cls, path: Path, what: str) -> Entry:
        """Read the keys of a YAML file that is to hold ``what``."""
        return cls.of(path, "", compose(read_bytes(path), path), what)

    def only(self, allowed: Sequence[str], owner: str) -> None:
        """Refuse keys of ``owner`` other than those ``allowed``."""
        for key, node in self.fields.items():
            if key not in allowed:
                remedy = f"Allowed: {', '.join(allowed)}."
                raise CameraError(f"key '{key}' of {owner} is not known", where=place(self.path, node), remedy=remedy)

    def error(self, key: str, what: str, remedy: str = "", node: yaml.Node | None = None) -> CameraError:
        """An error at the value of ``key`` or a ``node`` in it, or at the entry if it has none."""
        where = place(self.path, node or self.fields.get(key, self.node))
        return CameraError(what, where=f"{where} ({self._full(key)})", remedy=remedy)

    def text(self, key: str) -> str:
        """The value of ``key`` as written."""
        value = self._required(key).value
        if not isinstance(value, str):
            raise self.error(key, f"{key} must be one word")
        return value

    def number(self, key: str, remedy: str = "", node: yaml.Node | None = None) -> float:
        """The value of ``key``, or of a ``node`` in it, a number; ``remedy`` helps where it is none."""
        node = node or self._required(key)
        text = node.value if isinstance(node.value, str) else "a nested value"
        if not _NUMBER.fullmatch(text) or not np.isfinite(float(text)):
            raise self.error(key, f"'{text}' is not a finite number", remedy, node)
        return float(text)

    def whole(self, key: str) -> int:
        """The value of ``key``, a whole number."""
        value = self.number(key)
        if not value.is_integer():
            raise self.error(key, f"{key} {value:g} is not a whole number")
        return int(value)

    def numbers(self, key: str, node: yaml.Node | None = None) -> list[float]:
        """The value of ``key``, or of a ``node`` in it, a list of numbers."""
        node = node or self._required(key)
        if _kind(node) != "sequence":
            raise self.error(key, f"{key} must be a list of numbers")
        return [self.number(key, node=item) for item in node.value]

    def size(self, key: str) -> tuple[int, int]:
        """The value of ``key``, [width, height]."""
        sides = self.numbers(key)
        if len(sides) != 2 or not all(side.is_integer() and side > 0 for side in sides):
            raise self.error(key, f"{key} {sides} is not [width, height] in whole positive pixels")
        return int(sides[0]), int(sides[1])

    def rows(self, key: str, shape: tuple[int, int] | None = None) -> Floats:
        """The value of ``key``, a list of equally long lists of numbers, of a given ``shape`` or any."""
        node = self._required(key)
        rows = [self.numbers(key, row) for row in node.value] if _kind(node) == "sequence" else []
        lengths = {len(row) for row in rows}
        if len(lengths) != 1 or shape not in (None, (len(rows), *lengths)):
            what = f"{shape[0]} rows of {shape[1]} numbers" if shape else "rows of equally many numbers"
            raise self.error(key, f"{key} must have {what}")
        return np.array(rows)

    def table(self, key: str, shape: tuple[int, int] | None = None) -> Floats:
        """The value of ``key``, an array written as rows, cols and data, of a given ``shape`` or any."""
        inner = self.inner(key)
        rows, columns, data = inner.whole("rows"), inner.whole("cols"), inner.numbers("data")
        if min(rows, columns) < 0 or rows * columns != len(data):
            raise inner.error("data", f"{len(data)} numbers do not make {rows} rows of {columns}")
        if shape not in (None, (rows, columns)):
            raise self.error(key, f"{key} must have {shape[0]} rows of {shape[1]} numbers")
        return np.array(data).reshape(rows, columns)

    def inner(self, key: str) -> Entry:
        """The value of ``key``, a mapping."""
        return Entry.of(self.path, self._full(key), self._required(key), f"the keys of {key}")

    def _full(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key

    def _required(self, key: str) -> yaml.Node:
        if key not in self.fields:
            raise self.error(key, f"{key} is missing")
        return self.fields[key]


def read_bytes(path: Path) -> bytes:
    """The file's content.

    Raises:
        CameraError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise CameraError(f"the file cannot be read: {error.strerror}", where=str(path)) from error


def compose(data: bytes, path: Path) -> yaml.Node:
    """The root node of a YAML text.

    Raises:
        CameraError: it is none, or is empty.
    """
    import yaml

    try:
        root = yaml.compose(data, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise CameraError(f"this is not YAML: {error.problem or error.context}", where=where) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise CameraError("this is not a YAML text file", where=str(path)) from error
    if root is None or not root.value:
        raise CameraError("the file holds nothing", where=str(path))
    return root


def compose_xml(data: bytes, path: Path) -> yaml.Node:
    """The root element of an XML text: elements with children as mappings, lists of words as sequences.

    Raises:
        CameraError: it is none, or declares entities, which may grow without bound.
    """
    import yaml

    parser = expat.ParserCreate()
    # Of every open element what it is called, where it begins, its text and its children; outermost the document.
    stack: list[tuple[str, yaml.Mark | None, list[str], list[tuple[yaml.Node, yaml.Node]]]] = [("", None, [], [])]

    def start(tag: str, _: dict[str, str]) -> None:
        if len(stack) > _DEEPEST_XML:
            raise CameraError("elements lie too deep inside each other", where=f"{path}:{parser.CurrentLineNumber}")
        line, column = parser.CurrentLineNumber - 1, parser.CurrentColumnNumber
        stack.append((tag, yaml.Mark(str(path), parser.CurrentByteIndex, line, column, None, 0), [], []))

    def end(tag: str) -> None:
        _, mark, texts, children = stack.pop()
        text = "".join(texts).strip()
        words = text.split()
        node: yaml.Node
        if children:
            node = yaml.MappingNode("map", children, mark)
        elif text.startswith('"') or (len(words) < 2 and tag != "data"):
            node = yaml.ScalarNode("str", text.strip('"'), mark)
        else:
            node = yaml.SequenceNode("seq", [yaml.ScalarNode("str", word, mark) for word in words], mark)
        stack[-1][3].append((yaml.ScalarNode("str", tag, mark), node))

    def refuse(*_: object) -> None:
        where = f"{path}:{parser.CurrentLineNumber}"
        raise CameraError("a document type is declared", where=where, remedy="Remove it.")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = lambda text: stack[-1][2].append(text)
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        where = f"{path}:{error.lineno}:{error.offset + 1}"
        raise CameraError(f"this is not XML: {expat.errors.messages[error.code]}", where=where) from error
    return stack[0][3][0][1]


@contextmanager
def standing(where: str) -> Iterator[None]:
    """Say of a CameraError of the block where in a file it stands."""
    try:
        yield
    except CameraError as error:
        raise CameraError(error.what, where=where, remedy=error.remedy) from error


def place(path: Path, node: yaml.Node) -> str:
    """File, line and column of a node."""
    return f"{path}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"


def rigid(R: Floats, t: Floats, what: str, error: Callable[[str, str], CameraError]) -> Floats:
    """The (4, 4) transform of a rotation matrix from a file, made exact, and a translation between two cameras.

    Args:
        R: (3, 3).
        t: (3,) m.
        what: the key that holds the rotation.
        error: makes the error of a finding and its remedy.
    """
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > _ORTHONORMAL:
        remedy = "Its rows must be of length 1 and at right angles; write at least five digits."
        raise error(f"the rotation part of {what} is off by {off:.2g} from a rotation matrix", remedy)
    if np.linalg.det(R) < 0.0:
        remedy = "Two of its rows are exchanged, or one has the wrong sign."
        raise error(f"the rotation part of {what} is mirrored (determinant -1)", remedy)
    baseline = float(np.linalg.norm(t))
    if baseline > _LONGEST_BASELINE:
        remedy = "Give the translation in metres."
        raise error(f"the cameras are {baseline:g} m apart; it looks like millimetres", remedy)
    if baseline < _SHORTEST_BASELINE:
        remedy = f"Leave {what} out if it is not known; it is then estimated."
        raise error("the two cameras are in the same place", remedy)
    if off > _EXACT:
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
    return np.block([[R, t[:, None]], [np.eye(4)[3]]])


def pinhole(K: Floats, what: str, error: Callable[[str], CameraError]) -> Floats:
    """The intrinsics (4,) fx, fy, cx, cy of a camera matrix from a file, under the key ``what``."""
    if K.shape != (3, 3) or K[0, 1] != 0.0 or K[1, 0] != 0.0 or not np.array_equal(K[2], [0.0, 0.0, 1.0]):
        raise error(f"{what} must be [fx 0 cx; 0 fy cy; 0 0 1]")
    return K[[0, 1, 0, 1], [0, 1, 2, 2]]


def _kind(node: yaml.Node) -> str:
    """Whether a node is a mapping, a sequence or a scalar."""
    return str(node.id)  # type: ignore[attr-defined]
