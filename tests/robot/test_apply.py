from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.apply import apply_to_mechanism, apply_to_model, apply_to_urdf
from urdfcal.robot.chain import Chain, Tree
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Callable

RIGS = ("ur5", "panda", "so101", "stanford", "elbow3r")


class Arm:
    """An arm nominal and calibrated, each as URDF and as Pinocchio's model of it."""

    def __init__(self, data: object) -> None:
        session = data.session
        self.urdf, self.chain, self.calibrated = session.urdf, session.chain, data.truth.placements
        self.text = rewrite_origins(self.urdf, origins_of(self.urdf, self.chain, self.calibrated)).decode()
        self.nominal_text = self.urdf.data.decode()


@pytest.fixture(params=RIGS)
def arm(request: pytest.FixtureRequest, simulated: Callable) -> Arm:
    return Arm(simulated(request.param))


def assert_same_frames(applied: pin.Model, calibrated: pin.Model, count: int = 20) -> None:
    """Every frame of both models is in the same place at random configurations."""
    assert [frame.name for frame in applied.frames] == [frame.name for frame in calibrated.frames]
    lower, upper = np.maximum(applied.lowerPositionLimit, -3.0), np.minimum(applied.upperPositionLimit, 3.0)
    placed = []
    for model in (applied, calibrated):
        pin.seed(0)
        data = model.createData()
        configurations = [pin.randomConfiguration(model, lower, upper) for _ in range(count)]
        placed.append([])
        for q in configurations:
            pin.framesForwardKinematics(model, data, q)
            placed[-1].append([oMf.homogeneous.copy() for oMf in data.oMf])
    np.testing.assert_allclose(placed[0], placed[1], atol=1e-12)


def test_a_nominal_model_becomes_one_of_the_corrected_urdf(arm: Arm) -> None:
    applied, calibrated = pin.buildModelFromXML(arm.nominal_text), pin.buildModelFromXML(arm.text)
    apply_to_model(applied, arm.chain, arm.calibrated)
    assert_same_frames(applied, calibrated)


def test_a_free_flyer_is_no_obstacle(arm: Arm) -> None:
    applied, calibrated = (
        pin.buildModelFromXML(text, pin.JointModelFreeFlyer()) for text in (arm.nominal_text, arm.text)
    )
    apply_to_model(applied, arm.chain, arm.calibrated)
    assert_same_frames(applied, calibrated)


def test_locked_joints_are_corrected_with_all_that_hangs_on_them(arm: Arm) -> None:
    rng = np.random.default_rng(0)
    nominal, calibrated = pin.buildModelFromXML(arm.nominal_text), pin.buildModelFromXML(arm.text)
    for _ in range(6):
        locked = [
            nominal.getJointId(name) for name in arm.chain.names if rng.random() < 0.5 or name == arm.chain.names[1]
        ]
        pin.seed(3)
        at = pin.randomConfiguration(
            nominal, np.maximum(nominal.lowerPositionLimit, -3.0), np.minimum(nominal.upperPositionLimit, 3.0)
        )
        applied, reference = (pin.buildReducedModel(model, locked, at) for model in (nominal, calibrated))
        apply_to_model(applied, arm.chain, arm.calibrated)
        assert_same_frames(applied, reference)


def test_other_joints_locked_on_the_last_one_do_not_matter(simulated: Callable) -> None:
    arm = Arm(simulated("panda"))
    models = (pin.buildModelFromXML(text) for text in (arm.nominal_text, arm.text))
    fingers = ["panda_finger_joint1", "panda_finger_joint2"]
    applied, reference = (
        pin.buildReducedModel(model, [model.getJointId(name) for name in fingers], pin.neutral(model))
        for model in models
    )
    apply_to_model(applied, arm.chain, arm.calibrated)
    assert_same_frames(applied, reference)


def test_what_a_reduced_model_does_not_say_is_refused(simulated: Callable) -> None:
    arm = Arm(simulated("panda"))
    nominal = pin.buildModelFromXML(arm.nominal_text)
    locked = [nominal.getJointId(name) for name in (arm.chain.names[-1], "panda_finger_joint1")]
    model = pin.buildReducedModel(nominal, locked, pin.neutral(nominal))
    kept = model.copy()
    with pytest.raises(RobotError, match=r"panda_finger_joint1.*whole model first"):
        apply_to_model(model, arm.chain, arm.calibrated)
    assert model == kept


