from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import RIGID, erring, repeated, sagging
from urdfcal.arrays import rms
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.validation import FOLDS, hold_out, loss, random_folds, region_interval, rms_interval
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import PARAMETERS
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture(scope="module")
def calibration(simulated: Callable) -> Estimated:
    return Estimated.of(simulated("elbow3r").session)


def test_the_loss_is_the_mean_over_measurements_without_padding() -> None:
    norms = (np.array([[1.0, 2.0], [3.0, 1e9]]), np.array([[4.0]]))
    valid = (np.array([[True, True], [True, False]]), np.array([[True]]))
    observations = [SimpleNamespace(valid=of) for of in valid]
    assert loss(norms, observations) == pytest.approx(np.mean(np.log1p([1.0, 4.0, 9.0, 16.0])))


def test_a_pose_has_no_part_in_its_own_prediction(calibration: Estimated) -> None:
    problem, fit = calibration.problem, calibration.fit
    (observed,) = problem.observations
    folds = random_folds(problem, seed=0)
    before = hold_out(problem, fit, folds)
    assert before.folds == FOLDS
    value = np.array(observed.value)
    value[0] += 3.0
    after = hold_out(problem.with_observations([replace(observed, value=value)]), fit, folds)
    with_it = (folds[observed.pose] == folds[observed.pose[0]])[:, None] & observed.valid
    elsewhere = ~with_it & observed.valid
    with_it[0] = False
    np.testing.assert_array_equal(after.norms[0][with_it], before.norms[0][with_it])
    assert np.all(after.norms[0][elsewhere] != before.norms[0][elsewhere])


def test_distances_are_residuals_in_metres_across_the_ray(calibration: Estimated) -> None:
    problem, held_out = (
        calibration.problem,
        hold_out(calibration.problem, calibration.fit, random_folds(calibration.problem, 0)),
    )
    (observed,) = problem.observations
    metres = problem.metres_per_unit(observed, calibration.fit.state)
    expected = (held_out.residual[0] * metres)[observed.valid]
    np.testing.assert_allclose(held_out.distance[0][observed.valid], expected, rtol=0.01)
    lengths = np.linalg.norm(problem.residual(observed, calibration.fit.state), axis=-1)[observed.valid]
    assert np.mean(held_out.residual[0][observed.valid] ** 2) > np.mean(lengths**2)


def test_other_seeds_divide_the_poses_otherwise(calibration: Estimated) -> None:
    a, b, again = (
        hold_out(calibration.problem, calibration.fit, random_folds(calibration.problem, seed)).norms[0]
        for seed in (0, 1, 0)
    )
    np.testing.assert_array_equal(a, again)
    assert not np.array_equal(a, b)


def interval_of(distance: np.ndarray, unit: np.ndarray, seed: int = 0) -> np.ndarray:
    """95 % interval of the rms of distances (N, m), each pose in its unit."""
    observed = SimpleNamespace(pose=np.arange(len(distance)))
    return np.array(rms_interval([observed], [np.ones_like(distance, bool)], [distance], unit, seed))


def test_the_interval_is_that_of_the_normal_limit() -> None:
    # The mean of n squares of standard normal numbers has standard deviation sqrt(2 / n); the rms half of it.
    count = 2000
    distance = np.abs(np.random.default_rng(0).normal(size=(count, 1)))
    rms = np.sqrt(np.mean(distance**2))
    expected = rms + np.array([-1.96, 1.96]) * np.sqrt(2.0 / count) / 2.0
    np.testing.assert_allclose(interval_of(distance, np.arange(count)), expected, atol=0.15 * np.sqrt(0.5 / count))


def test_errors_of_one_unit_count_once() -> None:
    rng = np.random.default_rng(1)
    of_units = np.abs(rng.normal(size=(200, 1)))
    low, high = interval_of(of_units, np.arange(200))
    np.testing.assert_allclose(
        interval_of(np.repeat(of_units, 9, axis=0), np.repeat(np.arange(200), 9)), [low, high], rtol=1e-12
    )
    apart = interval_of(np.repeat(of_units, 9, axis=0), np.arange(1800))
    assert np.ptp(apart) < 0.5 * (high - low)


def test_outliers_and_poses_without_measurements_have_no_part_in_the_interval() -> None:
    distance = np.abs(np.random.default_rng(2).normal(size=(50, 2)))
    expected = rms_interval(
        [SimpleNamespace(pose=np.arange(50))], [np.ones((50, 2), bool)], [distance], np.arange(50), 3
    )
    spoilt = np.concatenate([distance, np.full((50, 1), 1e6)], axis=1)
    kept = np.concatenate([np.ones((50, 2), bool), np.zeros((50, 1), bool)], axis=1)
    unit = np.arange(60)  # ten poses more that nobody has measured
    assert rms_interval([SimpleNamespace(pose=np.arange(50))], [kept], [spoilt], unit, 3) == expected


