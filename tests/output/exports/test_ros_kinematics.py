from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np
import yaml

from urdfcal.output.exports.tables import joint_keys, link_keys, ros_kinematics
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.origins import rewrite_origins
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import rpy_to_matrix

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.output.exports.conftest import Result


def test_the_drawn_robot_with_these_origins_is_the_calibrated_one(result: Result) -> None:
    calibration = result.calibration
    (text,) = ros_kinematics(calibration, joint_keys(calibration)).values()
    kinematics = yaml.safe_load(text)["kinematics"]
    saved = (result.folder / "calibration.json").read_bytes()
    assert kinematics.pop("hash") == f"urdfcal_{hashlib.sha256(saved).hexdigest()}"
    assert set(kinematics) == set(calibration.chain.names)
    origins = {}
    for joint, numbers in kinematics.items():
        assert list(numbers) == ["x", "y", "z", "roll", "pitch", "yaw"]
        T = np.eye(4)
        T[:3, 3] = [numbers[key] for key in "xyz"]
        T[:3, :3] = rpy_to_matrix([numbers[key] for key in ("roll", "pitch", "yaw")])
        origins[joint] = T
    # Into a description that has other origins: of every joint, not of those that a calibration changes.
    other = Urdf.parse(rewrite_origins(result.urdf, dict.fromkeys(origins, np.eye(4))))
    chain = Chain.from_urdf(
        Urdf.parse(rewrite_origins(other, origins)), calibration.chain.tip_link, calibration.chain.base_link
    )
    q = chain.random_values(20, np.random.default_rng(0))
    np.testing.assert_allclose(tip_poses(chain, q), tip_poses(calibration.calibrated, q), rtol=0, atol=1e-9)


def test_links_name_origins_as_universal_robots_does(results: Callable[[str], Result]) -> None:
    result = results("ur5")
    (text,) = ros_kinematics(result.calibration, link_keys(result.calibration, result.urdf)).values()
    assert list(yaml.safe_load(text)["kinematics"]) == [
        "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "hash",
    ]  # fmt: skip
