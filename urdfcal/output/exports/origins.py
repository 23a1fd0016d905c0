"""The calibrated joint origins as YAML for ROS and xacro, and the corrected URDF that exports are made from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.result.calibration import corrected_name
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.result.calibration import Calibration

KINEMATICS, ORIGINS = "kinematics.yaml", "origins.yaml"
# The URDF's angles round by less; an edited origin differs by more. [m, entries of the rotation]
_SAME = 1e-9
_INSTRUCTION = """\
# Calibrated joint origins, m and rad; calibration.json has sha256 {sha256}.
# In the xacro file, once:
#   <xacro:property name="calibrated" value="${{xacro.load_yaml('{file}')}}"/>
# In each joint below, instead of its <origin>:
#   <origin xyz="${{calibrated['{joint}']['xyz']}}" rpy="${{calibrated['{joint}']['rpy']}}"/>
# Or leave the xacro file alone, and correct what it expands to: urdfcal apply OUT robot.urdf
"""


def corrected_urdf(calibration: Calibration, folder: Path) -> Urdf:
    """Read the corrected URDF that was written with a calibration.

    Args:
        calibration: as loaded.
        folder: of the results.

    Raises:
        OutputError: it is not there, or its origins are not the calibration's.
        RobotError: it is no valid URDF.
    """
    path = folder / corrected_name(calibration.to_dict()["robot"]["urdf"])
    if not path.is_file():
        raise OutputError(
            "the corrected URDF is not beside calibration.json",
            where=str(path),
            remedy="Name the folder that `urdfcal calibrate` wrote.",
        )
    urdf, chain = Urdf.read(path), calibration.chain
    found = read_mechanism(urdf, [tip.link for tip in chain.tips], chain.base_link)
    for name in (name for name in chain.names if name not in found.names):
        raise _edited(path, name)
    for name, T, calibrated in zip(found.names, found.placements, calibration.placements, strict=True):
        if not np.allclose(T, calibrated, rtol=0.0, atol=_SAME):
            raise _edited(path, name)
    return urdf


def _edited(path: Path, joint: str) -> OutputError:
    return OutputError(
        f"joint {joint!r} is not placed as calibration.json says",
        where=str(path),
        remedy="One of the two files was edited: calibrate again.",
    )


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
    return {KINEMATICS: yaml.safe_dump(document, sort_keys=False, allow_unicode=True)}


def joint_keys(calibration: Calibration) -> dict[str, str]:
    """Origins named by their joints."""
    return {name: name for name in calibration.chain.names}


def link_keys(calibration: Calibration, urdf: Urdf) -> dict[str, str]:
    """Origins named by the links that they place, without ``_link``: as Universal Robots' description names them."""
    return {name: urdf.joints[name].child.removesuffix("_link") for name in calibration.chain.names}


def xacro_patch(calibration: Calibration) -> dict[str, str]:
    """Write the origins, in the parent link's frame, with the instruction how to use them above.

    Args:
        calibration: the result.

    Returns:
        The file, by name.
    """
    import yaml

    origins = {
        joint: {key: " ".join(repr(float(value)) for value in T[key]) for key in ("xyz", "rpy")}
        for joint, T in calibration.to_dict()["placements"].items()
    }
    instruction = _INSTRUCTION.format(sha256=calibration.sha256, file=ORIGINS, joint=calibration.chain.names[-1])
    return {ORIGINS: instruction + yaml.safe_dump(origins, sort_keys=False, allow_unicode=True, width=200)}