def test_joints_are_found_by_name_in_any_order(simulated: Callable) -> None:
    # The same robot behind another one's joints, as in a cell of two.
    arm = Arm(simulated("panda"))
    joints = [name for name in pin.buildModelFromXML(arm.nominal_text).names if name.startswith("panda")]
    cell, place = pin.buildSampleModelManipulator(), pin.SE3.Random()
    applied, reference = (
        pin.appendModel(cell, pin.buildModelFromXML(text), 0, place) for text in (arm.nominal_text, arm.text)
    )
    assert all(applied.getJointId(name) > cell.njoints - 1 for name in joints)
    apply_to_model(applied, arm.chain, arm.calibrated)
    assert_same_frames(applied, reference)


def gripper_by_hand() -> pin.Model:
    """Two fingers whose joints have no frames, as ``addJoint`` alone makes them."""
    gripper = pin.Model()
    for side in ("left", "right"):
        joint = gripper.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), f"finger_{side}")
        gripper.addBodyFrame(f"{side}_finger", joint, pin.SE3.Identity(), 0)
    return gripper


def test_a_gripper_whose_joints_have_no_frames_is_no_obstacle(simulated: Callable) -> None:
    arm = Arm(simulated("ur5"))
    models = [pin.buildModelFromXML(text) for text in (arm.nominal_text, arm.text)]
    whole = [
        pin.appendModel(model, gripper_by_hand(), model.getFrameId("tool0"), pin.SE3.Identity()) for model in models
    ]
    reduced = [pin.buildReducedModel(model, [2], pin.neutral(model)) for model in whole]
    assert whole[0].getFrameId("finger_left", pin.FrameType.JOINT) == whole[0].nframes
    for applied, reference in (whole, reduced):
        apply_to_model(applied, arm.chain, arm.calibrated)
        assert_same_frames(applied, reference)


