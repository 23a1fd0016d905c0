"""Rigid bodies with points of known layout: printed boards and tags, a tracker's bodies and probes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, finite_number, frozen, keep
from urdfcal.errors import SessionError
from urdfcal.session.place import check_place

if TYPE_CHECKING:
    from urdfcal.session.pattern import Pattern


@dataclass(frozen=True, eq=False)
class Target:
    """A rigid body on a link of the robot, or one that stands still, whose pose there is one unknown.

    Attributes:
        name: in the tables.
        pattern: its points.
        link: what it is fastened to; "world" for nothing of the robot, None for the tip link.
        T_link_target: (4, 4) how, None where unknown. [m]
        sigma: (6,) how well that is known, standard deviations of a small motion x y z rx ry rz of the target in its
            own frame, 0 exactly; None where it is only a guess to start from. [m, rad]
        scale_sigma: of the share that its lengths may be given too long by; None where nothing is said.
        flatness: how far, one standard deviation, it may be bent along each of its sides and twisted, at its rim; None
            where it is flat. [m]
    """

    name: str
    pattern: Pattern
    link: str | None = None
    T_link_target: Floats | None = None
    sigma: Floats | None = None
    scale_sigma: float | None = None
    flatness: float | None = None

    def __post_init__(self) -> None:
        where = f"targets.{self.name}"
        keep(self, name=str(self.name))
        check_place(self, "T_link_target", where, exact=True)
        if self.scale_sigma is not None:
            keep(self, scale_sigma=finite_number(self.scale_sigma, "scale.sigma", where, zero=True))
        if self.flatness is not None:
            keep(self, flatness=finite_number(self.flatness, "flatness", where, zero=False))
            if not self.pattern.points:
                remedy = "Leave flatness out, or name the print that is on it."
                raise SessionError("a body without points cannot be bent", where=where, remedy=remedy)

    @property
    def point_names(self) -> tuple[str, ...]:
        """What the tables call its M points."""
        return tuple(f"{self.name}:{point}" for point in self.pattern.points)

    @property
    def bends(self) -> Floats:
        """(M, 3) how far each point is off the plane where the print is bent along x, twisted, bent along y by one."""
        return bends_of(self.points)

    @cached_property
    def points(self) -> Floats:
        """(M, 3) points in the target's frame. [m]."""
        return frozen(np.array(list(self.pattern.points.values())).reshape(-1, 3))


def bends_of(points: Floats) -> Floats:
    """How far (M, 3) points (M, 3) of a print are off its plane per unit of its bends: 1 at its rim at most. [m]."""
    middle, half = rim_of(points)
    u, v = ((points[:, :2] - middle) / half).T
    return np.stack([u * u, u * v, v * v], axis=1)


def rim_of(points: Floats) -> tuple[Floats, float]:
    """The middle (2,) of a print with points (M, 3), and half of its longer side: its bends are counted from there."""
    middle: Floats = 0.5 * (points[:, :2].max(axis=0) + points[:, :2].min(axis=0))
    return middle, max(float(0.5 * np.ptp(points[:, :2], axis=0).max()), 1e-9)
