from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from tests.estimation.problems import Estimated
from tests.states import at_joint_values, points_of, state_of
from urdfcal.arrays import rms
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CalibrationError
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import ARM, no_offsets
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import ModelSpec, nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import sketch, solve
from urdfcal.estimation.start import first_state
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.session.knowledge import Estimate, Led, LedDistance, Noise

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

pytestmark = pytest.mark.usefixtures("no_trials")


def noise_free(data: Simulated, true_state: Callable) -> Session:
    """The session's detections replaced by what the true robot shows, with true joint readings."""
    session = replace(data.session, q=data.truth.q)
    problem = Problem.of(session, DHTable.from_chain(session.chain))
    (observed,) = problem.observations
    uv = observed.by_row(problem.predict(observed, true_state(data)))
    return replace(session, measurements=(replace(session.find(Detections), uv=uv),), noise=Noise(0.1, 1e-4, 0.0))


@pytest.mark.parametrize("rig", ["elbow3r", "ur5", "panda", "so101", "stanford"])
def test_noise_free_detections_give_the_truth(rig: str, simulated: Callable, true_state: Callable) -> None:
    data = simulated(rig)
    session = noise_free(data, true_state)
    free = replace(session, leds=tuple(replace(led, position=None, sigma=None) for led in session.leds))
    found = Estimated.of(free, priors=False)
    # Tips, not placements: what only ever appears as a sum may be shared out differently.
    q = session.chain.random_values(100, np.random.default_rng(0))
    arms = (replace(session.chain, placements=p) for p in (data.truth.placements, found.placements))
    assert compare(*arms, q).position.max() < 1e-7
    np.testing.assert_allclose(found.fit.state[LEDS], data.truth.leds, atol=1e-7)
    assert rms(found.problem.residual(found.problem.observations[0], found.fit.state)) < 1e-5


@pytest.mark.no_cover
def test_the_order_of_poses_does_not_matter(simulated: Callable) -> None:
    session = simulated("ur5").session
    d = session.find(Detections)
    order = np.random.default_rng(0).permutation(len(session.poses))
    place = np.argsort(order)
    sorting = np.lexsort((d.led, d.camera, place[d.pose]))
    shuffled = replace(
        session,
        poses=tuple(session.poses[k] for k in order),
        q=session.q[order],
        time=None,
        measurements=(
            Detections(place[d.pose][sorting], d.camera[sorting], d.led[sorting], d.uv[sorting], d.sigma[sorting]),
        ),
    )
    a, b = Estimated.of(session), Estimated.of(shuffled)
    np.testing.assert_allclose(a.placements, b.placements, atol=1e-9)
    np.testing.assert_allclose(a.sigmas_of(ARM), b.sigmas_of(ARM), rtol=1e-6)


def test_moved_detections_are_found_and_left_out(simulated: Callable, fitted: Callable) -> None:
    clean, dirty = fitted("ur5", poses=40), simulated("ur5", poses=40, outliers=0.1)
    detections = dirty.session.find(Detections)
    moved = {(int(detections.pose[k]), int(detections.camera[k])) for k in dirty.truth.outliers}
    assert len(moved) >= 6
    calibration = calibrate(dirty.session)
    names = calibration.session.rig.names
    found = {(calibration.session.poses.index(o.pose), names.index(o.camera)) for o in calibration.document.outliers}
    assert found == moved
    apart = np.abs(clean.placements - calibration.placements)
    assert apart.max() < 5e-4


def test_a_fixed_parameter_does_not_move(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r")
    problem = replace(Problem.of(data.session, DHTable.from_chain(data.session.chain)), joint_sigma=0.0)
    state = true_state(data)
    spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)
    parameters = choose_parameters(data.session, problem, state, spec)
    first = parameters.arm_rows[:2]
    parameters = parameters.fixing({0: "test", 1: "test"})
    assert not set(first) & set(parameters.arm_rows)
    fit = solve(problem, parameters.retract(state, np.full(parameters.count, 1e-4)), parameters)
    for row, name in first:
        column = problem.arm.columns.index(name)
        assert fit.state[ARM][row, column] == state[ARM][row, column]
    assert fit.parameters.count == parameters.size - 2


def test_where_it_stops_another_run_does_not_move(simulated: Callable) -> None:
    session = simulated("panda").session
    fit = Estimated.of(session).fit
    assert fit.converged
    again = solve(Problem.of(session, DHTable.from_chain(session.chain)), fit.state, fit.parameters)
    assert again.cost == pytest.approx(fit.cost, rel=1e-9)
    sigma = np.sqrt(np.diag(fit.covariance)).min()
    assert np.abs(again.state[ARM] - fit.state[ARM]).max() < 1e-3 * sigma


