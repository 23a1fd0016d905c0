"""Read-only arrays: what a frozen dataclass holds cannot be changed behind its back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = "NDArray[np.float64]"
Ints: TypeAlias = "NDArray[np.intp]"
Bools: TypeAlias = "NDArray[np.bool_]"


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Copy ``values`` into an array that refuses to be written to."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def evenly(values: Ints, most: int) -> Ints:
    """At most so many of some values, spread evenly over their order."""
    return values[np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).astype(np.intp))]


def inverse(T: Floats) -> Floats:
    """Invert rigid transforms, shape (..., 4, 4), without a general solve."""
    result = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result
