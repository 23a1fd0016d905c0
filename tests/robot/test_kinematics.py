from __future__ import annotations

import numpy as np
import pinocchio as pin

from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import joint_axes, tip_motion, tip_poses
from urdfcal.robot.urdf.packages import package_roots

ROBOTS = package_roots()[-1] / "example-robot-data" / "robots"


def tiago() -> Chain:
    """Seven turning joints on a sliding torso."""
    return Chain.from_urdf(ROBOTS / "tiago_description" / "robots" / "tiago.urdf", "arm_tool_link")


def test_motion_and_poses_agree() -> None:
    chain = tiago()
    assert {joint.prismatic for joint in chain.joints} == {True, False}
    q = chain.random_values(20, np.random.default_rng(0))
    motion, T = tip_motion(chain, chain.build_model(), q), tip_poses(chain, q)
    np.testing.assert_allclose(motion.R, T[:, :3, :3], atol=1e-14)
    np.testing.assert_allclose(motion.p, T[:, :3, 3], atol=1e-14)


def test_the_regressor_is_the_derivative_of_the_tip() -> None:
    chain = tiago()
    q = chain.random_values(3, np.random.default_rng(1))
    motion = tip_motion(chain, chain.build_model(), q)
    for column in range(6 * len(chain.joints)):
        joint, xi = divmod(column, 6)
        step = np.eye(6)[xi] * 1e-6
        moved = []
        for sign in (-1.0, 1.0):
            placements = np.array(chain.placements)
            placements[joint] = placements[joint] @ pin.exp6(sign * step).homogeneous
            moved.append(tip_poses(chain, q, placements))
        velocity = (moved[1][:, :3, 3] - moved[0][:, :3, 3]) / 2e-6
        turning = (moved[1][:, :3, :3] - moved[0][:, :3, :3]) / 2e-6 @ np.swapaxes(motion.R, 1, 2)
        omega = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
        np.testing.assert_allclose(motion.regressor[:, :, column], np.hstack([velocity, omega]), atol=3e-9)


def test_joint_axes_turn_the_regressor_into_the_jacobian() -> None:
    chain = tiago()
    q = chain.random_values(3, np.random.default_rng(2))
    J = tip_motion(chain, chain.build_model(), q).regressor @ joint_axes(chain)
    for i in range(len(chain.joints)):
        step = np.eye(len(chain.joints))[i] * 1e-6
        velocity = (tip_poses(chain, q + step)[:, :3, 3] - tip_poses(chain, q - step)[:, :3, 3]) / 2e-6
        np.testing.assert_allclose(J[:, :3, i], velocity, atol=3e-9)
