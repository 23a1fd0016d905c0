"""The best rigid arm for a region: nearest to the full model, by the calibration's own kind of parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import sagging
from urdfcal.arrays import rms
from urdfcal.errors import OutputError
from urdfcal.pipeline import calibrate
from urdfcal.result.rigid import best_rigid, draw_readings, measured_domain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Estimate, Payload

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration


@pytest.fixture(scope="module", params=["dh", "full"])
def bent(request: pytest.FixtureRequest, simulated: Callable) -> FittedCalibration:
    session = sagging(simulated("ur5", poses=40), 5e-5)
    return calibrate(replace(session, estimate=Estimate(request.param), joint_models={"compliance": True}), force=True)


def off(calibration: FittedCalibration, q: np.ndarray, placements: np.ndarray) -> float:
    """Rms distance of a rigid arm's tip from the full model's. [m]"""
    chain = calibration.chain
    rigid = tip_poses(chain, chain.joint_values(q), placements)
    return rms(np.linalg.norm((rigid - calibration.forward(q))[:, :3, 3], axis=1))


def test_it_is_nearer_to_the_full_model_than_the_rigid_part(bent: FittedCalibration) -> None:
    q = draw_readings(bent, measured_domain(bent))
    fit = best_rigid(bent, q)
    assert fit.rms == pytest.approx(off(bent, q, fit.placements), rel=1e-9)
    assert fit.rms_before == pytest.approx(off(bent, q, bent.placements), rel=1e-9)
    assert fit.rms < 0.9 * fit.rms_before
    assert fit.rms < fit.most < 6.0 * fit.rms
    other = draw_readings(bent, measured_domain(bent), seed=1)  # of the region, not of the configurations
    assert off(bent, other, fit.placements) < 0.95 * off(bent, other, bent.placements)


def test_a_smaller_region_loses_less(bent: FittedCalibration) -> None:
    box = np.array([[0.2, 0.6], [-0.3, 0.3], [0.1, 0.5]])
    q = draw_readings(bent, measured_domain(bent), box)
    p = tip_poses(bent.calibrated, bent.chain.joint_values(q))[:, :3, 3]
    assert np.all((p >= box[:, 0]) & (p <= box[:, 1]))
    everywhere = best_rigid(bent, draw_readings(bent, measured_domain(bent)))
    here = best_rigid(bent, q)
    assert here.rms < 0.95 * off(bent, q, everywhere.placements)


def test_no_step_of_one_placement_is_nearer(bent: FittedCalibration) -> None:
    q = draw_readings(bent, measured_domain(bent))
    fit = best_rigid(bent, q)
    again = best_rigid(bent, np.concatenate([q, q]))
    np.testing.assert_allclose(again.placements, fit.placements, atol=1e-7)
    for j in (1, 2, 3):
        for turn in (-2e-4, 2e-4):
            moved = np.array(fit.placements)
            c, s = np.cos(turn), np.sin(turn)
            moved[j, :3, :3] = moved[j, :3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            assert off(bent, q, moved) > 0.999 * fit.rms


def test_of_a_rigid_arm_nothing_changes(simulated: Callable) -> None:
    calibration = calibrate(replace(simulated("ur5").session, joint_models={"compliance": False}))
    q = draw_readings(calibration, measured_domain(calibration))
    fit = best_rigid(calibration, q)
    np.testing.assert_array_equal(fit.placements, calibration.placements)
    assert (fit.rms, fit.most, fit.angle, fit.rms_before) == (0.0, 0.0, 0.0, 0.0)
    lower, upper = measured_domain(calibration)
    assert np.all((q >= lower) & (q <= upper))
    np.testing.assert_array_equal(lower, calibration.session.readings.min(axis=0))
    with pytest.raises(OutputError, match="the tip is in the box for 0 of 200000 configurations"):
        draw_readings(calibration, (lower, upper), np.array([[5.0, 6.0], [0.0, 1.0], [0.0, 1.0]]))


def test_it_is_that_of_an_arm_that_carries_what_it_does_there(bent: FittedCalibration) -> None:
    load = Payload("tool0", 4.0, np.array([0.0, 0.0, 0.1]))
    session, q = replace(bent.session, payload=load), bent.session.readings
    fit = best_rigid(bent, q, bends=bent.joint_models.under(session))
    other = best_rigid(bent, q, bends=bent.joint_models.under(bent.session))
    assert other.rms == pytest.approx(best_rigid(bent, q).rms, rel=1e-9)
    loaded = bent.forward(q, payload=load)[:, :3, 3]
    rigid = (tip_poses(bent.chain, bent.session.q, of.placements)[:, :3, 3] for of in (fit, other))
    apart, unloaded = (rms(np.linalg.norm(of - loaded, axis=1)) for of in rigid)
    assert fit.rms == pytest.approx(apart, rel=1e-9)
    assert apart < 0.95 * unloaded
    # On a wall the same arm bends another way.
    wall = replace(bent.session, gravity=np.array([0.0, 9.81, 0.0]))
    there = best_rigid(bent, q, bends=bent.joint_models.under(wall))
    assert there.rms_before != pytest.approx(other.rms_before, rel=0.1)
