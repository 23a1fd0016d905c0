"""Files for makers' software, read as that software reads them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import xacro

from urdfcal.cli import run
from urdfcal.output.exports.tables import zero_offsets
from urdfcal.result.calibration import Calibration
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
# Looked up as franka_description's robots/common/utils.xacro does: config[name]['kinematic'].
FRANKA = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">
<xacro:property name="config" value="${{xacro.load_yaml('{file}')}}"/>
<link name="link0"/>
{joints}
</robot>"""
FRANKA_JOINT = """<link name="link{i}"/><joint name="joint{i}" type="fixed">
<parent link="link{before}"/><child link="link{i}"/>
<xacro:property name="k" value="${{config['joint{i}']['kinematic']}}" lazy_eval="false"/>
<origin rpy="${{k.roll}} ${{k.pitch}} ${{k.yaw}}" xyz="${{k.x}} ${{k.y}} ${{k.z}}"/></joint>"""


# As xarm_description's macros look origins up, by the joints' names: kinematics['joint1'].x and so on.
XARM = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">
<xacro:property name="kinematics_params" value="${{xacro.load_yaml('{file}')}}"/>
<xacro:property name="kinematics" value="${{kinematics_params['kinematics']}}"/>
<link name="link0"/>
{joints}
</robot>"""
XARM_JOINT = """<link name="link{i}"/><joint name="{name}" type="fixed">
<parent link="link{before}"/><child link="link{i}"/>
<xacro:property name="k" value="${{kinematics['{name}']}}" lazy_eval="false"/>
<origin xyz="${{k.x}} ${{k.y}} ${{k.z}}" rpy="${{k.roll}} ${{k.pitch}} ${{k.yaw}}"/></joint>"""


def test_xacro_places_an_xarm_s_joints_as_calibrated(calibrated: Callable[[str], Path], tmp_path: Path) -> None:
    result = calibrated("elbow3r") / "result"
    assert run(["export", str(result), "--to", "ros-kinematics", "-o", str(tmp_path)]) == 0
    corrected = Urdf.read(next(result.glob("*.urdf")))
    names = Calibration.load(result).chain.names
    joints = "\n".join(XARM_JOINT.format(i=i, before=i - 1, name=name) for i, name in enumerate(names, start=1))
    (tmp_path / "arm.xacro").write_text(XARM.format(file=tmp_path / "kinematics.yaml", joints=joints))
    (tmp_path / "arm.urdf").write_text(xacro.process_file(str(tmp_path / "arm.xacro")).toxml())
    read = Urdf.read(tmp_path / "arm.urdf")
    for name in names:
        expected = corrected.joints[name].T_parent_joint
        np.testing.assert_allclose(read.joints[name].T_parent_joint, expected, atol=1e-12)


def test_xacro_places_a_franka_s_joints_as_calibrated(calibrated: Callable[[str], Path], tmp_path: Path) -> None:
    result = calibrated("panda_sockets") / "result"
    assert run(["export", str(result), "--to", "franka-kinematics", "-o", str(tmp_path)]) == 0
    joints = "\n".join(FRANKA_JOINT.format(i=i, before=i - 1) for i in range(1, 9))
    (tmp_path / "arm.xacro").write_text(FRANKA.format(file=tmp_path / "franka_kinematics.yaml", joints=joints))
    (tmp_path / "arm.urdf").write_text(xacro.process_file(str(tmp_path / "arm.xacro")).toxml())
    read = Urdf.read(tmp_path / "arm.urdf")
    corrected = Urdf.read(next(result.glob("*.urdf")))
    for i in range(1, 9):
        expected = corrected.joints[f"panda_joint{i}"].T_parent_joint
        np.testing.assert_allclose(read.joints[f"joint{i}"].T_parent_joint, expected, atol=1e-12)


def test_another_arm_is_no_franka(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = calibrated("elbow3r") / "result"
    assert run(["export", str(result), "--to", "franka-kinematics", "-o", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "no Franka arm, of joint1 to joint8, among its calibrated joints" in said
    assert "--to ros-kinematics" in said
    assert not list(tmp_path.iterdir())


def motors(names: tuple[str, ...], low: int = 800, high: int = 3301) -> dict[str, dict[str, int]]:
    """What LeRobot writes for each motor."""
    one = {"drive_mode": 0, "homing_offset": -120, "range_min": low, "range_max": high}
    return {name: {"id": i, **one} for i, name in enumerate((*names, "gripper"), start=1)}


def degrees(motor: dict[str, int], position: int) -> float:
    """As lerobot.motors.motors_bus reads an STS3215 with use_degrees."""
    return (position - (motor["range_min"] + motor["range_max"]) / 2) * 360 / 4095


def test_lerobot_reads_the_joints_with_their_zero_offsets(calibrated: Callable[[str], Path], tmp_path: Path) -> None:
    result = calibrated("so101") / "result"
    calibration = Calibration.load(result)
    given = motors(calibration.chain.actuated)
    (tmp_path / "arm.json").write_text(json.dumps(given))
    arguments = ["export", str(result), "--to", "lerobot", "--motors", str(tmp_path / "arm.json")]
    assert run([*arguments, "-o", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "lerobot_calibration.json").read_text())
    offsets = dict(zip(calibration.chain.actuated, zero_offsets(calibration), strict=True))
    assert np.abs(list(offsets.values())).max() > 2e-3
    assert list(found) == list(given)
    assert found["gripper"] == given["gripper"]
    for name, offset in offsets.items():
        grown = np.radians(degrees(found[name], 2000) - degrees(given[name], 2000))
        assert abs(grown - offset) <= np.pi / 4095 / 2 + 1e-12
        span = (found[name]["range_max"] - found[name]["range_min"]) - (
            given[name]["range_max"] - given[name]["range_min"]
        )
        assert abs(span) <= 1
        kept = ("id", "drive_mode", "homing_offset")
        assert [found[name][key] for key in kept] == [given[name][key] for key in kept]
        assert list(found[name]) == list(given[name])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "no motor calibration of LeRobot"),
        ('{"shoulder_pan": {"range_min": 1.5, "range_max": 3}}', "no motor calibration of LeRobot"),
        (json.dumps(motors(("a",))), "there is no motor 'shoulder_pan'"),
        (json.dumps(motors(SO101, 0, 4095)), "beyond 0 to 4095"),
    ],
)  # fmt: skip
def test_what_is_no_motor_calibration_of_this_arm_is_refused(
    text: str, message: str, calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.json").write_text(text)
    arguments = [
        "export",
        str(calibrated("so101") / "result"),
        "--to",
        "lerobot",
        "--motors",
        str(tmp_path / "arm.json"),
    ]
    assert run([*arguments, "-o", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_motors_and_lerobot_go_together(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = str(calibrated("so101") / "result")
    for arguments, message in (
        (["--to", "lerobot"], "--to lerobot needs --motors FILE"),
        (["--to", "offsets", "--motors", "arm.json"], "--motors goes with --to lerobot"),
    ):
        assert run(["export", result, *arguments, "-o", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err
