"""ROS: the joints' origins as the YAML that robot descriptions written in xacro read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

FILE = "kinematics.yaml"


def ros_kinematics(calibration: Calibration, keys: Mapping[str, str]) -> dict[str, str]:
    """Write ``kinematics: {key: {x, y, z, roll, pitch, yaw}, hash: ...}``, as ur_description's default_kinematics.yaml.

    Args:
        calibration: the result.
        keys: what the description calls each joint's origin, by joint.

    Returns:
        The file, by name; origins in the parent link's frame [m, rad], the hash of calibration.json.
    """
    import yaml

    origins: dict[str, Any] = {
        keys[joint]: dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), [*T["xyz"], *T["rpy"]], strict=True))
        for joint, T in calibration.to_dict()["placements"].items()
    }
    document = {"kinematics": {**origins, "hash": f"urdfcal_{calibration.sha256}"}}
    return {FILE: yaml.safe_dump(document, sort_keys=False, allow_unicode=True)}


def joint_keys(calibration: Calibration) -> dict[str, str]:
    """Origins named by their joints."""
    return {name: name for name in calibration.chain.names}


def link_keys(calibration: Calibration, urdf: Urdf) -> dict[str, str]:
    """Origins named by the links that they place, without ``_link``: as Universal Robots' description names them."""
    return {name: urdf.joints[name].child.removesuffix("_link") for name in calibration.chain.names}
