"""The recording of a plan shows the arm in every pose, what each brings, and the tip's error before and after."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.recorded import Recorded
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.plan_recording import way, write_plan
from urdfcal.planning.planner import Plan, Planner
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.obstacle import Obstacle

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def plan() -> Plan:
    crate = Obstacle("crate", np.array([0.2, 0.2, 0.2]), np.array([1.5, 0.0, 0.1]))
    return Planner(read_rig(find_rig("elbow3r")), candidates=200, scene=(crate,)).plan(4, check=True)


@pytest.fixture(scope="module")
def recorded(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path: Path = tmp_path_factory.mktemp("plan") / "plan.rrd"
    assert write_plan(path, plan) == ()
    return Recorded(path)


def test_the_arm_the_boxes_and_the_rays_are_there_in_every_pose(plan: Plan, recorded: Recorded) -> None:
    assert {"/base/boxes/crate", "/base/charts/course/poses", "/base/charts/shares/after"} <= recorded.entities
    assert any(name.startswith("/base/arm/") for name in recorded.entities)
    tips = tip_poses(plan.chain, plan.q, plan.scene.placements)[:, :3, 3]
    (line,) = recorded.static("/base/tips/way", "LineStrips3D:strips")
    moves = tip_poses(plan.chain, way(plan.q), plan.scene.placements)[:, :3, 3]
    np.testing.assert_allclose(line, moves, atol=1e-6)
    apart = np.linalg.norm(line[:, None] - tips, axis=-1).min(axis=0)
    np.testing.assert_allclose(apart, 0.0, atol=1e-6)  # it leads over every pose
    rays = recorded.rows("/base/rays/cam0", "LineStrips3D:strips")
    assert [len(rays[k]) for k in range(len(plan.q))] == (len(rays[0]) * plan.measured).tolist()
    leds = plan.scene.led_positions(plan.q)
    first = int(np.flatnonzero(plan.measured)[0])
    np.testing.assert_allclose(rays[first][0][1], leds[first, 0], atol=1e-6)


def test_moves_are_straight_in_joint_space() -> None:
    q = np.array([[0.0, 1.0], [2.0, 0.0], [2.0, 4.0]])
    steps = np.diff(way(q), axis=0)
    assert len(steps) > 10
    np.testing.assert_allclose(steps[: len(steps) // 2], np.tile(steps[0], (len(steps) // 2, 1)), atol=1e-12)
    np.testing.assert_allclose(way(q)[[0, len(steps) // 2, -1]], q)


def test_each_pose_says_what_it_brings(plan: Plan, recorded: Recorded) -> None:
    said = recorded.rows("/base/texts/about", "TextDocument:text")
    for k, rank in enumerate(plan.rank.tolist()):
        (text,) = said[k]
        if rank >= 0:
            before, after = 1e3 * plan.errors[rank : rank + 2]
            change = f"goes from {before:.3g} to {after:.3g} mm"
            assert (change if f"{before:.3g}" != f"{after:.3g}" else f"stays {after:.3g} mm") in text
            assert f": to be measured.\n\nOf the {plan.count} it is number {rank + 1} by" in text
        else:
            assert ("check the calibration" if plan.check[k] else "nothing is to be measured") in text
        assert "Green dots: where the tip is in the poses to be measured; white: in those to check by" in text


def test_what_changes_nothing_does_not_go_from_itself_to_itself(plan: Plan, tmp_path: Path) -> None:
    still = replace(plan, errors=np.full_like(plan.errors, plan.errors[0]))
    write_plan(tmp_path / "plan.rrd", still)
    said = Recorded(tmp_path / "plan.rrd").rows("/base/texts/about", "TextDocument:text")
    measured = [said[k][0] for k in np.flatnonzero(plan.rank >= 0)]
    assert all(f"error stays {1e3 * plan.errors[0]:.3g} mm" in text for text in measured)


def test_the_tips_error_is_that_of_the_plan(plan: Plan) -> None:
    for error, expected in ((plan.outlook.before, plan.errors[0]), (plan.outlook.after, plan.errors[-1])):
        assert np.sqrt(np.mean(error**2)) == pytest.approx(expected)
    assert np.all(plan.outlook.after < plan.outlook.before)
