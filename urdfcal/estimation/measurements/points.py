"""Points: LED positions that a tracker measured, or that were triangulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.blocks.scale import SCALE, scale_of
from urdfcal.estimation.measurements.base import WorldPoints
from urdfcal.estimation.measurements.leds_in_world import LedPositions
from urdfcal.estimation.target_start import TargetViews, space_poses

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Points(LedPositions):
    """LEDs measured in 3-D, sorted by pose and LED.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        xyz: (S, 3) in the tracker's frame. [m]
        sigma: (S,) standard deviation of each coordinate; one number serves all. [m]
    """

    kind: ClassVar[str] = "points"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led")
    dimension: ClassVar[int] = 3
    columns: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    array: ClassVar[str] = "xyz"
    noise: ClassVar[str] = "point"
    usual: ClassVar[float] = 1e-4
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("mm", 1e3)

    led: Ints
    xyz: Floats
    sigma: Floats

    def measured(self, p_world: Floats, index: Mapping[str, Ints], state: State) -> Floats:
        """Return the points as the instrument measures them."""
        del index
        return scale_of(state) * p_world

    def derivatives(
        self, p_world: Floats, index: Mapping[str, Ints], state: State
    ) -> tuple[Floats, Mapping[Key[Any], Floats]]:
        """Return the scale times the identity, and the points by the scale."""
        del index
        return np.broadcast_to(scale_of(state) * np.eye(3), (len(p_world), 3, 3)), {SCALE: p_world[..., None]}

    def defines_world(self, attachments: Attachments) -> bool:
        """Return True: the tracker's frame is the world."""
        del attachments
        return True

    def target_views(self, session: Session) -> Iterator[TargetViews]:
        """Align each target with its points at every pose."""
        attachments = session.attachments
        target, first = attachments.led[self.led] - attachments.first_target, len(session.leds)
        for t in np.unique(target[target >= 0]).tolist():
            mine = np.flatnonzero(target == t)
            points = attachments.target_points[self.led[mine] - first]
            pose, T = space_poses(self.pose[mine], points, self.xyz[mine])
            yield TargetViews(t, 0, np.eye(4), pose, T)

    def world_points(self, session: Session) -> WorldPoints:
        """Return the points as they are."""
        del session
        return WorldPoints(self.pose, self.led, self.xyz)


@dataclass(frozen=True, eq=False)
class CorrelatedPoints(Points):
    """Points with a covariance each: of a tracker, or where the rays of several cameras meet.

    Attributes:
        covariance: (S, 3, 3). [m^2]
    """

    covariance: Floats

    @classmethod
    def of_spread(cls, spread: Floats, **columns: Any) -> CorrelatedPoints:
        """Take covariances as in points.csv, (S, 6): sxx, sxy, sxz, syy, syz, szz. [m^2]."""
        covariance = spread[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
        return cls(**{**columns, "sigma": sigma}, covariance=covariance)

    @property
    def spread(self) -> Floats:
        """(S, 6) the covariances as in points.csv. [m^2]."""
        return self.covariance.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]

    @property
    def covariances(self) -> Floats:
        """Covariance (S, 3, 3) of each point. [m^2]."""
        return self.covariance


SPREAD = ("sxx", "sxy", "sxz", "syy", "syz", "szz")
"""The columns of points.csv that say a covariance instead of a sigma. [m^2]"""
