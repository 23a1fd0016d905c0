"""Hold the current value of every unknown of an estimate, looked up by typed keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import numpy as np

from urdfcal.arrays import frozen

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

V = TypeVar("V")


@dataclass(frozen=True)
class Key(Generic[V]):
    """Name one unknown and, for the type checker, the type of its value.

    Attributes:
        name: unique among the unknowns of an estimate.
    """

    name: str


class State:
    """One hypothesis about the robot, the LEDs and the cameras: a read-only value for each unknown.

    Whether a value is estimated or fixed is not said here but by ``Parameters``.
    """

    __slots__ = ("_values",)

    def __init__(self, values: Mapping[Key[Any], Any]) -> None:
        """Copy the values; arrays become read-only."""
        self._values = {key: _read_only(value) for key, value in values.items()}

    def __getitem__(self, key: Key[V]) -> V:
        """Return the value of an unknown."""
        return cast("V", self._values[key])

    def __contains__(self, key: object) -> bool:
        """Return whether the unknown has a value."""
        return key in self._values

    def __iter__(self) -> Iterator[Key[Any]]:
        """Iterate over the keys."""
        return iter(self._values)

    def __repr__(self) -> str:
        """Name the unknowns."""
        return f"State({', '.join(key.name for key in self._values)})"

    def replace(self, values: Mapping[Key[Any], Any]) -> State:
        """Return a state with some values changed or added."""
        new = State({})
        new._values = {**self._values, **{key: _read_only(value) for key, value in values.items()}}
        return new


def _read_only(value: Any) -> Any:
    if not isinstance(value, np.ndarray) or not (value.flags.writeable or value.base is not None):
        return value
    return frozen(value, value.dtype)
