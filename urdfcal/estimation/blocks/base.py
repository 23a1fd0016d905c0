"""The interface of a block: one unknown of the estimate with its coordinates, units and prior."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, frozen, inverse
from urdfcal.estimation.state import Key, V

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from typing_extensions import Self

POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")
POSE_UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True, eq=False)
class Block(ABC, Generic[V]):
    """One unknown: its value lives on a manifold, its k coordinates are steps away from a value.

    Attributes:
        key: under which a state holds the value.
        names: k coordinates.
        units: of each coordinate: m, rad, px, s, or 1 for none.
        nominal: the value that the prior is centred at.
        sigma: (k,) prior standard deviation about the nominal value; inf where there is no prior. [unit]
        fixed: coordinates that are not estimated, by index, each with the reason.
        phrase: completes "cannot be distinguished from ..." for all coordinates together; empty where each is named.
        toleranced: whether the prior is a manufacturing tolerance, which can share out an unidentifiable direction.
        order: blocks of a lower number give up a coordinate first where a direction is unidentifiable.
        own_section: whether the result document has a section for the block.
    """

    key: Key[V]
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: V
    sigma: Floats
    phrase: str
    fixed: Mapping[int, str] = field(default_factory=dict)

    toleranced: ClassVar[bool] = False
    order: ClassVar[int] = 1
    own_section: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", frozen(self.sigma))

    def __len__(self) -> int:
        """Return the number of coordinates."""
        return len(self.names)

    @abstractmethod
    def retract(self, value: V, step: Floats) -> V:
        """Move a value by a step (k,) of its coordinates."""

    @abstractmethod
    def local(self, value: V) -> tuple[Floats, Floats]:
        """Return the coordinates (k,) of a value about the nominal one, and their derivative (k, k) by a step."""

    def between(self, a: V, b: V) -> Floats:
        """Return the step (k,) that leads from one value to another one nearby."""
        (here, D), (there, _) = self.local(a), self.local(b)
        return np.asarray(np.linalg.solve(D, there - here), dtype=float)

    def scale(self, value: V) -> Floats:
        """Return what a coordinate (k,) must move by to have about the same effect as 1 m or 1 rad."""
        del value
        return np.ones(len(self))

    def label(self, index: int) -> str:
        """Name a coordinate for a reader."""
        return self.names[index]

    def priority(self, index: int) -> tuple[int, ...]:
        """Order the coordinates by which one is fixed first where a direction is unidentifiable."""
        return (index,)

    def unidentifiable(self, index: int, partners: Sequence[int]) -> str | None:
        """Say why a coordinate is unidentifiable beside others of this block alone; None leaves it to the caller.

        Args:
            index: the coordinate that stands for the direction.
            partners: the others that take part; none where the coordinate moves nothing.
        """
        del index, partners
        return None

    def document(self, value: V, sigma: Floats) -> tuple[dict[str, Any], ...]:
        """Return the block's entries of the result document's ``parameters``; none where it has its own section.

        Args:
            value: as estimated.
            sigma: (k,) standard deviations; NaN where a coordinate is fixed.
        """
        if self.own_section:
            return ()
        offsets, _ = self.local(value)
        nominal = self.coordinates or (None,) * len(self)
        return tuple(
            {"name": name, "unit": unit, "nominal": at, "offset": float(offset), "sigma": s if np.isfinite(s) else None}
            for name, unit, at, offset, s in zip(self.names, self.units, nominal, offsets, sigma.tolist(), strict=True)
        )

    @property
    def coordinates(self) -> tuple[float, ...]:
        """The nominal value's own coordinates, where it has any that offsets add to; by default none."""
        return ()

    @property
    def active(self) -> Bools:
        """Which coordinates (k,) are estimated."""
        active = np.ones(len(self), dtype=bool)
        active[list(self.fixed)] = False
        return active

    @property
    def reasons(self) -> dict[str, str]:
        """Why coordinates are fixed, by their name."""
        return {self.names[k]: why for k, why in self.fixed.items()}

    def fixing(self, reasons: Mapping[int, str]) -> Self:
        """Return the block with more coordinates fixed."""
        return replace(self, fixed={**self.fixed, **reasons})


class VectorBlock(Block[Floats]):
    """An unknown whose value is an array that steps are added to."""

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Add the step."""
        return value + step.reshape(value.shape)

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Return the difference from the nominal value, and the identity."""
        return (value - self.nominal).ravel(), np.eye(len(self))

    @property
    def coordinates(self) -> tuple[float, ...]:
        """The nominal value."""
        return tuple(np.ravel(self.nominal).tolist())


class LeftPoseBlock(Block[Floats]):
    """A rigid transform (4, 4) that moves by exp6(step) from the left: T <- exp6(step) T. [m, rad]."""

    def retract(self, value: Floats, step: Floats) -> Floats:
        """Multiply by exp6(step) from the left."""
        moved: Floats = pin.exp6(step).homogeneous @ value
        return moved

    def local(self, value: Floats) -> tuple[Floats, Floats]:
        """Return log6(T nominal^-1); exp6(s) D moves it by Jlog6(D) Ad(D^-1) s."""
        difference = pin.SE3(value @ inverse(self.nominal))
        return pin.log6(difference).vector, pin.Jlog6(difference) @ difference.inverse().action
