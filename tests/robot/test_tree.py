from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.chain import Chain, Tree, read_mechanism
from urdfcal.robot.kinematics import link_motions, link_poses
from urdfcal.robot.urdf.packages import package_roots
from urdfcal.robot.urdf.urdf import Urdf

ROBOTS = package_roots()[-1] / "example-robot-data" / "robots"
TIAGO = ROBOTS / "tiago_description" / "robots" / "tiago.urdf"
BAXTER = ROBOTS / "baxter_description" / "urdf" / "baxter.urdf"
TREES = {
    "tiago": (TIAGO, ["arm_tool_link", "xtion_rgb_optical_frame"], "base_link"),
    "baxter": (BAXTER, ["left_gripper", "right_gripper"], "base"),
    "hands": (
        TIAGO,
        ["hand_thumb_flex_2_link", "hand_index_flex_3_link", "xtion_rgb_optical_frame"],
        "torso_lift_link",
    ),
}


def read(name: str) -> tuple[Tree, Urdf]:
    path, links, base = TREES[name]
    urdf = Urdf.read(path)
    return Tree.from_urdf(urdf, links, base), urdf


@pytest.mark.parametrize("name", TREES)
def test_links_are_where_pinocchio_puts_them(name: str) -> None:
    tree, urdf = read(name)
    whole = pin.buildModelFromXML(urdf.data.decode())
    data = whole.createData()
    q = tree.random_values(20, np.random.default_rng(0))
    found = link_poses(tree, q, tree.tips)
    for k, q_k in enumerate(q):
        values = pin.neutral(whole)
        for joint, value in zip(tree.names, q_k, strict=True):
            values[whole.joints[whole.getJointId(joint)].idx_q] = value
        pin.framesForwardKinematics(whole, data, values)
        base = data.oMf[whole.getFrameId(tree.base_link, pin.FrameType.BODY)]
        for tip, T in zip(tree.tips, found, strict=True):
            expected = base.actInv(data.oMf[whole.getFrameId(tip.link, pin.FrameType.BODY)])
            np.testing.assert_allclose(T[k], expected.homogeneous, atol=1e-12)


def test_joints_come_after_what_they_hang_on_and_runs_are_serial() -> None:
    for name in TREES:
        tree, _ = read(name)
        assert all(parent < joint for joint, parent in enumerate(tree.parents))
        runs = tree.branches
        assert sorted(joint for run in runs for joint in run) == list(range(len(tree.joints)))
        assert all(tree.parents[b] == a for run in runs for a, b in pairwise(run))


@pytest.mark.parametrize(
    ("name", "first"), [("tiago", ["torso_lift_joint", "head_1_joint"]), ("baxter", ["left_s0", "right_s0"])]
)
def test_a_run_begins_where_another_goes_on(name: str, first: list[str]) -> None:
    tree, _ = read(name)
    assert [tree.names[run[0]] for run in tree.branches] == first


def test_motions_agree_with_finite_differences() -> None:
    tree, _ = read("tiago")
    tips = (*tree.tips, tree.tip("base_link"))
    q = tree.random_values(3, np.random.default_rng(1))
    motions = link_motions(tree, tree.build_model(), q, tips)
    for column in range(6 * len(tree.joints)):
        poses = []
        for sign in (-1, 1):
            placements = np.array(tree.placements)
            xi = np.zeros(6)
            xi[column % 6] = sign * 1e-6
            placements[column // 6] = placements[column // 6] @ pin.exp6(xi).homogeneous
            poses.append(link_poses(tree, q, tips, placements))
        for motion, before, after in zip(motions, *poses, strict=True):
            moved = (after[:, :3, 3] - before[:, :3, 3]) / 2e-6
            np.testing.assert_allclose(motion.regressor[:, :3, column], moved, atol=1e-8)


def test_a_link_on_the_way_to_another_adds_no_joint() -> None:
    urdf = Urdf.read(TIAGO)
    tree = Tree.from_urdf(urdf, ["arm_4_link", "arm_tool_link"], "base_link")
    assert tree.names == Chain.from_urdf(urdf, "arm_tool_link", "base_link").names
    assert len(tree.branches) == 1
    assert isinstance(read_mechanism(urdf, ["arm_4_link", "arm_4_link"]), Chain)


def test_a_mimic_joint_may_follow_one_on_another_branch() -> None:
    body = "".join(f'<link name="{link}"/>' for link in "abc")
    for name, child, inside in (("lead", "b", ""), ("follow", "c", '<mimic joint="lead" multiplier="-1"/>')):
        body += (
            f'<joint name="{name}" type="revolute"><parent link="a"/><child link="{child}"/><axis xyz="0 0 1"/>'
            f'<limit lower="-1" upper="1" effort="1" velocity="1"/>{inside}</joint>'
        )
    urdf = Urdf.parse(f'<robot name="r">{body}</robot>'.encode())
    with pytest.raises(RobotError, match="mimics 'lead'"):
        Chain.from_urdf(urdf, "c")
    tree = Tree.from_urdf(urdf, ["c", "b"])
    np.testing.assert_array_equal(tree.joint_values([0.5]), [-0.5, 0.5])


def test_a_link_that_is_no_tip_is_refused() -> None:
    tree, _ = read("tiago")
    with pytest.raises(RobotError, match=r"'head_1_link' is none of the tip links.*arm_tool_link"):
        tree.tip("head_1_link")
    with pytest.raises(RobotError, match="no link 'nose'"):
        Tree.from_urdf(Urdf.read(TIAGO), ["arm_tool_link", "nose"])
