"""Contacts: a ball in a socket, a probe's tip on a point; the place never moves, and nobody has measured it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES, PlacesBlock
from urdfcal.estimation.measurements.base import BlockSet
from urdfcal.estimation.measurements.leds_in_world import LedPositions

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Contacts(LedPositions):
    """LEDs (any points on links) that rest at places, sorted by pose, LED and place.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        place: (S,) index of the place.
        sigma: (S,) standard deviation of each coordinate of the LED about its place; one number serves all. [m]
    """

    kind: ClassVar[str] = "contacts"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led", "place")
    dimension: ClassVar[int] = 3
    noise: ClassVar[str] = "contact"
    # A ball in a printed socket: calibrated, a Panda's scatters by 0.33 mm about it, noise of its joints included.
    usual: ClassVar[float] = 2e-4
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("mm", 1e3)
    own: ClassVar[Mapping[str, Key[Any]]] = {"place": PLACES}

    led: Ints
    place: Ints
    sigma: Floats

    def measured(self, p_world: Floats, index: Mapping[str, Ints], state: State) -> Floats:
        """Return how far the LEDs are from their places."""
        result: Floats = p_world - state[PLACES][index["place"]]
        return result

    def derivatives(
        self, p_world: Floats, index: Mapping[str, Ints], state: State
    ) -> tuple[Floats, Mapping[Key[Any], Floats]]:
        """Return the identity, and minus it by the LED's place."""
        identity = np.broadcast_to(np.eye(3), (len(p_world), 3, 3))
        return identity, {PLACES: by_thing(-identity, index["place"], len(state[PLACES]))}

    def blocks(self, session: Session, spec: ModelSpec, state: State) -> BlockSet:
        """Return the places."""
        del spec
        return BlockSet((PlacesBlock.of(session, state[PLACES]),))

    def start(self, at: Start, state: State) -> State:
        """Put each place where its contacts are in the median; unknown LEDs by what leaves their places still."""
        T, p = self.started(at, state)
        lost = np.intersect1d(self.led, np.flatnonzero(at.unknown_leds))
        if lost.size:  # R led + p - place = 0 is linear in both
            mine = np.isin(self.led, lost)
            which, (_, where) = np.searchsorted(lost, self.led[mine]), np.unique(self.place[mine], return_inverse=True)
            system = np.concatenate(
                [by_thing(T[mine, :3, :3], which, len(lost)), by_thing(-np.eye(3), where, where.max() + 1)], axis=-1
            )
            found = np.linalg.lstsq(system.reshape(-1, system.shape[-1]), -T[mine, :3, 3].ravel(), rcond=1e-9)[0]
            leds = np.array(state[LEDS])
            leds[lost] = found[: 3 * len(lost)].reshape(-1, 3)
            state = state.replace({LEDS: leds})
            _, p = self.started(at, state)
        places = np.zeros((len(at.session.named("place")), 3))
        for place in np.unique(self.place):
            places[place] = np.median(p[self.place == place], axis=0)
        return state.replace({PLACES: places})


def by_thing(derivative: Floats, thing: Ints, count: int) -> Floats:
    """Spread derivatives (S, D, k) by the unknowns of one thing over those of all things, (S, D, k count)."""
    chosen = (thing[:, None] == np.arange(count)).astype(float)
    every = np.broadcast_to(derivative, (len(thing), *derivative.shape[-2:]))
    result: Floats = np.einsum("sdj,sp->sdpj", every, chosen)
    return result.reshape(*result.shape[:2], -1)
