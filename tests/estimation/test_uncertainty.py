from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.start import first_state
from urdfcal.estimation.uncertainty import aligned_motion, size_error, tip_covariance, tip_error, tip_rms_with
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats


@pytest.fixture(scope="module")
def arm(simulated: Callable) -> tuple[Problem, SimpleNamespace]:
    """A problem, and a fit of all DH parameters, those that are the base pose's too."""
    session = simulated("ur5").session
    table = DHTable.from_chain(session.chain)
    problem, state = Problem.of(session, table), first_state(session, table, np.zeros_like(table.nominal))
    parameters = choose_parameters(session, problem, state, ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2))
    return problem, SimpleNamespace(state=state, parameters=parameters)


def covariance_of(fit: SimpleNamespace, sigma: dict[str, float]) -> SimpleNamespace:
    """The fit with standard deviations of some parameters, the others exact."""
    names = [name for name, on in zip(fit.parameters.names, fit.parameters.active, strict=True) if on]
    sigmas = np.array([sigma.get(name, 0.0) for name in names])
    return SimpleNamespace(state=fit.state, parameters=fit.parameters, covariance=np.diag(sigmas**2))


def test_what_moves_the_arm_as_a_whole_is_the_bases(arm: tuple[Problem, SimpleNamespace]) -> None:
    problem, fit = arm
    q = problem.arm.chain.random_values(20, np.random.default_rng(1))
    for name in ("shoulder_pan_joint.d", "shoulder_pan_joint.theta"):
        covariance = tip_covariance(problem, covariance_of(fit, {name: 1e-3}), q)
        np.testing.assert_allclose(covariance, 0.0, atol=1e-20)
    sigma = np.sqrt(np.trace(tip_covariance(problem, covariance_of(fit, {"elbow_joint.a": 1e-3}), q), axis1=1, axis2=2))
    assert np.all((sigma > 0.8e-3) & (sigma < 1.2e-3))


@pytest.mark.no_cover
def test_the_covariance_is_the_scatter_of_aligned_tips(arm: tuple[Problem, SimpleNamespace]) -> None:
    problem, fit = arm
    sigmas = {"shoulder_lift_joint.a": 2e-4, "elbow_joint.alpha": 3e-4, "wrist_1_joint.theta": 4e-4}
    rng, chain = np.random.default_rng(2), problem.arm.chain
    workspace, q = chain.random_values(300, np.random.default_rng(0)), chain.random_values(8, rng)
    names = [f"{problem.arm.labels[row]}.{name}" for row, name in problem.arm.parameters]

    def tips(offsets: Floats, at: Floats) -> Floats:
        return tip_poses(chain, at, problem.arm.placements(offsets))[:, :3, 3]

    nominal, errors = no_offsets(problem.arm), []
    for _ in range(600):
        offsets = np.array(nominal)
        for name, sigma in sigmas.items():
            row, parameter = problem.arm.parameters[names.index(name)]
            offsets[row, problem.arm.columns.index(parameter)] = rng.normal(0.0, sigma)
        T = kabsch(tips(offsets, workspace), tips(nominal, workspace))
        errors.append(tips(offsets, q) @ T[:3, :3].T + T[:3, 3] - tips(nominal, q))
    measured = np.einsum("kni,knj->nij", np.array(errors), np.array(errors)) / len(errors)
    predicted = tip_covariance(problem, covariance_of(fit, sigmas), q)
    size = np.trace(predicted, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(measured / size, predicted / size, atol=0.1)


def test_an_arm_that_grows_as_a_whole_is_wrong_in_its_size_alone(arm: tuple[Problem, SimpleNamespace]) -> None:
    problem, fit = arm
    table = problem.arm
    lengths = {
        f"{label}.{column}": value
        for label, row in zip(table.labels, table.nominal, strict=True)
        for column, value in zip(table.columns, row, strict=True)
        if column in ("d", "a")
    }
    names = [name for name, on in zip(fit.parameters.names, fit.parameters.active, strict=True) if on]
    growth = np.array([1e-3 * lengths.get(name, 0.0) for name in names])
    grown = SimpleNamespace(**{**vars(fit), "covariance": np.outer(growth, growth)})
    size = size_error(problem, grown)
    rms = float(np.sqrt(np.mean(np.sum((aligned_motion(problem, grown) @ growth) ** 2, axis=1))))
    assert size.sigma == pytest.approx(1e-3, rel=0.02)
    assert size.rms == pytest.approx(rms, rel=0.02)
    assert size.rms_without < 0.1 * rms
    assert size_error(problem, covariance_of(fit, {"elbow_joint.theta": 1e-3})).sigma < 0.1 * size.sigma


def test_more_of_the_same_narrows_what_is_measured_and_not_what_is_known(simulated: Callable) -> None:
    session = simulated("ur5", poses=16).session
    found = Estimated.of(session)
    problem, fit = found.problem, found.fit
    rms, _ = tip_error(problem, fit)
    assert tip_rms_with(problem, fit, 1.0) == pytest.approx(rms)
    assert 0.5 * rms < tip_rms_with(problem, fit, 4.0) < 0.8 * rms
    without = Estimated.of(session, priors=False)
    rms, _ = tip_error(without.problem, without.fit)
    assert tip_rms_with(without.problem, without.fit, 4.0) == pytest.approx(0.5 * rms, rel=1e-3)


@pytest.mark.no_cover
def test_where_the_residuals_exceed_the_noise_more_poses_are_said_to_bring_nothing(simulated: Callable) -> None:
    session = simulated("ur5", poses=16).session
    assert calibrate(session, force=True).evidence.tip.rms_with_more is not None
    careless = calibrate(session.with_noise({"pixel": 0.05}), force=True)
    assert careless.evidence.tip.rms_with_more is None
    assert careless.document.tip.more.poses == 5
