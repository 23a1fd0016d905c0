"""Where cameras and LEDs are: as frames, as a launch file, and in the URDF."""

from __future__ import annotations

import io
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from urdfcal.errors import OutputError
from urdfcal.estimation.measurements import Detections
from urdfcal.output.exports.frames import found_frames, static_transforms, urdf_with_frames
from urdfcal.result.calibration import Calibration
from urdfcal.result.document import read_document
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.output.exports.conftest import Result


def placed(result: Result, frame: str, q: np.ndarray, data: bytes) -> np.ndarray:
    """T_base_frame by Pinocchio, at values (n) of the chain's joints."""
    model = pin.buildModelFromXML(data.decode())
    built, values = model.createData(), pin.neutral(model)
    for name, value in zip(result.calibration.chain.names, q, strict=True):
        joint = model.joints[model.getJointId(name)]
        values[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    pin.framesForwardKinematics(model, built, values)
    base = built.oMf[model.getFrameId(result.calibration.chain.base_link)]
    return (base.inverse() * built.oMf[model.getFrameId(frame)]).homogeneous


def test_the_cameras_see_the_leds_of_the_urdf_where_they_were_seen(results: Callable, simulated: Callable) -> None:
    result, session = results("ur5"), simulated("ur5").session
    (data,) = urdf_with_frames(result.urdf, found_frames(result.calibration)).values()
    seen = session.find(Detections)
    for row in range(0, len(seen), 7):
        camera = session.rig.cameras[seen.camera[row]]
        q = session.q[seen.pose[row]]
        T_base_cam = placed(result, f"{camera.name}_optical_frame", q, data)
        T_base_led = placed(result, session.led_names[seen.led[row]], q, data)
        point = np.linalg.inv(T_base_cam) @ T_base_led[:, 3]
        np.testing.assert_allclose(camera.project(point[None, :3])[0], seen.uv[row], atol=1.0)  # px


def test_nothing_else_of_the_urdf_changes(result: Result) -> None:
    frames = found_frames(result.calibration)
    ((name, data),) = urdf_with_frames(result.urdf, frames).items()
    assert name == f"{result.urdf.path.stem}_frames.urdf"
    added = Urdf.parse(data)
    assert set(added.links) - set(result.urdf.links) == {frame.name for frame in frames}
    start = next(i for i, (a, b) in enumerate(zip(data, result.urdf.data, strict=False)) if a != b)
    length = len(data) - len(result.urdf.data)
    assert data[:start] + data[start + length :] == result.urdf.data
    robot = yourdfpy.URDF.load(io.BytesIO(data), load_meshes=False)
    for frame in frames:
        joint = robot.joint_map[f"{frame.name}_joint"]
        assert (joint.parent, joint.child, joint.type) == (frame.parent, frame.name, "fixed")
        np.testing.assert_allclose(joint.origin, frame.T_parent_frame, atol=1e-12)


def test_a_launch_file_publishes_the_same_transforms(result: Result) -> None:
    frames = found_frames(result.calibration)
    (text,) = static_transforms(frames).values()
    nodes = list(ET.fromstring(text))  # noqa: S314 - our own text
    assert len(nodes) == len(frames)
    assert len({node.get("name") for node in nodes}) == len(nodes)
    for node, frame in zip(nodes, frames, strict=True):
        assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
        words = node.get("args").split()
        said = dict(zip(words[::2], words[1::2], strict=True))
        assert (said["--frame-id"], said["--child-frame-id"]) == (frame.parent, frame.name)
        x, y, z, qx, qy, qz, qw = (float(said[f"--{key}"]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        T = pin.SE3(pin.Quaternion(qw, qx, qy, qz), np.array([x, y, z])).homogeneous
        np.testing.assert_allclose(T, frame.T_parent_frame, atol=1e-12)


def test_names_that_are_taken_or_none_are_refused(results: Callable) -> None:
    result = results("ur5")
    frames = found_frames(result.calibration)
    with pytest.raises(OutputError, match="a link 'tool0'"):
        urdf_with_frames(result.urdf, [replace(frames[0], name="tool0")])
    document = result.calibration.to_dict()
    document["leds"] = {"the led": document["leds"]["led"]}
    with pytest.raises(OutputError, match="'the led' is no name"):
        found_frames(Calibration(read_document(json.dumps(document), "calibration.json")))
    document["leds"] = {"tool0": result.calibration.to_dict()["leds"]["led"]}
    with pytest.raises(OutputError, match="'tool0' is a link of the robot"):
        found_frames(Calibration(read_document(json.dumps(document), "calibration.json")))
