"""Sessions of an arm without cameras: what it touches, or how far it is from something, and the truth behind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.blocks.planes import PLANES
from urdfcal.estimation.linearize import fulfilled
from urdfcal.estimation.measurements import Contacts, Distances, Planes
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.state import State
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Noise, PlaceDistance
from urdfcal.session.model import Session

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.session.rig_description import RigDescription

PLACES_AT = np.array([[0.5, 0.0, 0.3], [0.3, 0.4, 0.2], [0.3, -0.4, 0.4], [0.45, 0.1, 0.6]])
PLANES_AT = np.array([[0.0, 0.0, 1.0, 0.1], [1.0, 0.0, 0.0, 0.6], [0.0, 0.6, 0.8, 0.3], [0.6, -0.8, 0.0, 0.4]])
# Of random poses a third arrives within the joints' limits.
_DRAWN = 8
KINDS: tuple[type[Measurement], ...] = (Contacts, Planes, Distances)


@dataclass(frozen=True, eq=False)
class Touched:
    """A session and the state it was measured in."""

    session: Session
    truth: State


@cache
def arm() -> RigDescription:
    return read_rig(find_rig("panda_sockets"))


def touched(
    kind: type[Measurement],
    count: int = 120,
    seed: int = 0,
    *,
    sigma: float = 1e-4,
    joint: float = 5e-5,
    offsets: Floats | None = None,
    led: Floats | None = None,
    distances: bool = True,
) -> Touched:
    """Touch four things by turns, from random poses; two of the places are known to be at a distance of each other."""
    rng, rig = np.random.default_rng([seed, count]), arm()
    table, rows = rows_of(rig.chain), np.arange(_DRAWN * count)
    (key,) = kind.own
    values = {kind.array: np.ones((len(rows), kind.dimension))} if kind.array else {}
    names = {key: tuple(f"{key}{k}" for k in range(4))}
    index = {"pose": rows, "led": 0 * rows, key: rows % 4}
    measured = kind(**index, **values, sigma=np.array(sigma), names=names)
    apart = float(np.linalg.norm(PLACES_AT[0] - PLACES_AT[1]))
    known = (PlaceDistance(("place0", "place1"), apart, 1e-5),) if distances and key == "place" else ()
    noise = Noise(joint=joint, other={kind.noise: sigma})
    setup = rig.of_setup(noise=noise, place_distances=known, sha256={}, folder=None)
    q = rig.chain.random_values(len(rows), rng)
    session = Session(**setup, poses=tuple(f"p{k}" for k in rows), q=q, measurements=(measured,))
    problem = Problem.of(session, table)
    truth = State(
        {
            ARM: np.zeros((len(table.rows), 5)) if offsets is None else offsets,
            BASE: np.eye(4),
            LEDS: np.array([rig.leds[0].position]) if led is None else led,
            PLACES if key == "place" else PLANES: PLACES_AT if key == "place" else PLANES_AT,
        }
    )
    (observed,) = problem.observations
    off = sigma * rng.standard_normal(observed.value.shape)
    if kind.array:
        off = observed.by_row(problem.predict(observed, truth) + off)
        measured = replace(measured, **{kind.array: off})
        session = replace(session, measurements=(measured,))
    else:
        parameters = choose_parameters(session, problem, truth, ModelSpec("none"))
        arrived = fulfilled(problem, replace(observed, value=off), truth, parameters)
        session = replace(session.at(arrived.pose), q=arrived.readings.q)
    outside = [one.pose for one in rig.chain.outside_limits(rig.chain.readings(session.q), 0.0)]
    things = session.measurements[0].index[key]
    turns = [np.setdiff1d(np.flatnonzero(things == k), outside)[: count // 4] for k in range(4)]
    session = session.at(np.sort(np.concatenate(turns)))
    session = replace(session, poses=tuple(f"p{k}" for k in range(len(session.poses))))
    readings = session.q + joint * rng.standard_normal(session.q.shape)
    return Touched(replace(session, q=readings), truth)
