from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.planning.design import Candidates
from urdfcal.planning.reach import Reach
from urdfcal.planning.refinement import refine
from urdfcal.simulation.planning import MARGIN, are_in_view, joint_limits, load_collision_checker
from urdfcal.simulation.simulate import nominal_scene

if TYPE_CHECKING:
    from urdfcal.arrays import Floats


@pytest.fixture(scope="module")
def reach() -> Reach:
    rig = read_rig(find_rig("panda"))
    scene = nominal_scene(rig)
    return Reach(scene, load_collision_checker(scene, rig, 0.02)[0], MARGIN)


def anywhere(q: Floats, others: Floats) -> bool:
    return True


def told_by(q: Floats) -> Floats:
    """Poses that tell of one number each, the more the further joint 1 is turned."""
    return (2.0 + np.sin(q[:, :1]))[..., None] * np.ones((1, 1))


def test_poses_go_to_the_best_place_that_the_arm_can_take(reach: Reach) -> None:
    rng = np.random.default_rng(0)
    q = np.array([one for one in reach.draw(60, rng) if reach.takes(one)][:3])
    start, known = Candidates(told_by(q), np.ones((1, 1))), np.eye(1)
    better, tell = refine(q, start, known, reach, told_by, apart=anywhere, rng=rng)
    np.testing.assert_array_equal(told_by(better), tell.factors)
    assert np.all(np.sin(better[:, 0]) > 0.95)
    assert tell.error(known + tell.information(range(3))) < start.error(known + start.information(range(3)))
    rig = read_rig(find_rig("panda"))
    assert are_in_view(nominal_scene(rig), better)[0].all()
    assert all(reach.takes(one) for one in better)


def test_poses_stay_apart(reach: Reach) -> None:
    rng = np.random.default_rng(0)
    q = np.array([one for one in reach.draw(60, rng) if reach.takes(one)][:3])

    def never(one: Floats, others: Floats) -> bool:
        assert others.shape == (2, 7)
        return False

    kept, _ = refine(q, Candidates(told_by(q), np.ones((1, 1))), np.eye(1), reach, told_by, apart=never, rng=rng)
    np.testing.assert_array_equal(kept, q)


def test_neighbours_are_near_and_in_view(reach: Reach) -> None:
    rng = np.random.default_rng(0)
    q = reach.draw(5, rng)
    near, of = reach.near(q, 0.01, 200, rng)
    scene = nominal_scene(read_rig(find_rig("panda")))
    assert are_in_view(scene, near)[0].all()
    lower, upper = joint_limits(scene.chain)
    steps = (near - q[of]) / (upper - lower)
    assert np.std(steps[of == 0]) == pytest.approx(0.01, rel=0.2)
    assert not are_in_view(scene, np.vstack([upper + 1e-6]))[0].any()
