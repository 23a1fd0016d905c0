"""Tables of measurements of one kind: sorted, read-only, each row of its own; what they mean others know."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from urdfcal.arrays import Floats, Ints, ReadOnly, Rebuilt, finite_array, frozen, keep
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from typing_extensions import Self


class NoiseField(NamedTuple):
    """What a field of standard deviations says: its key of ``noise``, its default, its unit, and of which numbers."""

    noise: str
    usual: float
    unit: str
    numbers: slice


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
        positive: whether they all are.
        repeats: whether different poses may well show the same, as a bar of one length does.
        noise: the key of ``noise`` that says the usual standard deviation.
        usual: its default.
        unit: of the numbers.
        report: unit and factor in which they are reported.
        spreads: the fields of standard deviations; where there is but ``sigma`` the keys above say it all.
        lengths: which of the numbers of a residual say how far something is off.
    """

    kind: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]
    dimension: ClassVar[int]
    columns: ClassVar[tuple[str, ...]] = ()
    array: ClassVar[str] = ""
    positive: ClassVar[bool] = False
    repeats: ClassVar[bool] = False
    noise: ClassVar[str]
    usual: ClassVar[float]
    unit: ClassVar[str]
    report: ClassVar[tuple[str, float]]
    spreads: ClassVar[Mapping[str, NoiseField]] = {}
    lengths: ClassVar[slice] = slice(None)

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
        columns = {**self.arrays, **index}
        for name in self.spread_of():
            try:
                sigma = finite_array(np.broadcast_to(columns[name], (count,)), (count,), name, self.kind)
            except ValueError as error:
                what = f"{name} has shape {np.shape(columns[name])}, not ({count},)"
                raise SessionError(what, where=self.kind) from error
            if sigma.min() <= 0.0:
                raise SessionError(f"{name} is {sigma.min():g}; it must be positive", where=self.kind)
            columns[name] = sigma
        if self.array:
            columns[self.array] = finite_array(self.values, (count, len(self.columns)), self.array, self.kind)
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

    @classmethod
    def spread_of(cls) -> Mapping[str, NoiseField]:
        """Return the fields of standard deviations, and what they say."""
        return cls.spreads or {"sigma": NoiseField(cls.noise, cls.usual, cls.unit, slice(None))}

    @classmethod
    def reports(cls) -> tuple[tuple[str, float, slice], ...]:
        """Return the units and factors in which residuals are reported, and of which of their numbers."""
        turns = (("mrad", 1e3, of.numbers) for of in cls.spreads.values() if of.unit == "rad")
        return ((*cls.report, cls.lengths), *turns)

    @classmethod
    def components(cls) -> tuple[str, ...]:
        """Return the names of the numbers that say how far something is off."""
        return cls.columns[cls.lengths] or ("x", "y", "z")[: cls.dimension]

    @property
    def compared(self) -> Floats:
        """What predictions are compared with, (S, D): what was measured."""
        return self.values

    @property
    def index(self) -> dict[str, Ints]:
        """The index array (S,) of each key."""
        return {key: getattr(self, key) for key in self.keys}

    def rows(self, chosen: Any) -> Self:
        """Return some of the rows, by an index or a mask (S,)."""
        return replace(self, **{name: column[chosen] for name, column in self.arrays.items()})

    def with_noise(self, sigmas: Mapping[str, float]) -> Self:
        """Return the same measurements with standard deviations for some keys of ``noise``. [unit]."""
        spreads = self.spread_of().items()
        changed: dict[str, Any] = {
            name: np.full(len(self), sigmas[of.noise]) for name, of in spreads if of.noise in sigmas
        }
        return replace(self, **changed) if changed else self

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


Kind = TypeVar("Kind", bound=Measurements)


def numbered_alike(tables: Iterable[Measurements]) -> tuple[Measurements, ...]:
    """Number what several tables name, such as places, alike in all of them."""
    tables = tuple(tables)
    names: dict[str, dict[str, None]] = {}
    for table in tables:
        for key, own in table.names.items():
            names[key] = names.get(key, {}) | dict.fromkeys(own)
    result = []
    for table in tables:
        every = {key: tuple(names[key]) for key in table.names}
        if every != dict(table.names):
            index = {key: np.array([every[key].index(of) for of in own]) for key, own in table.names.items()}
            changes: dict[str, Any] = {key: number[table.index[key]] for key, number in index.items()}
            table = replace(table, **changes, names=every)
        result.append(table)
    return tuple(result)
