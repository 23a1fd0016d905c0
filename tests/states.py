"""States of sessions with given values, and what they predict, for tests of the estimation."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.targets import bend_key, print_key, target_key
from urdfcal.estimation.joint_models import joint_models_of
from urdfcal.estimation.measurements.pixels import camera_state
from urdfcal.estimation.state import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.problem import Problem
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


def state_of(
    session: Session,
    offsets: Floats,
    T_world_base: Floats,
    leds: Floats,
    T_cam_frame: Floats,
    targets: Sequence[Floats] = (),
    **more: Floats,
) -> State:
    """A state of a session with given values; those of joint models may be given by name, such as ``time_offset``."""
    joints = {model.key: more.pop(model.name, model.nominal) for model in joint_models_of(session)}
    if more:
        raise ValueError(f"the session has no joint models {sorted(more)}")
    poses = zip(session.targets, targets, strict=True)
    values = {ARM: offsets, BASE: T_world_base, LEDS: leds[: len(session.leds)]}
    values |= {print_key(target.name): np.zeros(1) for target in session.targets if target.scale_sigma is not None}
    values |= {bend_key(target.name): np.zeros(3) for target in session.targets if target.flatness is not None}
    values |= {target_key(target.name): T for target, T in poses}
    return State({**values, **joints, **camera_state(session, T_cam_frame)})


def true_state_of(simulated: Simulated, **more: Floats) -> State:
    """The true state of a simulated session."""
    truth = simulated.truth
    places = truth.T_world_base, truth.leds, truth.T_cam_frame, truth.targets
    return state_of(simulated.session, truth.offsets, *places, **more)


def at_joint_values(observed: Observations, q: Floats) -> Observations:
    """The same measurements with other joint readings (N, n)."""
    return replace(observed, readings=replace(observed.readings, q=q))


def points_of(problem: Problem, observed: Observations, state: State) -> Floats:
    """What is measured (N, m, 3) in the frames that it is measured from. [m]."""
    _, points = observed.table.points(observed, problem.links(observed.readings, state), state)
    return points
