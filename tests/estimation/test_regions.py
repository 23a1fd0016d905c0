from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import repeated
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.regions import joint_regions, tip_regions
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.tree_dh import rows_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session


def problem_of(session: Session) -> Problem:
    return Problem.of(session, rows_of(session.chain))


@pytest.mark.parametrize("divide", [joint_regions, tip_regions])
def test_each_pose_is_nearest_to_its_own_regions_centre(divide: Callable, simulated: Callable) -> None:
    problem = problem_of(simulated("ur5", poses=50).session)
    region, q = divide(problem), problem.readings.q
    points = q if divide is joint_regions else tip_poses(problem.arm.chain, q)[:, :3, 3]
    assert len(np.unique(region)) == 5
    centres = np.array([points[region == k].mean(axis=0) for k in range(5)])
    nearest = np.linalg.norm(points[:, None] - centres, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(region, nearest)
    np.testing.assert_array_equal(divide(problem), region)


@pytest.mark.parametrize("divide", [joint_regions, tip_regions])
def test_repeats_of_a_pose_are_in_one_region(divide: Callable, simulated: Callable) -> None:
    region = divide(problem_of(repeated(simulated("ur5", poses=50), 0.0)))
    assert len(np.unique(region)) == 5
    np.testing.assert_array_equal(region.reshape(5, 10), np.tile(region[:10], (5, 1)))


def test_the_order_of_the_poses_does_not_matter(simulated: Callable) -> None:
    session = simulated("ur5", poses=20).session
    problem = problem_of(session)
    order = np.random.default_rng(0).permutation(20)
    shuffled = replace(problem, readings=replace(problem.readings, q=session.q[order]))
    there, here = joint_regions(shuffled), joint_regions(problem)[order]
    assert (np.equal.outer(there, there) == np.equal.outer(here, here)).all()


def test_of_few_configurations_each_is_a_region(simulated: Callable) -> None:
    session = simulated("ur5", poses=50).session.at(np.arange(4))
    assert sorted(joint_regions(problem_of(session)).tolist()) == [0, 1, 2, 3]