def test_what_may_hang_on_a_locked_joint_is_refused(simulated: Callable) -> None:
    arm = Arm(simulated("ur5"))
    model = pin.buildModelFromXML(arm.nominal_text)
    model = pin.appendModel(model, gripper_by_hand(), model.getFrameId("tool0"), pin.SE3.Identity())
    reduced = pin.buildReducedModel(model, [6], pin.neutral(model))
    kept = reduced.copy()
    with pytest.raises(RobotError, match=r"what 'finger_left' hangs on: .*whole model first"):
        apply_to_model(reduced, arm.chain, arm.calibrated)
    assert reduced == kept
    reduced = pin.buildReducedModel(pin.buildModelFromXML(arm.nominal_text), [6], pin.neutral(model)[:6])
    reduced.addFrame(pin.Frame("tcp", 5, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    with pytest.raises(RobotError, match=r"what 'tcp' hangs on: .*whole model first"):
        apply_to_model(reduced, arm.chain, arm.calibrated)


def test_a_model_that_is_not_nominal_is_refused_and_left_alone(simulated: Callable) -> None:
    arm = Arm(simulated("panda"))
    model = pin.buildModelFromXML(arm.nominal_text)
    apply_to_model(model, arm.chain, arm.calibrated)
    kept = model.copy()
    with pytest.raises(RobotError, match="'panda_joint2' already has its calibrated placement"):
        apply_to_model(model, arm.chain, arm.calibrated)
    with pytest.raises(RobotError, match="no joint 'panda_joint1'"):
        apply_to_model(pin.buildSampleModelManipulator(), arm.chain, arm.calibrated)
    other = pin.buildModelFromXML(arm.nominal_text)
    index = other.getJointId("panda_joint4")
    other.jointPlacements[index] = other.jointPlacements[index] * pin.SE3(np.eye(3), np.array([1e-3, 0.0, 0.0]))
    changed = other.copy()
    with pytest.raises(RobotError, match="'panda_joint4' is not the one that was calibrated: it is 1 mm off"):
        apply_to_model(other, arm.chain, arm.calibrated)
    assert model == kept
    assert other == changed


def test_another_urdf_of_the_same_robot_is_corrected(arm: Arm) -> None:
    # As xacro makes it anew: other white space and comments, numbers with fewer digits than the joint's correction has.
    again = Urdf.parse(arm.urdf.data.replace(b"<joint ", b"<!-- made anew -->\n<joint  "))
    data = apply_to_urdf(again, arm.chain, arm.calibrated)
    assert data.count(b"made anew") == again.data.count(b"made anew") > 0
    calibrated = Chain.from_urdf(Urdf.parse(data), arm.chain.tip_link, arm.chain.base_link)
    np.testing.assert_allclose(calibrated.placements, arm.calibrated, atol=1e-12)


def test_a_urdf_of_another_robot_is_refused_by_the_joints_name(simulated: Callable) -> None:
    arm = Arm(simulated("ur5"))
    with pytest.raises(RobotError, match="already has its calibrated placement"):
        apply_to_urdf(Urdf.parse(arm.text.encode()), arm.chain, arm.calibrated)
    joint = arm.chain.names[2]
    moved = {joint: arm.urdf.joints[joint].T_parent_joint + np.pad(np.full((1, 1), 0.002), ((0, 3), (3, 0)))}
    with pytest.raises(RobotError, match=f"'{joint}' is not the one that was calibrated: it is 2 mm off"):
        apply_to_urdf(Urdf.parse(rewrite_origins(arm.urdf, moved)), arm.chain, arm.calibrated)
    axis = replace(arm.chain.joints[3], axis=-arm.chain.joints[3].axis)
    turned = replace(arm.chain, joints=(*arm.chain.joints[:3], axis, *arm.chain.joints[4:]))
    with pytest.raises(RobotError, match=f"'{arm.chain.names[3]}' does not move as"):
        apply_to_urdf(arm.urdf, turned, arm.calibrated)
    with pytest.raises(RobotError, match="no link 'base_link'"):
        apply_to_urdf(Arm(simulated("panda")).urdf, arm.chain, arm.calibrated)


def test_a_link_that_moved_on_the_base_link_is_reported_as_such(simulated: Callable) -> None:
    arm = Arm(simulated("ur5"))
    tree = Tree.from_urdf(arm.urdf, ["tool0", "base"], "base_link")
    fixed = "base_link-base_fixed_joint"
    T = arm.urdf.joints[fixed].T_parent_joint.copy()
    T[0, 3] += 0.01
    moved = Urdf.parse(rewrite_origins(arm.urdf, {fixed: T}))
    with pytest.raises(RobotError, match="link 'base' is elsewhere on link 'base_link' than"):
        apply_to_urdf(moved, tree, arm.calibrated)


def test_another_reading_of_the_robot_gets_the_calibrated_placements(arm: Arm) -> None:
    """Nominal or corrected, to the same link or an earlier one."""
    for urdf in (arm.urdf, Urdf.parse(arm.text.encode())):
        other = Chain.from_urdf(urdf, arm.chain.tip_link, arm.chain.base_link)
        applied = apply_to_mechanism(other, arm.chain, arm.calibrated, "other")
        np.testing.assert_array_equal(applied.placements, arm.calibrated)
    joints = [arm.urdf.joints[name] for name in arm.chain.names[:2]]
    short = Chain.from_urdf(arm.urdf, joints[-1].child, arm.chain.base_link)
    applied = apply_to_mechanism(short, arm.chain, arm.calibrated, "short")
    np.testing.assert_array_equal(applied.placements, arm.calibrated[:2])
    assert applied.tip_link == joints[-1].child


def test_a_reading_of_another_robot_is_refused_with_its_place(simulated: Callable) -> None:
    arm, elbow3r = Arm(simulated("ur5")), Arm(simulated("elbow3r"))
    chain = arm.chain
    moved = np.array(chain.placements)
    moved[2, 0, 3] += 0.001
    elsewhere = replace(chain, placements=moved)
    turned = replace(chain, joints=(replace(chain.joints[0], axis=-chain.joints[0].axis), *chain.joints[1:]))
    tree = Tree(
        chain.name, chain.base_link, chain.joints, (-1, 0, 1, 2, 3, 3), chain.placements,
        (*chain.tips, replace(chain.tips[0], link="other", joint=4)),
    )  # fmt: skip
    for other, told in (
        (elbow3r.chain, "joint 'joint_1' was not calibrated"),
        (elsewhere, "the placement of joint 'elbow_joint' is not the one that was calibrated: it is 1 mm off"),
        (turned, "joint 'shoulder_pan_joint' does not move as the one that was calibrated"),
        (tree, "joint 'wrist_3_joint' does not hang where it did"),
    ):
        with pytest.raises(RobotError, match=told) as refused:
            apply_to_mechanism(other, chain, arm.calibrated, "session.yaml")
        assert refused.value.where == "session.yaml"
