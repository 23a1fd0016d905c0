"""A YAML file checked strictly against a model, every error with its line, column and key."""

from __future__ import annotations

import re
import reprlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from urdfcal.errors import SessionError
from urdfcal.files import Source
from urdfcal.names import listed, suggest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails

_Model = TypeVar("_Model", bound=BaseModel)
_SHORT = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxlist, _SHORT.maxdict, _SHORT.maxlevel = 60, 4, 4, 1


@dataclass(frozen=True)
class Document:
    """A YAML file, with the place of everything in it.

    Attributes:
        source: the file.
        node: its root, as PyYAML composed it.
        data: what it says.
    """

    source: Source
    node: yaml.Node
    data: Any

    @classmethod
    def read(cls, path: Path) -> Document:
        """Read ``path``.

        Raises:
            SessionError: it cannot be read or is no YAML.
        """
        source = Source.read(path)
        try:
            loader = _Loader(source.text)
            node = loader.get_single_node()
            data = loader.construct_document(node) if node is not None else None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
            raise SessionError(f"this is no YAML: {error.problem}", where=where) from error
        except yaml.reader.ReaderError as error:
            line = source.text.count("\n", 0, error.position) + 1
            raise SessionError(f"this is no YAML: {error.reason}", where=f"{path}:{line}") from error
        except RecursionError as error:
            raise SessionError("this is no YAML: it is nested too deeply", where=str(path)) from error
        if node is None:
            raise SessionError("the file is empty", where=str(path), remedy="It needs at least robot and leds.")
        return cls(source, node, data)

    def place(self, *keys: str | int) -> str:
        """Where ``keys`` lead: file:line:column of the last one that is there, and all of them, joined by dots."""
        node, mark = self.node, self.node.start_mark
        for key in keys:
            inner = _child(node, key)
            if inner is None:
                break
            node, mark = inner
        path = ".".join(str(key) for key in keys)
        named = f", key {path!r}" if path else ""
        return f"{self.source.path}:{mark.line + 1}:{mark.column + 1}{named}"

    def texts(self, *keys: str) -> list[str]:
        """The items of a list behind some keys as they are written: 007 is a label, and to YAML the number 7."""
        node = self.node
        for key in keys:
            inner = _child(node, key)
            if inner is None:
                return []
            node, _ = inner
        items = node.value if isinstance(node, yaml.SequenceNode) else [node]
        return [str(item.value) for item in items if item.value != ""]

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Say of what is refused meanwhile where it stands: the key that is named as its place, else the file."""
        try:
            yield
        except SessionError as error:
            keys = error.where.split(".", 1) if error.where else []
            if keys and keys[0] not in self.data:
                raise
            raise SessionError(error.what, where=self.place(*keys), remedy=error.remedy) from None

    def validate(self, model: type[_Model]) -> _Model:
        """Check the data against ``model``.

        Raises:
            SessionError: about the first thing that is wrong, saying how many more there are.
        """
        try:
            return model.model_validate(self.data)
        except ValidationError as error:
            errors = error.errors()
        # A misspelt key is unknown and, under its right name, missing: the first says more.
        first = min(errors, key=lambda error: error["type"] != "extra_forbidden")
        what, remedy = _explained(first, _allowed(model, first["loc"]))
        # Pydantic's own: [key] of a mapping, and the kinds of which one is meant.
        keys = [key for key in first["loc"] if not str(key).startswith("[")]
        if len(errors) > 1:
            what += f" (and {len(errors) - 1} more to put right)"
        raise SessionError(what, where=self.place(*keys), remedy=remedy)


_WRONG = {
    "bool_type": "{} stands where on or off belongs",
    "float_type": "{} stands where a number belongs",
    "string_type": "{} stands where text belongs",
    "model_type": "{} stands where a mapping of keys to values belongs",
    "dict_type": "{} stands where a mapping of keys to values belongs",
    "list_type": "{} stands where a list of numbers belongs",
    "tuple_type": "{} stands where a list of two: [m, rad], or two names belongs",
    "literal_error": "{} is not {expected}",
    "too_short": "{} has {actual_length} values, not 3",
    "too_long": "{} has {actual_length} values, not 3",
    "greater_than": "{} is not greater than {gt:g}",
    "greater_than_equal": "{} is less than {ge:g}",
    "finite_number": "{} is not a finite number",
}


def _explained(error: ErrorDetails, allowed: Sequence[str]) -> tuple[str, str]:
    """Say what is wrong and what to do about it."""
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    key = str(error["loc"][-1]) if error["loc"] else ""
    if kind == "extra_forbidden":
        return f"unknown key {key!r}", suggest(key, allowed, "keys")
    if kind == "missing":
        return f"the key {key!r} is missing", f"The keys are: {listed(allowed)}."
    if kind in _WRONG:
        # A few anchors in a YAML file can stand for a list of billions: a message shows its beginning.
        return _WRONG[kind].format("nothing" if value is None else _SHORT.repr(value), **context), ""
    return str(context.get("error", error["msg"])), ""


def _allowed(model: type[BaseModel], keys: Sequence[str | int]) -> list[str]:
    """The keys that the mapping holding ``keys[-1]`` may have."""
    choices = [model]
    for key in keys[:-1]:
        if key in choices[0].model_fields:
            choices = list(_models_in(choices[0].model_fields[str(key)].annotation)) or choices
        elif str(key).startswith("["):
            kind = str(key)[1:-1]
            of_kind = [of for of in choices if (at := of.model_fields.get("kind")) and kind in get_args(at.annotation)]
            choices = of_kind or choices
    return list(choices[0].model_fields)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _child(node: yaml.Node, key: str | int) -> tuple[yaml.Node, yaml.Mark] | None:
    """What stands behind ``key``, and where the key is, or the item of a list."""
    if isinstance(node, yaml.MappingNode):
        pairs = ((value, name.start_mark) for name, value in reversed(node.value) if name.value == str(key))
        return next(pairs, None)
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
        return node.value[key], node.value[key].start_mark
    return None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with keys as written (an LED named 1 or on), each once, and 1e-4 a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key is not text", key.start_mark)
            if key.value in seen:
                problem = f"the key {key.value!r} is already in line {seen[key.value]}"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen[key.value] = key.start_mark.line + 1
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}


# YAML 1.1, which PyYAML reads, wants 1.0e-4; everyone writes 1e-4, as YAML 1.2 and JSON allow.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)
