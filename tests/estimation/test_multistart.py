from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.states import at_joint_values, points_of
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.cameras import has_cameras
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.multistart import _same_arm, _screen, _start
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.session.knowledge import Estimate, Noise
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.solver import Solution
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session


@pytest.mark.no_cover
def test_the_problem_of_rossi_et_al_a_3r_arm_from_far_starts(simulated: Callable, true_state: Callable) -> None:
    # a, d and alpha of a three-axis arm unknown, no priors, no noise: the example of Rossi et al..
    data = simulated("elbow3r", poses=30)
    session = replace(
        data.session,
        q=data.truth.q,
        noise=Noise(0.1, 1e-4, 0.0),
        leds=tuple(replace(led, position=None, sigma=None) for led in data.session.leds),
        estimate=Estimate("dh", "fixed", "fixed"),
    )
    problem, truth = Problem.of(session, DHTable.from_chain(session.chain)), true_state(data)
    (observed,) = problem.observations
    uv = observed.by_row(problem.predict(observed, truth))
    session = replace(session, measurements=(replace(session.find(Detections), uv=uv),))
    calibration = calibrate(session, priors=False, starts=24, seed=3)

    reasons = [solution.reason for solution in calibration.solutions]
    assert len(reasons) == 25
    assert all(reasons)
    assert [solution.kept for solution in calibration.solutions].count(True) == 1
    assert calibration.solutions[0].kept
    assert any("other signs" in reason for reason in reasons)
    assert any("chi-square" in reason or "did not settle" in reason or "no start" in reason for reason in reasons)

    # The kept one predicts poses it has not seen.
    q = session.chain.random_values(len(observed.pose), np.random.default_rng(9))
    elsewhere = at_joint_values(observed, q)
    true, found = (points_of(problem, elsewhere, s)[observed.valid] for s in (truth, calibration.fit.state))
    T = kabsch(found, true)
    assert np.abs(found @ T[:3, :3].T + T[:3, 3] - true).max() < 1e-6


@pytest.mark.no_cover
def test_the_kept_solution_is_the_one_near_nominal(simulated: Callable) -> None:
    data = simulated("elbow3r")
    session = replace(data.session, estimate=Estimate("dh", "fixed", "fixed"))
    alone, among = calibrate(session), calibrate(session, starts=6)
    np.testing.assert_allclose(alone.placements, among.placements, atol=1e-7)
    assert len(among.to_dict()["solutions"]) == 7


def test_arms_that_differ_only_where_a_moving_arm_did_not_go_are_not_the_same(simulated: Callable) -> None:
    session = set_in_motion(simulated("ur5", poses=8), MotionSettings()).session
    table = DHTable.from_chain(session.chain)
    nominal = start_state(session, table, np.zeros_like(table.nominal))
    other = nominal.replace({ARM: 0.1 * (np.arange(5) == 0) * np.ones_like(table.nominal)})
    log = session.motion.log  # of an arm that stayed where it was: any arm puts one LED there
    still = replace(log, values=np.broadcast_to(log.values[0], log.values.shape))
    problem = Problem.of(replace(session, motion=replace(session.motion, log=still)), table)
    a, b = (SimpleNamespace(state=state) for state in (nominal, other))
    assert _same_arm(problem, a, a)
    assert not _same_arm(problem, a, b)


@pytest.mark.no_cover
def test_only_lengths_and_angles_start_elsewhere(simulated: Callable) -> None:
    session = replace(simulated("elbow3r", poses=8).session, estimate=Estimate("dh", "fixed", "fixed"))
    calibration = calibrate(session, force=True)
    arm, *others = calibration.fit.parameters.blocks
    other = replace(arm, units=("1", *arm.units[1:]))  # half a turn would mean nothing for it
    first = replace(calibration.fit, parameters=replace(calibration.fit.parameters, blocks=(other, *others)))
    rng = np.random.default_rng(0)
    drawn = other.local(_start(session, calibration.problem, first, rng, far=True)[ARM])[0]
    np.testing.assert_array_equal(drawn != 0.0, other.active & (np.arange(len(other)) > 0))


