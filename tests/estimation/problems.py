"""Problems in which everything is estimated that a session can hold, for tests of blocks and of measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.identifiability import Identifiability, identify
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.joint_models.time_offset import time_offsets
from urdfcal.estimation.model_spec import ModelSpec, nominal
from urdfcal.estimation.parameters import Parameters, choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import Solution, solve
from urdfcal.estimation.start import first_state
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.robot.placements import PlacementTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.model import Session  # noqa: TC001  # a field's type
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.knowledge import ArmGeometry

# Random steps from the start: derivatives there are not those of a special case, and LEDs stay in front of the cameras.
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Example:
    """A session's problem, and a state of it where nothing is nominal.

    Attributes:
        session: with all joint models on that apply to it.
        problem: of all its measurements.
        start: where the session's measurements put what is unknown.
        state: a random step of all active parameters from there.
        parameters: everything free, lenses and camera poses included.
    """

    session: Session
    problem: Problem
    start: State
    state: State
    parameters: Parameters

    @classmethod
    def of(cls, session: Session, geometry: ArmGeometry) -> Example:
        """Free everything of a session with an arm's geometry."""
        models = {model.name: True for model in JOINT_MODELS if model.of(session) is not None}
        session = replace(session, joint_models=models)
        arm = PlacementTable(session.chain) if geometry == "full" else rows_of(session.chain)
        problem = Problem.of(session, arm)
        start = first_state(session, arm, no_offsets(problem.arm))
        free = ("free",) * len(session.rig.cameras)
        parameters = choose_parameters(session, problem, start, ModelSpec(geometry, free, free))
        size = np.minimum(_STEP, parameters.prior[parameters.active])
        step = size * np.random.default_rng(0).normal(size=parameters.count)
        return cls(session, problem, start, parameters.retract(start, step), parameters)


@dataclass(frozen=True, eq=False)
class Estimated:
    """The rigid arm before the cameras as they are given.

    Attributes:
        session: of a moving arm with the time offsets that were found.
        problem: of all its measurements.
        identifiability: of the arm's parameters.
        fit: the estimate.
    """

    session: Session
    problem: Problem
    identifiability: Identifiability
    fit: Solution

    @classmethod
    def of(cls, session: Session, geometry: ArmGeometry = "dh", *, priors: bool = True) -> Estimated:
        """Estimate, without what takes `calibrate` most of a second: models to compare, folds, regions and causes."""
        arm = rows_of(session.chain)
        start = start_state(session, arm, no_offsets(arm))
        problem = Problem.of(session.recorded(time_offsets(start)), arm)
        base = nominal(session, start, priors=priors)
        drawn = solve(problem, start, choose_parameters(session, problem, start, base)).state
        parameters = choose_parameters(session, problem, drawn, replace(base, geometry=geometry))
        found = identify(problem, drawn, parameters)
        fit = solve(problem, drawn, found.parameters)
        return cls(session.with_time_offsets(time_offsets(fit.state)), problem, found, fit)

    @property
    def placements(self) -> Floats:
        """(n, 4, 4) of each joint in the frame of its parent joint. [m]"""
        return self.problem.arm.placements(self.problem.offsets(self.fit.state))

    def sigmas_of(self, key: Key[Any]) -> Floats:
        """Standard deviations of a block's coordinates; NaN where one is fixed."""
        parameters = self.fit.parameters
        return parameters.sigmas(self.fit.covariance)[parameters.columns(key)]


def at_rest(simulated: Callable) -> Session:
    """An arm with a prismatic joint, before two cameras."""
    return simulated("stanford", poses=8).session


def branched(simulated: Callable) -> Session:
    """A robot of two arms with an LED on each, before two eye-to-hand cameras."""
    return simulated("tiago_dual", poses=8).session


def eye_in_hand(simulated: Callable) -> Session:
    """A robot whose camera, on one branch, sees the LEDs of another."""
    return simulated("tiago", poses=8).session


def filmed(simulated: Callable) -> Session:
    """An arm filmed in motion."""
    return set_in_motion(simulated("elbow3r", poses=6), MotionSettings(frame_rate=1.0)).session
