"""Drake moves the corrected URDF as the calibrated arm moves. Drake is large: skipped where it is not installed."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import pytest

from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from tests.output.exports.conftest import Result


def test_drake_moves_the_corrected_urdf_as_the_calibrated_arm(result: Result) -> None:
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    root = ElementTree.fromstring(result.urdf.data)  # noqa: S314  # our own
    for link in root.iter("link"):  # Drake reads no COLLADA, and shapes do not matter here
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    plant = MultibodyPlant(0.0)
    (model,) = Parser(plant).AddModelsFromString(ElementTree.tostring(root, encoding="unicode"), "urdf")
    plant.Finalize()
    calibrated = result.calibration.calibrated
    context = plant.CreateDefaultContext()
    base, tip = (plant.GetFrameByName(name, model) for name in (calibrated.base_link, calibrated.tip_link))
    values = calibrated.random_values(20, np.random.default_rng(0))
    for q, expected in zip(values, tip_poses(calibrated, values), strict=True):
        for name, value in zip(calibrated.names, q, strict=True):
            joint = plant.GetJointByName(name, model)
            (joint.set_translation if hasattr(joint, "set_translation") else joint.set_angle)(context, value)
        T = plant.CalcRelativeTransform(context, base, tip).GetAsMatrix4()
        np.testing.assert_allclose(T, expected, rtol=0, atol=1e-9)
