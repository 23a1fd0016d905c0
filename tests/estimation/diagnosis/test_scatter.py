"""Measurements that scatter more than the others are named; even noise, outliers and what is modelled badly are not."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import with_detections
from urdfcal.estimation.diagnosis.scatter import scatter
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Led

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.diagnosis.doctor import Finding
    from urdfcal.session.model import Session

pytestmark = pytest.mark.usefixtures("no_trials")


def found(session: Session) -> tuple[Finding, ...]:
    estimate = Estimated.of(session)
    return scatter(session, estimate.problem, estimate.fit)


def noisier(session: Session, which: Callable[[Detections], np.ndarray], times: float) -> Session:
    detections = session.find(Detections)
    more = np.sqrt(times**2 - 1.0) * detections.sigma * which(detections)
    noise = np.random.default_rng(5).standard_normal(detections.uv.shape)
    return with_detections(session, uv=detections.uv + more[:, None] * noise)


def test_a_camera_that_scatters_more_is_named(simulated: Callable) -> None:
    session = noisier(simulated("ur5", poses=40).session, lambda of: of.camera == 1, 3.0)
    (finding,) = found(session)
    assert finding.sentence.startswith("the detections by camera 'cam1' scatter ")
    assert "detections.csv" in finding.sentence
    assert 0.5 < finding.share < 1.0
    reasons = calibrate(session, force=True).assessment.reasons
    assert any("camera 'cam1' scatter" in reason for reason in reasons)


@pytest.mark.no_cover
def test_what_is_far_away_scatters_more(simulated: Callable) -> None:
    data = simulated("panda", poses=50)
    estimate = Estimated.of(data.session)
    (observed,) = estimate.problem.observations
    depth = estimate.problem.metres_per_unit(observed, estimate.fit.state)
    far = np.zeros(len(data.session.find(Detections)), dtype=bool)
    far[observed.row[observed.valid]] = (depth > np.median(depth[observed.valid]))[observed.valid]
    (finding,) = found(noisier(data.session, lambda _: far, 3.0))
    assert finding.name == "the detections of the farther half: scatter"


def test_an_led_that_a_tracker_measures_badly_is_named(simulated: Callable) -> None:
    session = simulated("ur5", poses=40).session
    at = triangulate(session)
    rng = np.random.default_rng(0)
    pose, led = np.tile(at.pose, 2), np.repeat([0, 1], len(at.pose))
    xyz = np.tile(at.xyz, (2, 1)) + rng.normal(size=(len(pose), 3)) * np.where(led == 0, 1e-3, 5e-3)[:, None]
    points = Points(pose, led, xyz, np.full(len(pose), 1e-3))
    session = replace(session, leds=(session.leds[0], Led("other")), measurements=(points,))
    (finding,) = found(session)
    assert finding.sentence.startswith("the points of LED 'other' scatter ")


@pytest.mark.no_cover
@pytest.mark.parametrize("seed", range(2))
def test_even_noise_is_even_however_large(seed: int, simulated: Callable) -> None:
    session = simulated("so101", poses=40, seed=seed).session
    assert found(session) == ()
    assert found(noisier(session, lambda of: of.camera >= 0, 3.0)) == ()
    assert found(noisier(session, lambda of: of.camera == 1, 1.3)) == ()


def test_a_few_outliers_are_no_scatter(simulated: Callable) -> None:
    assert found(simulated("panda", poses=40, outliers=0.1).session) == ()