@pytest.mark.no_cover
def test_standard_deviations_are_true(simulated: Callable) -> None:
    # Whitened errors of all estimated offsets over a few runs: mean square 1 within what chance allows.
    squares = []
    for seed in range(6):
        data = simulated("elbow3r", poses=20, seed=seed)
        leds = tuple(replace(led, position=None, sigma=None) for led in data.session.leds)
        found = Estimated.of(replace(data.session, leds=leds), priors=False)
        sigma = found.sigmas_of(ARM)
        offsets = found.fit.state[ARM] - data.truth.offsets
        error = np.array([offsets[row, PARAMETERS.index(name)] for row, name in found.problem.arm.parameters])
        known = np.isfinite(sigma)
        squares.append((error[known] / sigma[known]) ** 2)
    mean = np.mean(np.concatenate(squares))
    assert 0.6 < mean < 1.5


def test_an_led_bar_brings_the_scale_back_to_one_camera(simulated: Callable) -> None:
    # Three LEDs 0.3 m apart, seen by one camera: the truth's own positions, known only through their distances.
    data = simulated("ur5", poses=50)
    session, rig = data.session, data.session.rig
    places = data.truth.leds[0] + np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.15, 0.15 * np.sqrt(3.0), 0.0]])
    leds = tuple(Led(name) for name in ("a", "b", "c"))
    pose, led = np.repeat(np.arange(50), 3), np.tile(np.arange(3), 50)
    blank = Detections(pose, np.zeros(150, int), led, np.zeros((150, 2)), np.full(150, 0.1))
    one = replace(session, rig=Rig(rig.cameras[:1], rig.T_cam_world[:1]), leds=leds, measurements=(blank,))
    state = state_of(one, data.truth.offsets, data.truth.T_world_base, places, np.eye(4)[None])
    problem = Problem.of(replace(one, q=data.truth.q), DHTable.from_chain(one.chain))
    (observed,) = problem.observations
    uv = observed.by_row(problem.predict(observed, state))
    uv = uv + np.random.default_rng(0).normal(0.0, 0.1, uv.shape)
    seen = np.isfinite(uv[:, 0])
    one = replace(one, measurements=(replace(blank, uv=np.nan_to_num(uv)).rows(seen),))
    bar = replace(
        one, led_distances=tuple(LedDistance(pair, 0.3, 1e-5) for pair in (("a", "b"), ("b", "c"), ("a", "c")))
    )

    def error(found: Estimated) -> float:
        q = session.chain.random_values(200, np.random.default_rng(1))
        arms = (replace(session.chain, placements=p) for p in (data.truth.placements, found.placements))
        return float(np.sqrt(np.mean(compare(*arms, q).position ** 2)))

    known, unknown = Estimated.of(bar), Estimated.of(one)
    assert any("scale" in text for text in unknown.identifiability.unidentifiable)
    assert not any("scale" in text for text in known.identifiability.unidentifiable)
    assert known.identifiability.rank == unknown.identifiability.rank + 1
    assert error(known) < 1.2 * error(Estimated.of(session))


def test_whole_placements_can_be_estimated(simulated: Callable, true_state: Callable) -> None:
    data = simulated("elbow3r")
    # An LED of unknown position takes up what no detection can distinguish from moving the last joint.
    session = replace(data.session, estimate=Estimate("full", "fixed", "fixed"), leds=(Led("led"),))
    calibration = calibrate(session)
    assert calibration.estimate.offsets.shape == (3, 6)
    # Where the tip sits beside the LED is shared out by tolerances: the LED itself is what must come out.
    problem = Problem.of(session, DHTable.from_chain(session.chain))
    (observed,) = problem.observations
    q = session.chain.random_values(len(observed.pose), np.random.default_rng(0))
    elsewhere = at_joint_values(observed, q)
    true = points_of(problem, elsewhere, true_state(data))[observed.valid]
    found = points_of(calibration.problem, elsewhere, calibration.fit.state)[observed.valid]
    T = kabsch(found, true)
    assert np.sqrt(np.mean(np.sum((found @ T[:3, :3].T + T[:3, 3] - true) ** 2, axis=1))) < 3e-4
    assert calibration.identifiability.rank == 15


def test_an_exact_led_stays_where_it_is(simulated: Callable) -> None:
    data = simulated("elbow3r")
    exact = replace(
        data.session, leds=(Led("led", data.truth.leds[0], 0.0),), estimate=Estimate("dh", "fixed", "fixed")
    )
    calibration = calibrate(exact)
    np.testing.assert_array_equal(calibration.estimate.leds, data.truth.leds)
    assert 0.5 < calibration.fit.reduced_chi2 < 1.6
    assert calibration.to_dict()["leds"]["led"]["sigma"] == [0.0, 0.0, 0.0]


