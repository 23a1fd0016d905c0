from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.estimation.validation import FOLDS, hold_out, loss
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration


@pytest.fixture(scope="module")
def calibration(simulated: Callable) -> FittedCalibration:
    return calibrate(replace(simulated("elbow3r").session, estimate=Estimate("dh", "fixed", "fixed")))


def test_the_loss_is_the_mean_over_measurements_without_padding() -> None:
    norms = (np.array([[1.0, 2.0], [3.0, 1e9]]), np.array([[4.0]]))
    valid = (np.array([[True, True], [True, False]]), np.array([[True]]))
    observations = [SimpleNamespace(valid=of) for of in valid]
    assert loss(norms, observations) == pytest.approx(np.mean(np.log1p([1.0, 4.0, 9.0, 16.0])))


def test_a_pose_has_no_part_in_its_own_prediction(calibration: FittedCalibration) -> None:
    problem, fit = calibration.problem, calibration.fit
    (observed,) = problem.observations
    before = hold_out(problem, fit, seed=0)
    folds = observed.readings.motion.folds(np.arange(len(problem.poses)), FOLDS, 0)
    assert before.folds == FOLDS
    value = np.array(observed.value)
    value[0] += 3.0
    after = hold_out(problem.with_observations([replace(observed, value=value)]), fit, seed=0)
    with_it = (folds[observed.pose] == folds[observed.pose[0]])[:, None] & observed.valid
    elsewhere = ~with_it & observed.valid
    with_it[0] = False
    np.testing.assert_array_equal(after.norms[0][with_it], before.norms[0][with_it])
    assert np.all(after.norms[0][elsewhere] != before.norms[0][elsewhere])


def test_distances_are_residuals_in_metres_across_the_ray(calibration: FittedCalibration) -> None:
    problem, held_out = calibration.problem, hold_out(calibration.problem, calibration.fit, seed=0)
    (observed,) = problem.observations
    metres = problem.metres_per_unit(observed, calibration.fit.state)
    expected = (held_out.residual[0] * metres)[observed.valid]
    np.testing.assert_allclose(held_out.distance[0][observed.valid], expected, rtol=0.01)
    lengths = np.linalg.norm(problem.residual(observed, calibration.fit.state), axis=-1)[observed.valid]
    assert np.mean(held_out.residual[0][observed.valid] ** 2) > np.mean(lengths**2)


def test_other_seeds_divide_the_poses_otherwise(calibration: FittedCalibration) -> None:
    a, b, again = (hold_out(calibration.problem, calibration.fit, seed).norms[0] for seed in (0, 1, 0))
    np.testing.assert_array_equal(a, again)
    assert not np.array_equal(a, b)
