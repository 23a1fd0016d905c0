"""What recording and report show where nothing was seen: the place that was touched, and the body that was tracked."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.measurements.test_poses import probed
from tests.touching import touched
from urdfcal.estimation.blocks.places import PLACES
from urdfcal.estimation.measurements import Contacts, Planes
from urdfcal.output.findings import Overview
from urdfcal.output.recording import write_results
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from pathlib import Path


def test_a_contact_is_measured_where_its_place_is() -> None:
    session = replace(touched(Contacts, 40, joint=0.0).session, estimate=Estimate("none"))
    calibration = calibrate(session, force=True)
    scene = Overview.of(calibration).scene
    (table,) = session.measurements
    places = calibration.fit.state[PLACES][table.place]  # the base link is the world
    np.testing.assert_allclose(scene.leds.measured, places, atol=1e-12)
    residual = calibration.problem.residual(calibration.observations[0], calibration.fit.state)[:, 0]
    np.testing.assert_allclose(scene.leds.predicted - scene.leds.measured, residual, atol=1e-12)
    (shown,) = scene.tables
    assert shown.components == ("x", "y", "z")
    assert shown.noise == pytest.approx(np.sqrt(3.0) * 0.1)


@pytest.mark.no_cover
def test_a_plane_has_one_residual() -> None:
    session = replace(touched(Planes, 40).session, estimate=Estimate("none"))
    scene = Overview.of(calibrate(session, force=True)).scene
    (shown,) = scene.tables
    assert len(shown.components) == 1
    np.testing.assert_allclose(scene.leds.measured, scene.leds.predicted)


def test_a_tracked_body_is_shown_as_leds_are(tmp_path: Path) -> None:
    session = replace(probed(30), estimate=Estimate("none"))
    calibration = calibrate(session, force=True)
    overview = Overview.of(calibration)
    leds, (table,) = overview.scene.leds, session.measurements
    T = calibration.estimate.T_world_base
    np.testing.assert_allclose(leds.measured @ T[:3, :3].T + T[:3, 3], table.place[:, :3], atol=1e-9)
    assert np.linalg.norm(leds.predicted - leds.measured, axis=1).max() < 1e-3
    paths, _ = write_results(calibration, tmp_path, overview)
    report = next(path for path in paths if path.suffix == ".html").read_text()
    assert "mrad" in report
