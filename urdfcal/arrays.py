"""Read-only arrays and mappings: what a frozen dataclass holds cannot be changed behind its back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from functools import cache, partial
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = "NDArray[np.float64]"
Ints: TypeAlias = "NDArray[np.intp]"
Bools: TypeAlias = "NDArray[np.bool_]"


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Copy ``values`` into an array that refuses to be written to."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def finite_array(values: ArrayLike, shape: tuple[int, ...], name: str, where: str) -> Floats:
    """Return a read-only array of finite numbers of a given shape.

    Raises:
        SessionError: the values are no numbers, of another shape, or not finite.
    """
    try:
        array = frozen(values)
    except (TypeError, ValueError) as error:
        raise SessionError(f"{name} is not made of numbers", where=where) from error
    if array.shape != shape:
        raise SessionError(f"{name} has shape {array.shape}, not {shape}", where=where)
    if not np.isfinite(array).all():
        raise SessionError(f"{name} has values that are not finite", where=where)
    return array


def finite_number(value: Any, name: str, where: str, *, zero: bool) -> float:
    """Return a positive number; with ``zero`` it may be 0.

    Raises:
        SessionError: it is none.
    """
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not np.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise SessionError(f"{name} is {value!r}, not a {'non-negative' if zero else 'positive'} number", where=where)
    return float(value)


def keep(declared: object, **values: Any) -> None:
    """Set fields of a frozen dataclass while it is made."""
    for name, value in values.items():
        object.__setattr__(declared, name, value)


K = TypeVar("K")
V = TypeVar("V")


class ReadOnly(Mapping[K, V]):
    """A mapping that cannot be written to, and unlike ``MappingProxyType`` can be pickled."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[K, V]) -> None:
        """Copy the items."""
        self._items = dict(items)

    def __getitem__(self, key: K) -> V:
        """Return the value of a key."""
        return self._items[key]

    def __iter__(self) -> Iterator[K]:
        """Iterate over the keys."""
        return iter(self._items)

    def __len__(self) -> int:
        """Return the number of keys."""
        return len(self._items)

    def __repr__(self) -> str:
        """Show the items as a dict does."""
        return repr(self._items)


class Rebuilt:
    """A dataclass that is unpickled by its constructor, which makes its arrays read-only again."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Take the fields along."""
        return partial(type(self), **{entry.name: getattr(self, entry.name) for entry in fields(self)}), ()  # type: ignore[arg-type]


def evenly(values: Ints, most: int) -> Ints:
    """At most so many of some values, spread evenly over their order."""
    return values[np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).astype(np.intp))]


def rms(values: Floats) -> float:
    """Return the root mean square of values; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def numbered(columns: Iterable[Ints]) -> Ints:
    """Number the combinations of indices that stand at the same place of some columns: equal where all are equal."""
    number: Ints = np.zeros((), dtype=np.intp)
    for column in columns:
        number = number * (1 + column.max(initial=0)) + column
    return number


def inverse(T: Floats) -> Floats:
    """Invert rigid transforms, shape (..., 4, 4), without a general solve."""
    result = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def covariance_of(information: Floats) -> Floats:
    """Invert an information matrix (P, P) whose rows differ in units, balanced first."""
    scale = 1.0 / np.sqrt(np.diag(information))
    result: Floats = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return result


def one_blas_thread() -> AbstractContextManager[object]:
    """Keep linear algebra to one thread within a ``with``: two are slower at these sizes."""
    limits: AbstractContextManager[object] = _thread_pools().limit(limits=1, user_api="blas")
    return limits


@cache
def _thread_pools() -> Any:
    # Looking for the libraries takes 3 ms each time; numpy's is there by now.
    import threadpoolctl

    return threadpoolctl.ThreadpoolController()
