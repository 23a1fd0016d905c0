"""Partial residuals: with the model they scatter about zero, without it they show what was built."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import harmonic, sagging
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.partial_residuals import PartialResiduals, partial_residuals
from urdfcal.pipeline import calibrate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration


def found(calibration: FittedCalibration) -> dict[tuple[str, str], PartialResiduals]:
    return {(of.joint, of.model): of for of in partial_residuals(calibration.problem, calibration.fit)}


@pytest.mark.no_cover
def test_without_the_model_a_joint_is_seen_to_yield_by_what_was_built(simulated: Callable) -> None:
    calibration = calibrate(sagging(simulated("ur5", poses=50), 5e-5))
    of = found(calibration)["shoulder_lift_joint", "compliance"]
    assert (of.unit, of.axis) == ("rad", "torque on it [N m]")
    slope, _ = np.polyfit(of.at, of.value + of.left, 1)
    assert slope == pytest.approx(5e-5, rel=0.1)
    rest, _ = np.polyfit(of.at, of.left, 1)
    assert abs(rest) < 0.1 * slope
    assert np.std(of.left) < 0.3 * np.std(of.value)
    model = next(block for block in calibration.problem.joint_models if block.name == "compliance")
    values = model.values(Readings.of(calibration.session), calibration.fit.state[model.key])
    np.testing.assert_allclose(of.value, values[:, 1])


@pytest.mark.no_cover
def test_harmonics_are_shown_over_the_joint_s_angle(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    calibration = calibrate(partial(harmonic, share=0.3, order=1)(data, 3e-3))
    (of,) = found(calibration).values()
    assert (of.joint, of.model, of.axis) == ("elbow_joint", "harmonics", "elbow_joint [rad]")
    waves = np.column_stack([np.sin(of.at), np.cos(of.at), np.ones_like(of.at)])
    (sine, cosine, _), *_ = np.linalg.lstsq(waves, of.value + of.left, rcond=None)
    assert np.hypot(sine, cosine) == pytest.approx(3e-3, rel=0.25)
    assert np.std(of.left) < 0.5 * np.std(of.value + of.left)


def test_a_rigid_arm_has_none(fitted: Callable) -> None:
    assert found(fitted("elbow3r")) == {}
