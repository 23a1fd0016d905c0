"""Numbers handed in by a caller, checked before they are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
