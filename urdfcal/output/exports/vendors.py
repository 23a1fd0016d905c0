"""The calibrated joints in the files of makers' own software: Franka's description, LeRobot's motor calibration."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import yaml

from urdfcal.errors import OutputError
from urdfcal.io.motors import RANGE, STEPS, read_motors
from urdfcal.output.exports.tables import POSE, zero_offsets
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.result.calibration import Calibration
    from urdfcal.robot.urdf.urdf import Urdf

FRANKA, LEROBOT = "franka_kinematics.yaml", "lerobot_calibration.json"


def franka_kinematics(calibration: Calibration, urdf: Urdf) -> dict[str, str]:
    """Write ``joint1: {kinematic: {x, y, z, roll, pitch, yaw}}`` and so on, as franka_description's kinematics.yaml.

    It takes the place of ``robots/<arm>/kinematics.yaml`` there; joint8, which is fixed, is the URDF's.

    Args:
        calibration: the result.
        urdf: the corrected one.

    Returns:
        The file, by name; origins in the parent link's frame. [m, rad]

    Raises:
        OutputError: not one arm of the robot has joints of these names, behind a prefix or without.
    """
    names = calibration.chain.names
    arms = [
        arm
        for arm in (name.removesuffix("joint1") for name in names if name.endswith("joint1"))
        if {f"{arm}joint{i}" for i in range(1, 8)} <= set(names) and f"{arm}joint8" in urdf.joints
    ]
    if len(arms) != 1:
        raise OutputError(
            f"{'several Franka arms' if arms else 'no Franka arm, of joint1 to joint8,'} among its calibrated joints",
            where=calibration.chain.name,
            remedy="Origins of any arm: --to ros-kinematics, or --to xacro-patch.",
        )
    document = {
        f"joint{i}": {"kinematic": _pose(urdf.joints[f"{arms[0]}joint{i}"].T_parent_joint)} for i in range(1, 9)
    }
    return {FRANKA: yaml.safe_dump(document, sort_keys=False)}


def lerobot_calibration(calibration: Calibration, given: Path) -> dict[str, str]:
    """Put the joints' zero offsets into a motor calibration of LeRobot (SO-100, SO-101).

    LeRobot reads degrees from the middle of a motor's range (``use_degrees``), so the range is moved; with what it
    reads then, the arm is the URDF without offsets (``--to offsets``). Half a step, 0.8 mrad, is what can be said.

    Args:
        calibration: the result, of joint readings that LeRobot gave in degrees, as radians.
        given: the calibration that LeRobot had then.

    Returns:
        The file, by name.

    Raises:
        SessionError: it is no such file.
        OutputError: it lacks a joint, a range leaves the encoder's turn, or whole placements were estimated.
    """
    motors = read_motors(given)
    for name, offset in zip(calibration.chain.actuated, zero_offsets(calibration).tolist(), strict=True):
        motor = motors.get(name)
        if motor is None:
            remedy = f"Its motors are {', '.join(motors)}; the URDF's joints must have their names."
            raise OutputError(f"there is no motor {name!r}", where=str(given), remedy=remedy)
        # Readings grow as the middle of the range falls; each end moves by whole steps.
        both = round(2.0 * offset * STEPS / (2.0 * np.pi))
        low = both // 2
        ends = motor["range_min"] - low, motor["range_max"] - (both - low)
        if min(ends) < 0 or max(ends) > STEPS:
            what = (
                f"an offset of {1e3 * offset:.0f} mrad moves its range to {ends[0]} to {ends[1]}, beyond 0 to {STEPS}"
            )
            raise OutputError(what, where=f"{given}, motor {name!r}", remedy="Home it with LeRobot nearer to its zero.")
        motor.update(zip(RANGE, ends, strict=True))
    return {LEROBOT: json.dumps(motors, indent=4) + "\n"}


def _pose(T: Floats) -> dict[str, float]:
    return dict(zip(POSE, (np.concatenate([T[:3, 3], matrix_to_rpy(T[:3, :3])]) + 0.0).tolist(), strict=True))
