"""Measurements of LEDs that are placed in the world alone, whatever it is that is measured of them there."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.targets import point_places, target_key
from urdfcal.estimation.measurements.base import ByFrame, Measurement
from urdfcal.estimation.measurements.point_geometry import by_frames, led_points, put_leds, seen_from

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State


class LedPositions(Measurement):
    """D numbers that follow from an LED's position in the world, and from the measurement's own unknowns.

    A kind says what they are of S points, and their derivatives; where the LEDs are is common to all.
    """

    led: Ints

    @abstractmethod
    def measured(self, p_world: Floats, index: Mapping[str, Ints], state: State) -> Floats:
        """Return what should be measured (S, D) of LEDs at points (S, 3), rows of the table's ``index`` (S,). [m]."""

    @abstractmethod
    def derivatives(
        self, p_world: Floats, index: Mapping[str, Ints], state: State
    ) -> tuple[Floats, Mapping[Key[Any], Floats]]:
        """Return its derivative (S, D, 3) by the points, and (S, D, k) by the measurement's own blocks."""

    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return what should be measured (N, m, D); zero for padding."""
        slots, p_world, index = _slots(observed, self.points(observed, links, state)[1])
        result = np.zeros((observed.row.size, self.dimension))
        result[slots] = self.measured(p_world, index, state)
        return result.reshape(*observed.row.shape, self.dimension)

    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        """Differentiate by the frames, the LEDs, and the measurement's own unknowns."""
        lever, p_base = led_points(observed, links, state)
        world = np.zeros_like(observed.row)
        slots, p_world, index = _slots(observed, seen_from(links, p_base, world))
        by_point, own = self.derivatives(p_world, index, state)
        E, predicted = np.zeros((world.size, self.dimension, 3)), np.zeros((world.size, self.dimension))
        R_world_base = np.swapaxes(links.R[0], 1, 2)[slots // world.shape[1]]
        E[slots], predicted[slots] = by_point @ R_world_base, self.measured(p_world, index, state)
        put_leds(J, observed, links, E, lever, state)
        for key, values in own.items():
            J.put(key, values, slots)
        led_frame = links.attachments.led[observed.index["led"]]
        return ByFrame(
            predicted.reshape(*world.shape, self.dimension), by_frames(links, E, lever, p_base, led_frame, world)
        )

    def points(self, observed: Observations, links: Links, state: State) -> tuple[Ints, Floats]:
        """Return the world as the frame, and the LEDs' positions in it."""
        _, p_base = led_points(observed, links, state)
        world = np.zeros_like(observed.row)
        return world, seen_from(links, p_base, world)

    def started(self, at: Start, state: State) -> tuple[Floats, Floats]:
        """Return the LEDs' frames (S, 4, 4) and the LEDs (S, 3), both in the world, on the arm to start from. [m].

        Where nothing has placed the base yet the base link's frame is the world.
        """
        attachments = at.session.attachments
        unplaced = {target_key(name): np.eye(4) for name in attachments.targets if target_key(name) not in state}
        state, frames = state.replace(unplaced), attachments.led[self.led]
        T = np.empty((len(self), 4, 4))
        for frame in np.unique(frames).tolist():
            mine = frames == frame
            T[mine] = at.frame(frame, self.pose[mine], state)
        T = inverse(at.frame(0, self.pose, state)) @ T
        points = point_places(attachments, state)[self.led]
        return T, (T[:, :3, :3] @ points[..., None])[..., 0] + T[:, :3, 3]


def _slots(observed: Observations, p_world: Floats) -> tuple[Ints, Floats, dict[str, Ints]]:
    """The slots (S,) that are no padding, among all N m, with their points (S, 3) and indices."""
    slots = np.flatnonzero(observed.valid)
    return slots, p_world.reshape(-1, 3)[slots], {key: of.ravel()[slots] for key, of in observed.index.items()}