def region_interval_of(rms: list[float], each: int = 50) -> tuple[float, float]:
    """The interval from regions of so many poses, each with the same distance in all its poses."""
    distance, region = np.repeat(rms, each)[:, None], np.repeat(np.arange(len(rms)), each)
    observed = SimpleNamespace(pose=np.arange(len(distance)))
    return region_interval([observed], [np.ones_like(distance, bool)], [distance], region)


def test_a_further_region_scatters_as_those_that_were_left_out() -> None:
    assert region_interval_of([2e-3] * 5) == pytest.approx((2e-3, 2e-3))
    assert region_interval_of([1e-3]) == (0.0, np.inf)
    rng, within = np.random.default_rng(3), 0
    for _ in range(400):
        *seen, further = np.exp(rng.normal(-7.0, 0.4, 6))
        low, high = region_interval_of(seen, each=1)
        within += low <= further <= high
    assert 0.92 < within / 400 < 0.98


@pytest.mark.no_cover
def test_repeats_of_a_configuration_are_left_out_together(simulated: Callable) -> None:
    session = replace(repeated(simulated("ur5", poses=50), 0.0), estimate=Estimate("dh", "fixed", "fixed"))
    calibration = calibrate(session, force=True)
    folds = random_folds(calibration.problem, seed=0).reshape(5, 10)
    assert (folds == folds[:1]).all()
    held_out = calibration.comparison.chosen.residuals("distance")
    inside = calibration.problem.residual(calibration.problem.observations[0], calibration.fit.state)
    # Ten configurations hardly determine the arm: what it does elsewhere must not hide behind repeats.
    metres = 1e-3 * np.sqrt(np.mean(inside**2)) / session.noise.pixel
    assert np.sqrt(np.mean(held_out**2)) > 0.5 * metres


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(2))
def test_without_misfit_the_jackknife_agrees_with_the_covariance(seed: int, simulated: Callable) -> None:
    found = Estimated.of(simulated("so101", poses=60, seed=seed).session)
    problem, fit = found.problem, found.fit
    assert not fit.misfit
    spread = hold_out(problem, fit, np.arange(60) % 20).spread
    ratio = np.sqrt(np.diag(spread) / np.diag(fit.covariance))
    assert 0.7 < np.median(ratio) < 1.4


@pytest.mark.no_cover
def test_where_the_arm_bends_intervals_are_what_regions_show(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    session = replace(sagging(data, 4e-5), estimate=Estimate("dh", "fixed"), joint_models=RIGID)
    calibration = calibrate(session, force=True)
    fit, table = calibration.comparison.chosen.fit, calibration.table
    assert fit.misfit
    sigma, narrow = (
        of.parameters.sigmas(of.covariance)[of.parameters.columns(ARM)] for of in (fit, replace(fit, spread=None))
    )
    error = [(fit.state[ARM] - data.truth.offsets)[row, PARAMETERS.index(name)] for row, name in table.parameters]
    known = np.isfinite(sigma)
    inside, before = (np.mean(np.abs(np.array(error))[known] < 1.96 * of[known]) for of in (sigma, narrow))
    assert inside > max(before, 0.85)


@pytest.mark.no_cover
def test_what_one_joint_was_found_to_do_others_may_do_below_the_noise(simulated: Callable, fitted: Callable) -> None:
    inside, before = [], []
    for seed in (2, 6):  # found in some joints, of seven that err
        data = simulated("panda", poses=50, seed=seed)
        calibration = calibrate(erring(data, eccentricity=5e-4))
        fit = calibration.comparison.chosen.fit
        assert not fit.misfit
        offsets = fit.state[ARM] - data.truth.offsets
        error = np.array([offsets[row, PARAMETERS.index(name)] for row, name in calibration.table.parameters])
        for shares, of in ((inside, fit), (before, replace(fit, spread=None))):
            sigma = of.parameters.sigmas(of.covariance)[of.parameters.columns(ARM)]
            shares.append(np.abs(error)[np.isfinite(sigma)] < 1.96 * sigma[np.isfinite(sigma)])
        chain = data.session.chain
        q = chain.random_values(300, np.random.default_rng(0))
        true, found = (chain.with_placements(of) for of in (data.truth.placements, calibration.placements))
        low, high = calibration.evidence.tip.interval
        assert low < rms(compare(true, found, q).position) < high
    assert np.mean(inside) > 0.9 > np.mean(before)
    clean = fitted("panda", poses=50)
    assert clean.comparison.chosen.fit.spread is None