def test_an_led_is_kept_near_its_measured_position(simulated: Callable) -> None:
    # The LED's prior is centred where the session says, not where the start found it.
    data = simulated("elbow3r", poses=10)
    tight = Led("led", data.truth.leds[0] + [1e-4, 0.0, 0.0], 1e-6)
    calibration = calibrate(replace(data.session, leds=(tight,), estimate=Estimate("dh", "fixed", "fixed")), force=True)
    np.testing.assert_allclose(calibration.estimate.leds[0], tight.position, atol=1e-5)


def test_joint_noise_counts(simulated: Callable) -> None:
    # Readings a hundred times noisier than the rig's: declared, they explain the residuals; undeclared, they do not.
    data = simulated("ur5", poses=50)
    rng = np.random.default_rng(0)
    noisy = replace(data.session, q=data.truth.q + rng.normal(0.0, 1e-3, data.truth.q.shape))
    declared, ignored = (
        Estimated.of(replace(noisy, noise=Noise(0.1, 1e-4, joint))).fit.reduced_chi2 for joint in (1e-3, 0.0)
    )
    assert 0.6 < declared < 1.5
    assert ignored > 10.0


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", [0, 1])
def test_many_outliers_do_not_run_away(seed: int, simulated: Callable) -> None:
    # Three tenths of the detections moved, the second camera's pose unknown: the robust scale must not follow them.
    data = simulated("ur5", poses=50, seed=seed, outliers=0.3)
    rig = data.session.rig
    unplaced = replace(rig, T_cam_world=(rig.T_cam_world[0], None))
    found = Estimated.of(replace(data.session, rig=unplaced))
    q = data.session.chain.random_values(100, np.random.default_rng(0))
    arms = (replace(data.session.chain, placements=p) for p in (data.truth.placements, found.placements))
    assert compare(*arms, q).position.max() < 8e-3
    (observed,), (kept,) = found.problem.observations, found.fit.kept
    assert rms(np.linalg.norm(found.problem.residual(observed, found.fit.state), axis=-1)[kept]) < 0.5


def test_intervals_are_widened_only_by_a_misfit_that_is_certain(simulated: Callable) -> None:
    fit = Estimated.of(simulated("elbow3r").session).fit
    chance = 3.0 * np.sqrt(2.0 / fit.freedom)  # three standard deviations of a reduced chi-square
    expected = np.linalg.inv(fit.information)
    for reduced, factor in ((0.5, 1.0), (1.0 + 0.99 * chance, 1.0), (1.0 + 1.01 * chance, 1.0 + 1.01 * chance)):
        covariance = replace(fit, cost=reduced * fit.freedom).covariance
        np.testing.assert_allclose(covariance, factor * expected, rtol=1e-6, atol=1e-18)


def test_a_solver_that_is_stopped_early_says_so(simulated: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    session = replace(simulated("elbow3r").session, estimate=Estimate("dh", "fixed", "fixed"))
    assert calibrate(session).fit.converged
    monkeypatch.setattr("urdfcal.estimation.solver._MAX_ITERATIONS", 1)
    with pytest.raises(CalibrationError, match=r"did not settle in \d+ steps"):
        calibrate(session)
    assert not calibrate(session, force=True).fit.converged


def test_a_sketch_ends_after_so_many_steps_and_arrives_where_a_few_suffice(simulated: Callable) -> None:
    data = simulated("ur5")
    session, table = data.session, DHTable.from_chain(data.session.chain)
    problem = Problem.of(session, table)
    start = first_state(session, table, no_offsets(table))
    parameters = choose_parameters(session, problem, start, nominal(session, start))
    steps: list[int] = []
    sketch(problem, start, parameters, 2, lambda iteration, _: steps.append(iteration))
    assert steps == [1, 2]
    whole, enough = solve(problem, start, parameters), sketch(problem, start, parameters, 15)
    sigma = np.sqrt(np.diag(whole.covariance))
    before, after = (np.abs(parameters.between(whole.state, of) / sigma).max() for of in (start, enough))
    assert after < 3.0 < before  # outliers are not cut


@pytest.mark.parametrize("joint_noise", [0.0, 1e-4])
def test_a_start_behind_the_cameras_is_refused(joint_noise: float, simulated: Callable) -> None:
    session = simulated("ur5", poses=6).session.with_noise({"joint": joint_noise})
    table = DHTable.from_chain(session.chain)
    problem = Problem.of(session, table)
    start = first_state(session, table, no_offsets(table))
    behind = start.replace({BASE: pin.SE3(np.eye(3), np.array([0.0, 0.0, -9.0])).homogeneous})
    with pytest.raises(CalibrationError, match="the start puts an LED behind a camera"):
        solve(problem, behind, choose_parameters(session, problem, start, nominal(session, start)))
