"""Touched planes: a probe's tip on a table or a wall, flat, and nobody has measured where it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.estimation.blocks.planes import PLANES, PlanesBlock, tangents
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


@dataclass(frozen=True, eq=False)
class Planes(LedPositions):
    """LEDs (any points on links) that touch planes, sorted by pose, LED and plane.

    The radius of a ball that touches is part of the plane's offset: each plane is touched from one side.

    Attributes:
        pose: (S,) index of the pose.
        led: (S,) index of the LED.
        plane: (S,) index of the plane.
        sigma: (S,) standard deviation of the LED's distance from it; one number serves all. [m]
    """

    kind: ClassVar[str] = "planes"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led", "plane")
    dimension: ClassVar[int] = 1
    noise: ClassVar[str] = "plane"
    usual: ClassVar[float] = 1e-4
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("mm", 1e3)
    own: ClassVar[Mapping[str, Key[Any]]] = {"plane": PLANES}

    led: Ints
    plane: Ints
    sigma: Floats

    def measured(self, p_world: Floats, index: Mapping[str, Ints], state: State) -> Floats:
        """Return how far the LEDs are from their planes, along the normals."""
        plane = state[PLANES][index["plane"]]
        result: Floats = (np.sum(plane[:, :3] * p_world, axis=1) - plane[:, 3])[:, None]
        return result

    def derivatives(
        self, p_world: Floats, index: Mapping[str, Ints], state: State
    ) -> tuple[Floats, Mapping[Key[Any], Floats]]:
        """Return the normals, and the derivative by the planes' tilts and offsets."""
        planes = state[PLANES]
        tilt = np.einsum("si,sij->sj", p_world, tangents(planes[:, :3])[index["plane"]])
        by_plane = np.column_stack([tilt, -np.ones(len(tilt))])[:, None]
        return planes[index["plane"], None, :3], {PLANES: by_thing(by_plane, index["plane"], len(planes))}

    def blocks(self, session: Session, spec: ModelSpec, state: State) -> BlockSet:
        """Return the planes."""
        del spec
        return BlockSet((PlanesBlock.of(session, state[PLANES]),))

    def start(self, at: Start, state: State) -> State:
        """Lay each plane through the points that touch it on the nominal arm."""
        _, p = self.started(at, state)
        planes = np.tile([0.0, 0.0, 1.0, 0.0], (len(at.session.named("plane")), 1))
        for plane in np.unique(self.plane):
            points = p[self.plane == plane]
            middle = points.mean(axis=0)
            normal = np.linalg.svd(points - middle, full_matrices=True)[2][2]
            normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
            planes[plane] = [*normal, normal @ middle]
        return state.replace({PLANES: planes})
