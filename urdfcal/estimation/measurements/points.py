"""Points: LED positions that a tracker measured, or that were triangulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.scale import SCALE, scale_of
from urdfcal.estimation.measurements.base import ByFrame, Measurement, WorldPoints
from urdfcal.estimation.measurements.point_geometry import by_frames, led_points, put_leds, seen_from

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.state import State
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Points(Measurement):
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

    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return the LEDs' positions in the world as the instrument measures them, (N, m, 3). [m]."""
        return scale_of(state) * self.points(observed, links, state)[1]

    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        """Differentiate the LEDs' positions in the world."""
        lever, p_base = led_points(observed, links, state)
        world = np.zeros_like(observed.row)
        E = np.repeat(scale_of(state) * np.swapaxes(links.R[0], 1, 2), world.shape[1], axis=0)
        E[~observed.valid.ravel()] = 0.0
        put_leds(J, observed, links, E)
        led_frame = links.attachments.led[observed.index["led"]]
        p_world = seen_from(links, p_base, world)
        if J.wants(SCALE):
            J.put(SCALE, np.where(observed.valid[..., None], p_world, 0.0).reshape(-1, 3, 1))
        return ByFrame(scale_of(state) * p_world, by_frames(links, E, lever, p_base, led_frame, world))

    def points(self, observed: Observations, links: Links, state: State) -> tuple[Ints, Floats]:
        """Return the world as the frame, and the LEDs' positions in it."""
        _, p_base = led_points(observed, links, state)
        world = np.zeros_like(observed.row)
        return world, seen_from(links, p_base, world)

    def defines_world(self, attachments: Attachments) -> bool:
        """Return True: the tracker's frame is the world."""
        del attachments
        return True

    def world_points(self, session: Session) -> WorldPoints:
        """Return the points as they are."""
        del session
        return WorldPoints(self.pose, self.led, self.xyz)


@dataclass(frozen=True, eq=False)
class TriangulatedPoints(Points):
    """Points where the rays of several cameras meet, with a covariance each.

    Attributes:
        covariance: (S, 3, 3). [m^2]
    """

    covariance: Floats

    @property
    def covariances(self) -> Floats:
        """Covariance (S, 3, 3) of each point. [m^2]."""
        return self.covariance
