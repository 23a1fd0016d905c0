from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import RIGID
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.cameras import camera_poses, camera_values, lens_key, pose_key
from urdfcal.estimation.camera_prior import FREE_LENS, REFINED_POSE, CameraPrior
from urdfcal.estimation.measurements.pixels import camera_state
from urdfcal.estimation.model_spec import ModelSpec, candidates
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.state import State
    from urdfcal.simulation.truth import Simulated

# Two cameras with eight parameters each, and the second one's pose: all errors correlated.
COUNT = 22
LENSES, POSE = (slice(0, 8), slice(8, 16)), slice(16, 22)
SIGMA = np.concatenate([[0.6, 0.6, 0.9, 0.8, 1e-3, 3e-3, 1e-4, 1e-4] * 2, [2e-4] * 3, [4e-4] * 3])
FACTOR = np.random.default_rng(0).normal(size=(COUNT, 40))
COVARIANCE = np.outer(SIGMA, SIGMA) * np.corrcoef(FACTOR)
PRIOR_ORDER = np.r_[16:22, 0:16]


def calibrated(rig: Rig, covariance: np.ndarray = COVARIANCE) -> Rig:
    """The rig with the knowledge of its cameras that a covariance says, COUNT x COUNT."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    correlation = 0.5 * (correlation + correlation.T)
    sigmas = (
        CameraSigma(sigma[:8], None, correlation[:8, :8]),
        CameraSigma(sigma[8:16], sigma[16:], correlation[8:]),
    )
    return Rig(rig.cameras, rig.T_cam_world, sigmas)


def covariance_of(prior: CameraPrior) -> np.ndarray:
    return prior.correlation * np.outer(prior.sigma, prior.sigma)


@pytest.fixture
def data(simulated: Callable) -> Simulated:
    data = simulated("elbow3r", poses=8)
    return replace(data, session=replace(data.session, rig=calibrated(data.session.rig)))


def chosen(data: Simulated, state: State, intrinsics: tuple[str, str], extrinsics: tuple[str, str]) -> Parameters:
    problem = Problem.of(data.session, DHTable.from_chain(data.session.chain))
    return choose_parameters(data.session, problem, state, ModelSpec("dh", intrinsics, extrinsics))


def test_refined_cameras_have_the_covariance_of_their_calibration(data: Simulated) -> None:
    prior = CameraPrior.of(data.session, ModelSpec("dh", ("refine",) * 2, ("fixed", "refine")), [1], [0, 1])
    np.testing.assert_allclose(covariance_of(prior), COVARIANCE[np.ix_(PRIOR_ORDER, PRIOR_ORDER)], rtol=1e-12)
    assert prior.measured.all()


def test_what_is_fixed_is_exactly_known(data: Simulated) -> None:
    # Conditional covariance: the information about the rest.
    information = np.linalg.inv(COVARIANCE)
    lenses = CameraPrior.of(data.session, ModelSpec("dh", ("refine",) * 2, ("fixed",) * 2), [], [0, 1])
    np.testing.assert_allclose(covariance_of(lenses), np.linalg.inv(information[:16, :16]), rtol=1e-9)
    pose = CameraPrior.of(data.session, ModelSpec("dh", ("fixed",) * 2, ("fixed", "refine")), [1], [])
    np.testing.assert_allclose(covariance_of(pose), np.linalg.inv(information[POSE, POSE]), rtol=1e-9)
    assert (pose.sigma < SIGMA[POSE]).all()


def test_what_is_free_determines_nothing(data: Simulated) -> None:
    # Marginal covariance, conditioned on the first lens alone.
    prior = CameraPrior.of(data.session, ModelSpec("dh", ("fixed", "free"), ("fixed", "refine")), [1], [1])
    known = np.r_[POSE, LENSES[0]]
    information = np.linalg.inv(COVARIANCE[np.ix_(known, known)])
    np.testing.assert_allclose(covariance_of(prior)[:6, :6], np.linalg.inv(information[:6, :6]), rtol=1e-9)
    np.testing.assert_array_equal(prior.correlation[6:], np.eye(14)[6:])
    assert prior.sigma[6] == FREE_LENS[0] * data.session.rig.cameras[1].intrinsics[0]
    assert prior.measured.tolist() == [True] * 6 + [False] * 8


def test_a_camera_without_standard_deviations_has_assumed_ones(data: Simulated) -> None:
    rig = data.session.rig
    one = replace(data.session, rig=Rig(rig.cameras, rig.T_cam_world, (rig.sigmas[0], None)))
    prior = CameraPrior.of(one, ModelSpec("dh", ("refine",) * 2, ("fixed", "refine")), [1], [0, 1])
    np.testing.assert_array_equal(prior.sigma[:6], REFINED_POSE)
    np.testing.assert_allclose(covariance_of(prior)[6:14, 6:14], COVARIANCE[:8, :8], rtol=1e-12)
    np.testing.assert_array_equal(prior.correlation[14:, :14], np.zeros((8, 14)))


@pytest.mark.parametrize(
    ("intrinsics", "extrinsics"),
    [
        (("refine", "refine"), ("fixed", "fixed")),
        (("fixed", "fixed"), ("fixed", "refine")),
        (("refine", "refine"), ("fixed", "refine")),
        (("refine", "free"), ("fixed", "refine")),
        (("free", "refine"), ("fixed", "free")),
    ],
)
def test_the_derivative_of_priors_agrees_with_finite_differences(
    intrinsics: tuple[str, str], extrinsics: tuple[str, str], data: Simulated, true_state: Callable
) -> None:
    centre = true_state(data)
    parameters = chosen(data, centre, intrinsics, extrinsics)
    rng = np.random.default_rng(1)
    scale = np.where(np.isfinite(parameters.prior), parameters.prior, 0.01)[parameters.active]
    state = parameters.retract(centre, scale * rng.normal(size=parameters.count))
    J = parameters.prior_residuals(state)[1]
    for k in range(parameters.count):
        step = 1e-4 * scale[k] * np.eye(parameters.count)[k]
        before, after = (parameters.prior_residuals(parameters.retract(state, s * step))[0] for s in (-1, 1))
        numeric = (after - before) / (2 * step[k])
        np.testing.assert_allclose(J[:, k], numeric, rtol=1e-6, atol=1e-6 * np.abs(J[:, k]).max())


@pytest.mark.no_cover
def test_prior_residuals_are_white(data: Simulated, true_state: Callable) -> None:
    # Cameras drawn from their calibration's covariance: residuals of unit variance that know nothing of each other.
    centre = true_state(data)
    parameters = chosen(data, centre, ("refine",) * 2, ("fixed", "refine"))
    cameras = slice(parameters.columns(pose_key(data.session.rig.names[1])).start, parameters.size)
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(COUNT), COVARIANCE, 2000)[:, PRIOR_ORDER]
    residuals = []
    for draw in draws:
        step = np.zeros(parameters.size)
        step[cameras] = draw
        residuals.append(parameters.prior_residuals(parameters.retract(centre, step[parameters.active]))[0][-COUNT:])
    np.testing.assert_allclose(np.cov(np.transpose(residuals)), np.eye(COUNT), atol=0.12)


def test_a_fixed_parameter_is_what_the_rest_is_known_by(data: Simulated, true_state: Callable) -> None:
    # Fixed away from the centre, it draws what it is correlated with after it: the conditional mean.
    centre = true_state(data)
    free = chosen(data, centre, ("refine",) * 2, ("fixed", "fixed"))
    index = free.columns(lens_key(data.session.rig.names[0])).start
    step = np.zeros(free.size)
    step[index] = 0.5
    moved = free.retract(centre, step[free.active])
    fixed = free.fixing({index: "test"})
    r, J = fixed.prior_residuals(moved)
    assert len(r) == len(free.prior_residuals(moved)[0]) - 1
    best = np.linalg.lstsq(J, -r, rcond=None)[0][-15:]
    C = np.linalg.inv(np.linalg.inv(COVARIANCE)[:16, :16])
    np.testing.assert_allclose(best, C[1:, 0] / C[0, 0] * 0.5, rtol=1e-6)


def test_exactly_known_values_stay(data: Simulated, true_state: Callable) -> None:
    rig = data.session.rig
    lens, pose = np.array(rig.sigmas[1].parameters), np.array(rig.sigmas[1].pose)
    lens[4], pose[2] = 0.0, 0.0
    exact = Rig(rig.cameras, rig.T_cam_world, (rig.sigmas[0], replace(rig.sigmas[1], parameters=lens, pose=pose)))
    certain = replace(data, session=replace(data.session, rig=exact))
    parameters = chosen(certain, true_state(data), ("refine",) * 2, ("fixed", "refine"))
    second = rig.names[1]
    assert parameters.reasons == dict.fromkeys((f"{second}.z", f"{second}.k1"), "its calibration gives it as exact")
    r, J = parameters.prior_residuals(parameters.retract(true_state(data), np.full(parameters.count, 1e-4)))
    assert np.isfinite(r).all()
    assert np.linalg.matrix_rank(J[-20:]) == 20


def test_measured_cameras_are_refined_unless_the_session_says_otherwise(data: Simulated, true_state: Callable) -> None:
    state = true_state(data)

    def said(**words: object) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
        session = replace(data.session, estimate=Estimate("dh", **words))
        return [(model.intrinsics, model.extrinsics) for model in candidates(session, state)]

    refined = ("fixed", "refine")
    assert said() == [(("refine",) * 2, refined), (("free",) * 2, refined)]
    assert said(intrinsics="fixed") == [(("fixed",) * 2, refined), (("free",) * 2, refined)]
    assert said(extrinsics="fixed")[0] == (("refine",) * 2, ("fixed",) * 2)
    plain = replace(data.session, rig=Rig(data.session.rig.cameras, data.session.rig.T_cam_world))
    first = candidates(plain, state)[0]
    assert (first.intrinsics, first.extrinsics) == (("fixed",) * 2, ("fixed",) * 2)


def test_a_camera_of_unknown_place_cannot_be_fixed(data: Simulated, true_state: Callable) -> None:
    rig = data.session.rig
    session = replace(data.session, rig=Rig(rig.cameras, (np.eye(4), None)), estimate=Estimate(extrinsics="refine"))
    with pytest.raises(SessionError, match="where it stands is not given"):
        candidates(session, true_state(data))


@pytest.mark.no_cover
def test_cameras_that_are_off_are_refined(simulated: Callable) -> None:
    # A pair drawn from its covariance: refined, it is nearer to the truth than as given, and as near as it says.
    ratios, squares = [], []
    for seed in range(4):
        data = simulated("ur5", seed=seed)
        truth, rng = data.session.rig, np.random.default_rng([5, seed])
        known = calibrated(truth)
        session, attachments = replace(data.session, rig=known), data.session.attachments
        problem, centre = Problem.of(session, DHTable.from_chain(session.chain)), Estimated.of(data.session).fit.state
        centre = centre.replace(camera_state(session, np.array(truth.T_cam_world)))
        spec = ModelSpec("none", ("refine",) * 2, ("fixed", "refine"))
        parameters = choose_parameters(session, problem, centre, spec)
        step = np.zeros(parameters.size)
        first = parameters.columns(pose_key(truth.names[1])).start
        step[first:] = rng.multivariate_normal(np.zeros(COUNT), COVARIANCE)[PRIOR_ORDER]
        moved = parameters.retract(centre, step[parameters.active])
        given = Rig(camera_values(attachments, moved), tuple(camera_poses(attachments, moved)), known.sigmas)
        fit = calibrate(replace(data.session, rig=given, estimate=Estimate("dh"), joint_models=RIGID)).fit
        sigma = np.zeros(fit.parameters.size)
        sigma[fit.parameters.active] = np.sqrt(np.diag(fit.covariance))
        for c, name in enumerate(truth.names):
            off = fit.state[lens_key(name)].parameters - truth.cameras[c].parameters
            squares.append((off / sigma[fit.parameters.columns(lens_key(name))]) ** 2)
            ratios.append((off / (given.cameras[c].parameters - truth.cameras[c].parameters)) ** 2)
    assert 0.6 < np.mean(squares) < 1.6
    assert np.median(ratios) < 1.0
