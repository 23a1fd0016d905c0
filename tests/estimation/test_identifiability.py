from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from urdfcal.errors import CalibrationError
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.identifiability import _observability, _sentence, identify
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.start import first_state
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.robot.dh import DHTable
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.exclusion import leave_out
from urdfcal.session.knowledge import Excluded, Led
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.parametrize(
    ("rig", "rank"), [("elbow3r", 15), ("ur5", 27), ("panda", 31), ("stanford", 25), ("so101", 23)]
)
def test_ranks_are_those_of_theory(rig: str, rank: int, simulated: Callable) -> None:
    # r + 3 with r = 4 R + 2 P: one LED of unknown position seen by two known cameras.
    identifiability = Estimated.of(simulated(rig).session).identifiability
    assert identifiability.rank == rank
    assert 1.0 < identifiability.condition_number < 1e4


def test_the_indices_of_sun_and_hollerbach() -> None:
    assert _observability(np.array([8.0, 2.0]), 16) == pytest.approx((1.0, 0.25, 2.0, 0.5, 1.6))


def test_gauge_freedoms_are_named(simulated: Callable) -> None:
    unidentifiable = Estimated.of(simulated("ur5").session).identifiability.unidentifiable
    base, leds = "where the robot stands (T_world_base)", "where the LEDs sit"
    expected = [
        ("d of row 1 (shoulder_pan_joint)", base),
        ("theta of row 1 (shoulder_pan_joint)", base),
        ("theta of row 6 (wrist_3_joint)", leds),
    ]
    assert unidentifiable == tuple(
        f"{what} cannot be distinguished from {other}: it is fixed at its nominal value" for what, other in expected
    )


def test_a_state_with_an_led_behind_a_camera_is_refused(simulated: Callable) -> None:
    data = simulated("elbow3r")
    found = Estimated.of(data.session)
    state = found.fit.state
    turned = np.array(state[BASE]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    turned[:3, 3] *= -1.0
    with pytest.raises(CalibrationError, match="the estimate puts an LED behind a camera"):
        identify(found.problem, state.replace({BASE: turned}), found.fit.parameters)


def test_an_led_on_the_last_axis_identifies_less(simulated: Callable) -> None:
    data = simulated("ur5")
    on_axis = Led("led", np.array([0.0, 0.0, 0.05]), 0.005)
    session = replace(data.session, leds=(on_axis,))
    table = DHTable.from_chain(data.session.chain)
    problem = Problem.of(session, table)
    state = first_state(session, table, np.zeros_like(table.nominal)).replace({LEDS: np.array([[0.0, 0.0, 0.05]])})
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2))
    assert identify(problem, state, parameters).rank == 25


def test_two_runs_fix_the_same_parameters(simulated: Callable) -> None:
    a, b = (Estimated.of(simulated("stanford", seed=seed).session).identifiability for seed in (0, 1))
    assert a.unidentifiable == b.unidentifiable
    assert list(a.parameters.reasons) == list(b.parameters.reasons)


def test_a_lens_or_a_time_offset_is_not_said_to_be_a_cameras_pose(simulated: Callable) -> None:
    session = set_in_motion(simulated("ur5", poses=8), MotionSettings()).session
    table = DHTable.from_chain(session.chain)
    state = start_state(session, table, np.zeros_like(table.nominal)).replace({TIME_OFFSETS: np.zeros(2)})
    problem = Problem.of(session, table)
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", ("free",) * 2, ("fixed", "free")))
    first = parameters.names.index("elbow_joint.theta")
    pose, lens, offset = (parameters.names.index(f"cam1.{what}") for what in ("rz", "cx", "time_offset"))
    said = [_sentence(parameters, first, [k], fix=True) for k in (pose, lens, offset)]
    theta = "theta of row 3 (elbow_joint) cannot be distinguished from"
    assert said == [
        f"{theta} where cam1 is attached: it is fixed at its nominal value",
        f"{theta} cam1.cx: it is fixed at its nominal value",
        f"{theta} cam1.time_offset: it is fixed at its nominal value",
    ]


@pytest.mark.no_cover
def test_what_is_fixed_takes_a_fair_part_in_what_is_unidentifiable(simulated: Callable) -> None:
    # Cameras and LEDs of unknown pose on a tree, no tolerances: nothing but the arm's lengths has the scale. That of
    # the second arm joint, 15 mm, has it too little: 1 mm off there would be 7 % of everything.
    session = simulated("tiago", poses=20, seed=1).session
    session = replace(session, leds=tuple(replace(led, position=None, sigma=None) for led in session.leds))
    table = rows_of(session.chain)
    problem, state = Problem.of(session, table), start_state(session, table, no_offsets(table))
    spec = ModelSpec("dh", ("fixed",), ("refine",), priors=False)
    found = identify(problem, state, choose_parameters(session, problem, state, spec)).parameters
    fixed = set(found.reasons)
    assert {"arm_3_joint.d", "torso_lift_joint.theta"} <= fixed
    assert not {"arm_2_joint.d", "head_1_joint.d"} & fixed
    nominal = dict(zip(table.labels, table.nominal[:, table.columns.index("d")], strict=True))
    assert abs(nominal["arm_2_joint"]) < 0.02 < 0.2 < abs(nominal["arm_3_joint"])


@pytest.mark.parametrize("priors", [True, False])
def test_a_scale_that_one_length_alone_says_is_known_no_better_than_that_one(
    simulated: Callable, *, priors: bool
) -> None:
    session = simulated("elbow3r").session  # whose links have one length beside what the base and the LED take
    session = leave_out(session, Excluded(cameras=session.rig.names[1:]))
    table = DHTable.from_chain(session.chain)
    problem, state = Problem.of(session, table), first_state(session, table, np.zeros_like(table.nominal))
    spec = ModelSpec("dh", ("fixed",), ("fixed",), priors=priors)
    found = identify(problem, state, choose_parameters(session, problem, state, spec))
    assert ("joint_2.a" in found.parameters.reasons) != priors
    (said,) = (sentence for sentence in found.unidentifiable if sentence.startswith("the scale"))
    assert said.endswith("their tolerances decide" if priors else "it is fixed at its nominal value")
