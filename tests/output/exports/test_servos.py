from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pytest

from tests.worlds import sagging
from urdfcal.errors import RobotError
from urdfcal.output.exports.servos import yielding_servos
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration


@pytest.fixture(scope="module")
def bent(simulated: Callable) -> FittedCalibration:
    session = replace(sagging(simulated("ur5", poses=40), 4e-5), estimate=Estimate("dh", "fixed", "fixed"))
    return calibrate(replace(session, joint_models={"compliance": True}), force=True)


def with_servos(calibration: FittedCalibration, line: str = '<position name="{0}" joint="{0}" kp="2000"/>') -> str:
    """The calibrated URDF as MuJoCo writes it, with a servo on each joint."""
    specification = mujoco.MjSpec.from_string(without_meshes(calibration.calibrated_urdf().decode()))
    specification.compile()
    text = specification.to_xml()
    servos = "".join(f"\n    {line.format(name)}" for name in calibration.chain.actuated)
    return text.replace("</mujoco>", f"  <actuator><!-- servos -->{servos}\n  </actuator>\n</mujoco>")


def without_meshes(urdf: str) -> str:
    urdf = re.sub(r"<(visual|collision)\b.*?</\1>", "", urdf, flags=re.DOTALL)
    return urdf.replace("<link", '<mujoco><compiler fusestatic="false"/></mujoco>\n<link', 1)


@pytest.mark.parametrize(
    "line",
    [
        '<position name="{0}" joint="{0}" kp="2000"/>',
        "<position joint='{0}'/>",
        '<position joint="{0}" gear="2"/>',
        '<general joint="{0}" gainprm="500" biastype="affine" biasprm="0 -500 -20"/>',
    ],
)
def test_mujocos_arm_rests_where_the_real_one_does(bent: FittedCalibration, line: str, tmp_path: Path) -> None:
    data, stiffness = yielding_servos(bent, with_servos(bent, line).encode(), tmp_path / "arm.xml")
    # The wrist carries nothing: what is found of its joints is noise.
    assert set(stiffness) == {"shoulder_lift_joint", "elbow_joint"}
    found = bent.document.joint_models
    assert stiffness == {joint: 1.0 / found[joint]["compliance"].values[0] for joint in stiffness}
    model = mujoco.MjModel.from_xml_string(data.decode())
    state = mujoco.MjData(model)
    readings = bent.session.readings[3]
    true = bent.joint_values(readings)
    assert np.abs(true - readings).max() > 5e-4
    joints = [model.joint(name).qposadr[0] for name in bent.chain.names]
    state.qpos[joints] = true
    state.ctrl[:] = readings * model.actuator_gear[:, 0]
    mujoco.mj_forward(model, state)
    # At rest the servos carry what gravity pulls with, but for what it pulls elsewhere where the joints are than where
    # they read: a hundredth of what they yield.
    carried = state.qfrc_actuator - state.qfrc_bias
    for name, stiff in stiffness.items():
        assert abs(carried[model.joint(name).dofadr[0]]) / stiff < 0.01 * np.abs(true - readings).max(), name
    if "general" in line:
        assert model.actuator_biasprm[:, 2].tolist() == [-20.0] * model.nu


def test_nothing_but_the_gains_changes(bent: FittedCalibration, tmp_path: Path) -> None:
    text = with_servos(bent)
    data, _ = yielding_servos(bent, text.encode(), tmp_path / "arm.xml")
    assert re.sub(r'kp="[^"]*"', "", data.decode()) == re.sub(r'kp="[^"]*"', "", text)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('<motor joint="{0}"/>', r"arm.xml: joint '.*' yields by \d.*, and has 0 position servos.*<position joint="),
        ('<position joint="{0}"/><position joint="{0}"/>', "has 2 position servos"),
    ],
)
def test_a_joint_without_its_servo_is_refused(bent: FittedCalibration, line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(RobotError) as caught:
        yielding_servos(bent, with_servos(bent, line).encode(), tmp_path / "arm.xml")
    assert re.search(message, str(caught.value)), caught.value


def test_an_arm_that_does_not_yield_is_refused(results: Callable, tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"--servos: no joint was found to yield.*Leave the option out"):
        yielding_servos(results("elbow3r").calibration, b"<mujoco/>", tmp_path / "arm.xml")


def test_a_compliance_within_its_noise_is_none(bent: FittedCalibration, tmp_path: Path) -> None:
    found = {"elbow_joint": {"compliance": SimpleNamespace(values=[1e-5], sigma=[8e-6])}}
    unsure = SimpleNamespace(document=SimpleNamespace(joint_models=found), joint_models=bent.joint_models)
    with pytest.raises(RobotError, match="no joint was found to yield"):
        yielding_servos(unsure, with_servos(bent).encode(), tmp_path / "arm.xml")
    found["elbow_joint"]["compliance"].sigma = [1e-6]
    _, stiffness = yielding_servos(unsure, with_servos(bent).encode(), tmp_path / "arm.xml")
    assert stiffness == {"elbow_joint": pytest.approx(1e5)}