@pytest.mark.no_cover
def test_cameras_have_no_part_in_other_starts_from_points(simulated: Callable) -> None:
    session = replace(simulated("ur5").session, estimate=Estimate("dh", "fixed", "fixed"))
    calibration = calibrate(session, method="points", starts=2)
    states = [minimum.solution.state for minimum in calibration.solutions if minimum.solution]
    assert len(states) == 3
    assert not any(has_cameras(state) for state in states)
    assert calibration.document.validation.rms_px is None  # whichever of the equal minima was kept


@pytest.fixture(scope="module")
def calibration(fitted: Callable) -> FittedCalibration:
    return fitted("elbow3r", estimate=Estimate("dh", "fixed", "fixed"))


def moved(calibration: FittedCalibration, parameter: str, tolerances: float, cost: float = 0.0) -> Solution:
    """Another minimum: one parameter so many tolerances from nominal, the chi-square other by ``cost``."""
    fit = calibration.fit
    block = next(block for block in fit.parameters.blocks if block.key == ARM)
    k = block.names.index(parameter)
    offsets = np.array(fit.state[ARM])
    offsets[block.places[0][k], block.places[1][k]] = tolerances * block.sigma[k]
    return replace(fit, state=fit.state.replace({ARM: offsets}), cost=fit.cost + cost)


def screened(
    calibration: FittedCalibration, *found: Solution, session: Session | None = None
) -> tuple[Solution | None, dict[int, str]]:
    """The minimum that is kept, and what is said of each."""
    minima = _screen(session or calibration.session, calibration.problem, found)
    assert [minimum.kept for minimum in minima] == [k == 0 and minima[0].kept for k in range(len(minima))]
    return minima[0].solution if minima[0].kept else None, {id(m.solution): m.reason for m in minima}


@pytest.mark.parametrize("first", [True, False])
def test_of_equally_likely_minima_the_nearest_to_nominal_is_kept(calibration: FittedCalibration, first: bool) -> None:
    near, far = moved(calibration, "joint_2.a", 3.0), moved(calibration, "joint_2.a", 12.0, cost=-20.0)
    kept, reasons = screened(calibration, *((near, far) if first else (far, near)))
    assert kept is near
    assert reasons == {
        id(near): "nearest to nominal among the best",
        id(far): "farther from nominal: an offset of 12 tolerances",
    }


def test_minima_that_no_arm_has_are_named_so(calibration: FittedCalibration) -> None:
    near = moved(calibration, "joint_2.a", 3.0)
    for tolerances, word in ((19.8, "farther from nominal"), (20.2, "outside tolerance")):
        far = moved(calibration, "joint_2.a", tolerances)
        _, reasons = screened(calibration, far, near)
        assert reasons[id(far)] == f"{word}: an offset of 20 tolerances"


def test_each_parameter_is_judged_by_its_own_tolerance(calibration: FittedCalibration) -> None:
    a, alpha = moved(calibration, "joint_2.a", 12.0), moved(calibration, "joint_2.alpha", 14.0)
    assert screened(calibration, alpha, a)[0] is a
    loose = replace(calibration.session.tolerances, joints={"joint_2": {"alpha": 1.0}})
    session = replace(calibration.session, tolerances=loose)
    assert screened(calibration, alpha, a, session=session)[0] is alpha


def test_unlikely_minima_and_those_of_a_solver_that_did_not_settle_are_discarded(
    calibration: FittedCalibration,
) -> None:
    far, near = moved(calibration, "joint_2.a", 12.0), moved(calibration, "joint_2.a", 1.0, cost=25.1)
    kept, reasons = screened(calibration, near, far)
    assert kept is far
    assert reasons[id(near)].endswith("more than chance")
    assert screened(calibration, replace(near, cost=far.cost + 24.9), far)[0] is not far
    lost = replace(near, converged=False, cost=0.0)
    kept, reasons = screened(calibration, lost, far)
    assert kept is far
    assert reasons[id(lost)] == "the solver did not settle"
    assert screened(calibration, lost)[0] is None


def test_the_same_arm_is_named_as_such(calibration: FittedCalibration) -> None:
    fit = calibration.fit
    again = replace(fit, cost=fit.cost + 1e-6)
    kept, reasons = screened(calibration, fit, again)
    assert kept is fit
    assert reasons[id(again)] == "the same minimum"
