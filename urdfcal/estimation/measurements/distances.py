"""Distances: what a ball bar or a cable measures from a place that never moves, and that nobody has measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.blocks.places import PLACES, PlacesBlock
from urdfcal.estimation.blocks.scale import SCALE, scale_of
from urdfcal.estimation.measurements.base import BlockSet
from urdfcal.estimation.measurements.contacts import by_thing
from urdfcal.estimation.measurements.leds_in_world import LedPositions

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.model import Session

# Gauss-Newton on four numbers or more: from the linear solution it settles in five steps.
_STEPS = 20


@dataclass(frozen=True, eq=False)
class Distances(LedPositions):
    """Distances of LEDs (any points on links) from places, sorted by pose, LED and place.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        place: (S,) index of the place.
        distance: (S, 1) between them. [m]
        sigma: (S,) its standard deviation; one number serves all. [m]
    """

    kind: ClassVar[str] = "distances"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led", "place")
    dimension: ClassVar[int] = 1
    columns: ClassVar[tuple[str, ...]] = ("distance",)
    array: ClassVar[str] = "distance"
    positive: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    noise: ClassVar[str] = "distance"
    usual: ClassVar[float] = 1e-4
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("mm", 1e3)
    own: ClassVar[Mapping[str, Key[Any]]] = {"place": PLACES}

    led: Ints
    place: Ints
    distance: Floats
    sigma: Floats

    def measured(self, p_world: Floats, index: Mapping[str, Ints], state: State) -> Floats:
        """Return the distances as the instrument measures them."""
        away = np.linalg.norm(p_world - state[PLACES][index["place"]], axis=1, keepdims=True)
        result: Floats = scale_of(state) * away
        return result

    def derivatives(
        self, p_world: Floats, index: Mapping[str, Ints], state: State
    ) -> tuple[Floats, Mapping[Key[Any], Floats]]:
        """Return the directions to the LEDs, minus them by the places, and the distances by the scale."""
        away = (p_world - state[PLACES][index["place"]])[:, None]
        length = np.linalg.norm(away, axis=2, keepdims=True)
        along = scale_of(state) * away / np.maximum(length, 1e-12)
        return along, {PLACES: by_thing(-along, index["place"], len(state[PLACES])), SCALE: length}

    def blocks(self, session: Session, spec: ModelSpec, state: State) -> BlockSet:
        """Return the places."""
        del spec
        return BlockSet((PlacesBlock.of(session, state[PLACES]),))

    def start(self, at: Start, state: State) -> State:
        """Find the places by multilateration from where the nominal arm holds the LEDs, but for those touched."""
        _, p = self.started(at, state)
        places = np.array(state[PLACES]) if PLACES in state else np.zeros((len(at.session.named("place")), 3))
        touched = (table.index["place"] for table in at.session.measurements if "place" in table.index)
        for place in np.setdiff1d(self.place, np.unique(next(touched)) if PLACES in state else []):
            mine = self.place == place
            places[place] = _multilaterate(p[mine], self.distance[mine, 0])
        return state.replace({PLACES: places})


def _multilaterate(points: Floats, distance: Floats) -> Floats:
    """Find the point (3,) at distances (S,) from points (S, 3): 2 p.c - |c|^2 = |p|^2 - d^2, then Gauss-Newton."""
    middle = points.mean(axis=0)
    points = points - middle
    system = np.column_stack([2.0 * points, -np.ones(len(points))])
    place: Floats = np.linalg.lstsq(system, np.sum(points**2, axis=1) - distance**2, rcond=1e-6)[0][:3]
    for _ in range(_STEPS):
        away = place - points
        length = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        place = place - np.linalg.lstsq(away / length[:, None], length - distance, rcond=1e-3)[0]
    found: Floats = place + middle
    return found
