from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.chain import Chain
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
    drawn = urdf(("spin", "continuous", "a b", '<axis xyz="0 -2 0"/>'), links="ab")
    chain = Chain.from_urdf(drawn, "b")
    assert chain.joints[0].type == "continuous"
    assert (chain.joints[0].lower, chain.joints[0].upper) == (-np.inf, np.inf)
    np.testing.assert_array_equal(chain.joints[0].axis, [0, -1, 0])
    assert chain.build_model().nq == 1
    from_model = Chain.from_model(pin.buildModelFromXML(drawn.data.decode()), "b")
    assert from_model.joints[0].type == "continuous"


def test_a_mimic_joint_follows_its_master() -> None:
    drawn = urdf(
        turning("lead", "a b"),
        turning("free", "b c"),
        turning("follow", "c d", '<mimic joint="lead" multiplier="-2" offset="0.5"/>'),
    )
    chain = Chain.from_urdf(drawn, "d")
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
    drawn = urdf(
        turning("lead", "a b"), turning("follow", "b c", '<mimic joint="lead" multiplier="0.5"/>'), links="abc"
    )
    q = Chain.from_urdf(drawn, "c").random_values(200, np.random.default_rng(0))
    assert q[:, 0].min() >= -1.0
    assert q[:, 0].max() <= 2.0
    np.testing.assert_allclose(q[:, 1], 0.5 * q[:, 0])


TWO = (turning("j", "a b"), turning("k", "b c"))


@pytest.mark.parametrize(
    ("joints", "tip", "base", "message"),
    [
        (TWO, "tool", None, "no link 'tool'"),
        (TWO, "c", "base", "no link 'base'"),
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
    drawn = urdf(("j", "revolute", "a b", f'<axis xyz="0 0 0"/>{LIMIT}'), links="ab")
    zero = pin.buildModelFromXML(drawn.data.decode())
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
    drawn = urdf(turning("lead", "a b"), turning("follow", "b c", '<mimic joint="lead" multiplier="-2"/>'), links="abc")
    np.testing.assert_array_equal(Chain.from_urdf(drawn, "c").reading_jacobian, [[1.0], [-2.0]])
