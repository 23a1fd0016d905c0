"""What was wrong with an arm: the joint that was made wrong comes first, by as much as it moves the tip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.estimation.problems import Estimated
from tests.worlds import sagging, seen
from urdfcal.arrays import rms
from urdfcal.estimation.contributions import GEOMETRY, contributions
from urdfcal.estimation.evaluation import compare
from urdfcal.pipeline import calibrate

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.mark.no_cover
def test_the_joint_that_is_off_comes_first_by_as_much_as_it_moves_the_tip(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    q = np.array(data.truth.q)
    q[:, 2] += 2e-2  # the elbow's zero, far beyond what the others were built off by
    calibration = calibrate(seen(data, q), force=True)
    found = contributions(calibration.problem, calibration.fit)
    assert (found[0].joint, found[0].what) == ("elbow_joint", GEOMETRY)
    assert found[0].tip > 3.0 * found[1].tip
    assert [of.tip for of in found] == sorted((of.tip for of in found), reverse=True)
    chain, table = calibration.chain, calibration.table
    offsets = np.zeros_like(calibration.dh_offsets)
    row = table.labels.index("elbow_joint")
    offsets[row] = calibration.dh_offsets[row]
    workspace = chain.random_values(500, np.random.default_rng(1))
    alone = compare(chain, chain.with_placements(table.placements(offsets)), workspace).position
    assert found[0].tip == pytest.approx(rms(alone), rel=0.1)
    assert 0.0 < found[0].sigma < 0.1 * found[0].tip


@pytest.mark.no_cover
def test_what_joints_do_beside_is_a_cause_of_its_own(simulated: Callable) -> None:
    calibration = calibrate(sagging(simulated("ur5", poses=50), 7e-5))
    found = contributions(calibration.problem, calibration.fit)
    sag = [of for of in found if of.what == "compliance"]
    assert sag[0].joint == "shoulder_lift_joint"  # it carries the whole arm
    assert sag[0].tip > 5.0 * sag[0].sigma
    # An arm that bends may do more, of which little is certain: what is not there moves its tip by little.
    assert {GEOMETRY, "compliance"} <= {of.what for of in found}
    assert all(of.tip < 0.1 * sag[0].tip for of in found if of.what not in (GEOMETRY, "compliance"))


def test_of_two_arms_each_joint_counts_by_the_tip_that_it_moves_most(simulated: Callable) -> None:
    estimate = Estimated.of(simulated("tiago_dual", poses=40).session)
    found = {of.joint: of.tip for of in contributions(estimate.problem, estimate.fit) if of.what == GEOMETRY}
    for side in ("left", "right"):
        assert found[f"arm_{side}_5_joint"] > 1e-5


@pytest.mark.no_cover
def test_an_arm_that_stays_nominal_has_nothing_wrong(fitted: Callable) -> None:
    calibration = fitted("elbow3r")
    nominal = calibration.comparison.nominal_arm.fit
    assert contributions(calibration.problem, nominal) == ()
