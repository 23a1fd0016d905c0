from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import erring, sagging
from urdfcal.estimation.alignment import kabsch
from urdfcal.output.charts import error_colors, workspace_charts
from urdfcal.output.figures import workspace_maps
from urdfcal.output.findings import Overview
from urdfcal.output.palette import UNMEASURED
from urdfcal.output.report import write_report
from urdfcal.output.workspace import MOVED, sample_workspace
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.result.fitted import FittedCalibration


@pytest.fixture(scope="module")
def calibration(fitted: Callable) -> FittedCalibration:
    return fitted("elbow3r")


def test_the_workspace_forgives_where_the_base_stands(calibration):
    found = sample_workspace(calibration)
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.2, 0.3]
    moved = replace(calibration)
    object.__setattr__(
        moved, "placements", np.concatenate([[T @ calibration.placements[0]], calibration.placements[1:]])
    )
    np.testing.assert_allclose(sample_workspace(moved).before, found.before, atol=1e-12)
    assert 1e-4 < np.median(found.before) < 1e-2


def test_the_map_is_grey_where_nothing_was_measured(calibration):
    workspace = sample_workspace(calibration)
    inside = calibration.in_domain(
        calibration.chain.readings(
            calibration.chain.random_values(len(workspace.tip), np.random.default_rng(calibration.seed))
        )
    )
    np.testing.assert_array_equal(workspace.measured, inside)
    assert 0 < inside.sum() < len(inside)
    below = replace(workspace, measured=workspace.tip[:, 2] < np.median(workspace.tip[:, 2]))
    nominal, calibrated = workspace_maps(below)
    grey, known = nominal.marks
    assert (grey.name, grey.color) == ("not measured", UNMEASURED)
    assert len(grey.x) > 0 < len(known.x) == len(known.color)
    assert np.mean(grey.y) > np.mean(known.y)
    assert nominal.colors == calibrated.colors
    # Where all would be grey the colours tell what is expected there.
    none = workspace_maps(replace(below, measured=np.zeros(len(inside), bool)))
    every = workspace_maps(replace(below, measured=np.ones(len(inside), bool)))
    for of, all_known in zip(none, every, strict=True):
        assert len(of.marks[0].x) == 0
        np.testing.assert_array_equal(of.marks[1].color, all_known.marks[1].color)


def test_shares_of_several_arms_are_told_apart_and_in_one_range(calibration):
    one = sample_workspace(calibration)
    (alone,) = workspace_charts((one,))
    both = workspace_charts((one, replace(one, link="other", before=100.0 * one.before)))
    assert [chart.title for chart in (alone, *both)] == [
        "% of the workspace below",
        f"{one.link}: % below",
        "other: % below",
    ]
    assert [of.title for of in workspace_maps(one)] == ["nominal: distance [mm]", "calibrated: std. dev. [mm]"]
    assert workspace_maps(one, named=True)[0].title == f"nominal, {one.link} [mm]"
    assert both[0].x == both[1].x
    assert both[0].x.high > 100.0 * alone.x.high / 2.0
    assert (both[0].colors, both[1].colors) == (error_colors((one, replace(one, before=100.0 * one.before))), None)


def test_the_page_says_where_all_of_the_map_is_extrapolated(calibration, tmp_path):
    overview = Overview.of(calibration)
    nowhere = replace(overview.workspace, measured=np.zeros(len(overview.workspace.tip), bool))
    for of, said in ((overview, False), (replace(overview, workspaces=(nowhere,)), True)):
        write_report(tmp_path / "report.html", of)
        text = (tmp_path / "report.html").read_text()
        assert ("None of it lies in the measured domain" in text) == said
        assert ("of the workspace lies" in text) != said


def test_of_a_rigid_arm_nothing_is_said_of_joint_models(calibration):
    assert sample_workspace(calibration).moved is None
    assert [of.name for of in workspace_maps(sample_workspace(calibration))] == ["nominal", "calibrated"]


def test_what_sags_is_mapped_and_counts_as_off_of_the_nominal_arm(simulated):
    found = calibrate(sagging(simulated("ur5", poses=40), 3e-5))
    assert found.joint_models.found
    workspace = sample_workspace(found)
    readings = found.chain.readings(found.chain.random_values(len(workspace.tip), np.random.default_rng(found.seed)))
    full = found.forward(readings)[:, :3, 3]
    rigid = tip_poses(found.calibrated, found.chain.joint_values(readings))[:, :3, 3]
    nominal = tip_poses(found.chain, found.chain.joint_values(readings))[:, :3, 3]
    moved = np.linalg.norm(full - rigid, axis=1)
    np.testing.assert_allclose(workspace.moved, np.maximum(moved, 0.01 * moved.max()), atol=1e-9)
    np.testing.assert_allclose(workspace.tip, full, atol=1e-9)
    T = kabsch(nominal, full)
    np.testing.assert_allclose(workspace.before, np.linalg.norm(nominal @ T[:3, :3].T + T[:3, 3] - full, axis=1))
    assert [of.name for of in workspace_maps(workspace)] == ["nominal", "calibrated", MOVED]
    every = np.concatenate(list(workspace.errors.values()))
    assert workspace.range == (every.min(), every.max())


@pytest.mark.no_cover
def test_an_arm_that_lags_alone_is_moved_by_nothing_at_rest(simulated):
    found = calibrate(erring(simulated("ur5", poses=40), lag=1e-3))
    assert found.joint_models.found
    assert sample_workspace(found).moved is None
