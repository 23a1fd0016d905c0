"""Measurements of one kind in a table: what was measured of which things in which pose."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.arrays import Floats, Ints, ReadOnly, Rebuilt, finite_array, frozen, keep
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from typing_extensions import Self


@dataclass(frozen=True, eq=False)
class Measurements(Rebuilt, ABC):
    """Measurements of one kind, sorted by their keys; what was not measured is a missing row.

    A kind is a frozen dataclass with an index array (S,) for each of its ``keys``, the first one ``pose``, an array
    (S, D) of what was measured, and ``sigma`` (S,), the standard deviation of each number. A kind that measures that
    something is zero, such as a contact, has no such array.

    Attributes:
        pose: (S,) index of the pose.
        names: what the indices of a key stand for that only this table names, such as places.
        kind: the table's key in session.yaml, and the stem of its CSV file.
        keys: the columns that name things, which together are unique.
        dimension: D, the numbers of one measurement.
        columns: the columns that hold these; none where they are zero.
        array: the field that holds these; empty where there is none.
        noise: the key of ``noise`` that says the usual standard deviation.
        usual: its default.
        unit: of the numbers.
        report: unit and factor in which they are reported.
    """

    kind: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]
    dimension: ClassVar[int]
    columns: ClassVar[tuple[str, ...]] = ()
    array: ClassVar[str] = ""
    noise: ClassVar[str]
    usual: ClassVar[float]
    unit: ClassVar[str]
    report: ClassVar[tuple[str, float]]

    pose: Ints
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict, kw_only=True)

    if TYPE_CHECKING:

        @property
        def sigma(self) -> Floats:
            """(S,) standard deviation of each number."""

    def __post_init__(self) -> None:
        """Check the columns, sort them by the keys and make them read-only."""
        index = {key: np.asarray(getattr(self, key)) for key in self.keys}
        count = len(index["pose"]) if index["pose"].ndim == 1 else 0
        if count == 0:
            raise SessionError("there is no measurement", where=self.kind)
        for key, column in index.items():
            if column.shape != (count,) or column.dtype.kind not in "iu" or column.min() < 0:
                raise SessionError(f"{key} is not an array of {count} indices", where=self.kind)
        try:
            sigma = finite_array(np.broadcast_to(self.arrays["sigma"], (count,)), (count,), "sigma", self.kind)
        except ValueError as error:
            what = f"sigma has shape {np.shape(self.arrays['sigma'])}, not ({count},)"
            raise SessionError(what, where=self.kind) from error
        if sigma.min() <= 0.0:
            raise SessionError(f"sigma is {sigma.min():g}; it must be positive", where=self.kind)
        columns = {**self.arrays, **index, "sigma": sigma}
        if self.array:
            columns[self.array] = finite_array(self.values, (count, self.dimension), self.array, self.kind)
        order = np.lexsort([index[key] for key in reversed(self.keys)])
        for name, column in columns.items():
            keep(self, **{name: frozen(np.asarray(column)[order], np.intp if name in index else float)})
        keep(self, names=ReadOnly(self.names))
        twice = np.logical_and.reduce([np.diff(getattr(self, key)) == 0 for key in self.keys])
        if twice.any():
            first = int(np.flatnonzero(twice)[0])
            names = ", ".join(f"{key} {getattr(self, key)[first]}" for key in self.keys)
            raise SessionError(f"there are two measurements of {names}", where=self.kind)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.pose)

    @property
    def values(self) -> Floats:
        """What was measured, (S, D)."""
        result: Floats = getattr(self, self.array) if self.array else np.zeros((len(self), self.dimension))
        return result

    @property
    def index(self) -> dict[str, Ints]:
        """The index array (S,) of each key."""
        return {key: getattr(self, key) for key in self.keys}

    def rows(self, chosen: Any) -> Self:
        """Return some of the rows, by an index or a mask (S,)."""
        return replace(self, **{name: column[chosen] for name, column in self.arrays.items()})

    def with_sigma(self, sigma: float) -> Self:
        """Return the same measurements with one standard deviation for all. [unit]."""
        changed: dict[str, Any] = {"sigma": np.full(len(self), sigma)}
        return replace(self, **changed)

    def at(self, poses: Ints) -> Self | None:
        """Return the rows at some poses, (K,) in ascending order, numbered by these; None if there are none."""
        kept = np.isin(self.pose, poses)
        if not kept.any():
            return None
        rows = self.rows(kept)
        return replace(rows, pose=np.searchsorted(poses, rows.pose))

    def check(self, counts: Mapping[str, int]) -> None:
        """Refuse indices of things that do not exist.

        Args:
            counts: how many there are of what a key names; others are not checked.

        Raises:
            SessionError: an index is too large.
        """
        for key, column in self.index.items():
            largest = int(column.max())
            if key in counts and largest >= counts[key]:
                raise SessionError(f"{key} {largest} does not exist: there are {counts[key]}", where=self.kind)

    @property
    def arrays(self) -> dict[str, Any]:
        """The columns by the names of their fields, each with S rows."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "names"}
