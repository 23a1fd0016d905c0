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
UR5 = ROBOTS / "ur_description" / "urdf" / "ur5_robot.urdf"
PANDA = ROBOTS / "panda_description" / "urdf" / "panda.urdf"
LIMIT = '<limit lower="-1" upper="2" effort="3" velocity="4"/>'


def urdf(*joints: tuple[str, str, str, str], links: str = "abcd") -> Urdf:
    """Joints as (name, type, 'parent child', further elements)."""
    body = "".join(f'<link name="{link}"/>' for link in links)
    for name, kind, ends, inside in joints:
        parent, child = ends.split()
        body += (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0.1 0.2 0.3" rpy="0.3 0.2 0.1"/>{inside}</joint>'
        )
    return Urdf.parse(f'<robot name="r">{body}</robot>'.encode())


def turning(name: str, ends: str, inside: str = "") -> tuple[str, str, str, str]:
    return name, "revolute", ends, f'<axis xyz="0 0 1"/>{LIMIT}{inside}'


def test_a_chain_is_what_pinocchio_makes_of_the_urdf() -> None:
    model = pin.buildModelFromUrdf(str(PANDA))
    data = model.createData()
    chain = Chain.from_urdf(PANDA, "panda_link8", "panda_link2")
    assert chain.names == tuple(f"panda_joint{i}" for i in range(3, 8))
    serial = chain.build_model()
    serial_data = serial.createData()
    for seed in range(10):
        q = pin.randomConfiguration(model, model.lowerPositionLimit, model.upperPositionLimit)
        pin.framesForwardKinematics(model, data, q)
        base, tip = (data.oMf[model.getFrameId(link)] for link in ("panda_link2", "panda_link8"))
        values = np.array([q[model.joints[model.getJointId(name)].idx_q] for name in chain.names])
        pin.forwardKinematics(serial, serial_data, values)
        found = serial_data.oMi[serial.njoints - 1].homogeneous @ chain.T_last_tip
        np.testing.assert_allclose(found, (base.inverse() * tip).homogeneous, atol=1e-14, err_msg=str(seed))


def test_a_continuous_joint_has_one_value() -> None:
    description = urdf(("spin", "continuous", "a b", '<axis xyz="0 -2 0"/>'), links="ab")
    chain = Chain.from_urdf(description, "b")
    assert chain.joints[0].type == "continuous"
    assert (chain.joints[0].lower, chain.joints[0].upper) == (-np.inf, np.inf)
    np.testing.assert_array_equal(chain.joints[0].axis, [0, -1, 0])
    assert chain.build_model().nq == 1
    from_model = Chain.from_model(pin.buildModelFromXML(description.data.decode()), "b")
    assert from_model.joints[0].type == "continuous"


def test_a_mimic_joint_follows_its_master() -> None:
    description = urdf(
        turning("lead", "a b"),
        turning("free", "b c"),
        turning("follow", "c d", '<mimic joint="lead" multiplier="-2" offset="0.5"/>'),
    )
    chain = Chain.from_urdf(description, "d")
    assert chain.actuated == ("lead", "free")
    np.testing.assert_allclose(chain.joint_values([[0.1, 0.2], [0.3, 0.4]]), [[0.1, 0.2, 0.3], [0.3, 0.4, -0.1]])


def test_a_model_handed_in_stays_as_it_was() -> None:
    model = pin.buildModelFromUrdf(str(UR5))
    before = model.copy()
    chain = Chain.from_model(model, "tool0", "base_link")
    model.jointPlacements[1].translation = np.array([9.0, 9.0, 9.0])
    assert not np.any(chain.placements == 9.0)
    assert all(a == b for a, b in zip(before.jointPlacements[2:], model.jointPlacements[2:], strict=True))


def test_arrays_cannot_be_written_to() -> None:
    chain = Chain.from_urdf(UR5, "tool0")
    with pytest.raises(ValueError, match="read-only"):
        chain.placements[0, 0, 0] = 2.0


def test_the_reach_bounds_the_tip() -> None:
    chain = Chain.from_urdf(UR5, "tool0", "base_link")
    assert 0.8 < chain.reach < 1.4


def test_random_values_keep_limits_and_mimic() -> None:
    description = urdf(
        turning("lead", "a b"), turning("follow", "b c", '<mimic joint="lead" multiplier="0.5"/>'), links="abc"
    )
    q = Chain.from_urdf(description, "c").random_values(200, np.random.default_rng(0))
    assert q[:, 0].min() >= -1.0
    assert q[:, 0].max() <= 2.0
    np.testing.assert_allclose(q[:, 1], 0.5 * q[:, 0])


TWO = (turning("j", "a b"), turning("k", "b c"))


