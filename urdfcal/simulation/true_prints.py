"""The prints of a simulated rig's targets as they came out: larger or smaller than they should be, and not flat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.session.target import rim_of
from urdfcal.simulation.prints import Bulge, PlacedPrint, prints_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.session.rig_description import RigDescription
    from urdfcal.session.target import Target


@dataclass(frozen=True, eq=False)
class TruePrint:
    """How a target was printed.

    Attributes:
        given_too_long: share that its lengths are given too long by.
        bends: (3,) how far its rim is off its plane, bent along x, twisted, bent along y. [m]
    """

    given_too_long: float
    bends: Floats

    @property
    def as_given(self) -> bool:
        """Whether it is flat, and as large as it should be."""
        return self.given_too_long == 0.0 and not self.bends.any()

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"given_too_long": self.given_too_long, "bends": self.bends.tolist()}


def printed(rig: RigDescription, points: Floats, prints: Sequence[TruePrint]) -> Floats:
    """Return LEDs and targets' points (L + M, 3) with these as they were printed. [m]."""
    points, attachments = points.copy(), rig.attachments
    for k, (target, of) in enumerate(zip(rig.targets, prints, strict=True), attachments.first_target):
        points[attachments.led == k] = true_points(target, of)
    return points


def draw_prints(targets: Sequence[Target], rng: np.random.Generator) -> tuple[TruePrint, ...]:
    """Draw how targets were printed, as well as each says that it is known."""
    found = []
    for target in targets:
        bends = np.zeros(3) if target.flatness is None else rng.normal(0.0, target.flatness, 3)
        given_too_long = 0.0 if target.scale_sigma is None else float(rng.normal(0.0, target.scale_sigma))
        found.append(TruePrint(given_too_long, bends))
    return tuple(found)


def true_points(target: Target, of: TruePrint) -> Floats:
    """Compute where a target's points (M, 3) are in its frame. [m]."""
    points = np.array(target.points)
    points[:, 2] += target.bends @ of.bends
    return points / (1.0 + of.given_too_long)


def pieces_of(target: Target, of: TruePrint) -> list[PlacedPrint]:
    """Return the pieces of a target as they were printed, placed in its frame."""
    larger = np.diag([*[1.0 / (1.0 + of.given_too_long)] * 3, 1.0])
    middle, half = rim_of(target.points)
    pieces = []
    for T_target_print, piece in prints_of(target.pattern):
        bulge = Bulge(T_target_print, of.bends, middle, half) if of.bends.any() else None
        pieces.append(PlacedPrint(larger @ T_target_print, piece, bulge))
    return pieces
