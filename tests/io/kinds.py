"""Kinds of measurement that the package does not have: with places that only their tables name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from urdfcal.session.measurements import Measurements

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Contacts(Measurements):
    """LEDs that touch a place: a kind without numbers."""

    kind: ClassVar[str] = "contacts"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led", "place")
    dimension: ClassVar[int] = 3
    noise: ClassVar[str] = "contact"
    usual: ClassVar[float] = 3e-4
    unit: ClassVar[str] = "m"

    led: Ints
    place: Ints
    sigma: Floats


@dataclass(frozen=True, eq=False)
class Depths(Measurements):
    """LEDs at a depth below a place: a kind with one number."""

    kind: ClassVar[str] = "depths"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led", "place")
    dimension: ClassVar[int] = 1
    columns: ClassVar[tuple[str, ...]] = ("depth",)
    array: ClassVar[str] = "depth"
    noise: ClassVar[str] = "depth"
    usual: ClassVar[float] = 1e-4
    unit: ClassVar[str] = "m"

    led: Ints
    place: Ints
    depth: Floats
    sigma: Floats