@pytest.mark.parametrize(
    ("joints", "tip", "base", "message"),
    [
        (TWO, "tool", None, "no link 'tool'"),
        (TWO, "c", "base", "no link 'base'.*Without base_link the arm starts at the root link 'a'"),
        (TWO, "b", "c", "'c' is not above tip link 'b'"),
        (TWO, "a", None, "no movable joint"),
        ((("weld", "fixed", "a b", ""),), "b", None, "no movable joint"),
        ((turning("j", "a b"), ("float", "floating", "b c", "")), "c", None, "joint 'float': a floating joint"),
        ((turning("j", "a b"), ("slide", "planar", "b c", '<axis xyz="0 0 1"/>')), "c", None, "a planar joint"),
        ((("still", "revolute", "a b", f'<axis xyz="0 0 0"/>{LIMIT}'),), "b", None, "joint 'still'.*axis is zero"),
        (
            (turning("lead", "a b"), turning("follow", "a c", '<mimic joint="lead"/>')),
            "c",
            None,
            "joint 'follow': it mimics 'lead', which is not between",
        ),
    ],
)
def test_what_is_no_chain_is_rejected_by_name(
    joints: tuple[tuple[str, str, str, str], ...], tip: str, base: str | None, message: str
) -> None:
    links = "".join(sorted({end for joint in joints for end in joint[2].split()}))
    with pytest.raises(RobotError, match=message):
        Chain.from_urdf(urdf(*joints, links=links), tip, base)


def test_what_is_no_chain_of_a_model_is_rejected_by_name() -> None:
    model = pin.buildModelFromUrdf(str(UR5), pin.JointModelFreeFlyer())
    with pytest.raises(RobotError, match="JointModelFreeFlyer is not a revolute"):
        Chain.from_model(model, "tool0", "universe")
    assert len(Chain.from_model(model, "tool0", "base_link").joints) == 6
    description = urdf(("j", "revolute", "a b", f'<axis xyz="0 0 0"/>{LIMIT}'), links="ab")
    zero = pin.buildModelFromXML(description.data.decode())
    with pytest.raises(RobotError, match="axis is zero"):
        Chain.from_model(zero, "b")


def test_a_base_beside_the_path_is_as_good_as_what_it_hangs_on() -> None:
    # Universal Robots' own `base` frame hangs on base_link, turned by half a turn.
    beside, above = Chain.from_urdf(UR5, "tool0", "base"), Chain.from_urdf(UR5, "tool0", "base_link")
    assert beside.names == above.names
    np.testing.assert_allclose(beside.placements[1:], above.placements[1:])
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(turned @ beside.placements[0], above.placements[0], atol=1e-10)


def test_a_mimic_joint_errs_with_its_master() -> None:
    description = urdf(
        turning("lead", "a b"), turning("follow", "b c", '<mimic joint="lead" multiplier="-2"/>'), links="abc"
    )
    np.testing.assert_array_equal(Chain.from_urdf(description, "c").reading_jacobian, [[1.0], [-2.0]])


# --- limits

LIMITED = (turning("lead", "a b"), turning("follow", "b c", '<mimic joint="lead"/>'), ("spin", "continuous", "c d", ""))


def test_limits_are_those_of_the_actuated_joints() -> None:
    chain = Chain.from_urdf(urdf(*LIMITED), "d")
    np.testing.assert_array_equal(chain.limits, [[-1.0, -np.inf], [2.0, np.inf]])
    assert [joint.name for joint in chain.actuated_joints] == ["lead", "spin"]


def test_readings_outside_the_limits_are_found_pose_by_pose() -> None:
    chain = Chain.from_urdf(urdf(*LIMITED), "d")
    readings = [[[-1.0, 99.0], [2.0 + 1e-7, 0.0]], [[2.1, np.nan], [0.0, np.inf]]]
    found = chain.outside_limits(readings)
    assert [(one.pose, one.joint.name) for one in found] == [(2, "lead"), (2, "spin"), (3, "spin")]
    assert str(found[0]) == "lead = 2.1 rad is outside the joint's limits [-1, 2]"
    assert [one.joint.name for one in chain.outside_limits(readings, margin=0.2)] == ["spin", "spin"]
    assert [one.pose for one in chain.outside_limits(readings, margin=0.0)] == [1, 2, 2, 3]


def test_a_sliding_joints_violation_is_in_metres() -> None:
    chain = Chain.from_urdf(urdf(("slide", "prismatic", "a b", LIMIT), links="ab"), "b")
    assert str(chain.outside_limits([-1.5])[0]) == "slide = -1.5 m is outside the joint's limits [-1, 2]"


# --- trees

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
