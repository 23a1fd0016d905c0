"""Contacts of a simulated robot: joint values at which a point of it rests in a place."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import frozen
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.linearize import fulfilled
from urdfcal.estimation.measurements import Contacts
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.state import State
from urdfcal.robot.flexure import rigid_joints
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.model import Session
from urdfcal.simulation.planning import joint_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats, Ints
    from urdfcal.session.rig_description import RigDescription
    from urdfcal.simulation.planning import CollisionChecker
    from urdfcal.simulation.scene import Scene

# Random poses from which the places are approached, and how many of the nearest are tried for each pose that is asked
# for: on a Panda a quarter arrives within the joints' limits.
_DRAWN, _TRIED = 20_000, 12


def touch_places(
    rig: RigDescription,
    true: Scene,
    offsets: Floats,
    count: int,
    noise: float,
    rng: np.random.Generator,
    checker: CollisionChecker | None,
    progress: Callable[[int], object] | None = None,
) -> tuple[Floats, Contacts]:
    """Find poses in which LEDs rest in the rig's places, place by place and LED by LED by turns.

    Args:
        rig: names the places.
        true: the robot that touches them.
        offsets: (n, 5) of its DH rows. [rad, m]
        count: how many poses.
        noise: of an LED about its place, one standard deviation of each coordinate. [m]
        rng: the source of randomness.
        checker: says which poses the arm can take; None when that is not known.
        progress: called with the number of poses found since the last call.

    Returns:
        (count, n) true values of all joints [rad or m], and the contacts.

    Raises:
        SessionError: a place is out of reach.
    """
    chain, places = rig.chain, np.array(list(rig.places.values()))
    lower, upper = joint_limits(chain)
    read = [i for i, joint in enumerate(chain.joints) if joint.mimic is None]
    drawn = chain.joint_values(rng.uniform(lower[read], upper[read], (_DRAWN, len(read))))
    tips = true.led_positions(drawn)
    turns = np.arange(count)
    led, place = turns // len(places) % len(rig.leds), turns % len(places)
    wanted = {pair: np.flatnonzero((led == pair[0]) & (place == pair[1])) for pair in zip(led, place, strict=True)}
    tried = [
        (*pair, k)
        for pair, mine in wanted.items()
        for k in np.argsort(np.linalg.norm(tips[:, pair[0]] - places[pair[1]], axis=1))[: _TRIED * len(mine)]
    ]
    q, which = _arrive(rig, true, offsets, drawn[[k for *_, k in tried]], np.array(tried)[:, :2].T, noise, rng)
    free = [one for one in range(len(q)) if ((q[one] >= lower) & (q[one] <= upper)).all()]
    chosen = np.zeros((count, drawn.shape[1]))
    for pair, mine in wanted.items():
        there = (q[one] for one in free if tuple(which[:, one]) == pair)
        good = list(islice((one for one in there if checker is None or checker.is_free(one)), len(mine)))
        if len(good) < len(mine):
            names = rig.leds[pair[0]].name, list(rig.places)[pair[1]]
            what = f"{len(good)} of {len(mine)} poses found in which {names[0]!r} rests in {names[1]!r}"
            raise SessionError(what, where="places", remedy="Move it to where the arm reaches it in many ways.")
        chosen[mine] = good
        if progress:
            progress(len(mine))
    return chosen, Contacts(turns, led, place, np.array(rig.noise.of(Contacts)), names={"place": tuple(rig.places)})


def _arrive(
    rig: RigDescription, true: Scene, offsets: Floats, q: Floats, what: Ints, noise: float, rng: np.random.Generator
) -> tuple[Floats, Ints]:
    """Move from joint values (K, n) to where LEDs rest in places, ``what`` (2, K); which do not arrive are left out."""
    contacts = Contacts(np.arange(len(q)), what[0], what[1], np.array(1.0), names={"place": tuple(rig.places)})
    session = Session(**rig.of_setup(), poses=tuple(map(str, range(len(q)))), q=q, measurements=(contacts,))
    problem = Problem.of(session, rows_of(rig.chain))
    places = np.array(list(rig.places.values()))
    state = State({ARM: offsets, BASE: true.T_world_base, LEDS: true.leds, PLACES: places})
    (observed,) = problem.observations
    off = frozen(noise * rng.standard_normal(observed.value.shape))
    parameters = choose_parameters(session, problem, state, ModelSpec("none"))
    arrived = fulfilled(problem, replace(observed, value=off), state, parameters)
    return arrived.readings.q[:, rigid_joints(problem.mechanism)], what[:, arrived.pose]
