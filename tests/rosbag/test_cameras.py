from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
import pytest

from tests.rosbag.bags import BASELINE, START, Recording
from urdfcal.errors import CameraError
from urdfcal.rosbag.bag import Message
from urdfcal.rosbag.cameras import read_bag_cameras

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.cameras.rig import Rig

TOPICS = (("left", "/left/camera_info"), ("right", "/right/camera_info"))
D = (-0.1, 0.02, 0.001, -0.002, 0.0)


def read(bag: Recording) -> tuple[Rig, tuple[str, ...]]:
    read = read_bag_cameras(TOPICS, [Message(topic, received, content) for received, topic, content in bag.messages])
    return read.rig, read.notes


def pair(kind: str = "sqlite3", **of_both: Any) -> Recording:
    bag = Recording(kind)
    for name, topic in TOPICS:
        bag.info(topic, START, frame=f"{name}_optical_frame", **of_both)
    return bag


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_lenses_are_those_of_the_message(kind: str) -> None:
    rig, notes = read(pair(kind))
    assert rig.names == ("left", "right")
    assert rig.cameras[1].resolution == (64, 48)
    assert rig.cameras[1].intrinsics.tolist() == [80.0, 81.0, 32.25, 23.5]
    # No k3: the same projection without it.
    assert rig.cameras[1].distortion_model == "radtan"
    assert rig.cameras[1].distortion.tolist() == list(D[:4])
    assert rig.T_cam_world[1] is None
    assert notes == ("the pose of right is not known: it is estimated",)


@pytest.mark.parametrize(
    ("model", "d", "expected"),
    [
        ("plumb_bob", (-0.1, 0.02, 0.001, -0.002, 0.3), ("radtan", 5)),
        ("plumb_bob", (0.0,) * 5, ("none", 0)),
        ("plumb_bob", (), ("none", 0)),
        ("", (), ("none", 0)),
        ("equidistant", (0.1, 0.02, 0.001, -0.002), ("equidistant", 4)),
        ("fisheye", (0.1, 0.02, 0.001, -0.002), ("equidistant", 4)),
    ],
)
def test_ros_names_of_distortion_models(model: str, d: tuple[float, ...], expected: tuple[str, int]) -> None:
    camera = read(pair(model=model, d=d))[0].cameras[0]
    assert (camera.distortion_model, len(camera.distortion)) == expected
    assert camera.distortion.tolist() == list(d[: expected[1]])


def test_a_stereo_pair_stands_as_its_projection_says() -> None:
    bag = Recording("sqlite3")
    bag.info(TOPICS[0][1], START, frame="left_optical")
    bag.info(TOPICS[1][1], START, baseline=BASELINE, frame="right_optical")
    # Rectification is what the images were made with; transforms may be a designer's.
    bag.static(START, [("left_optical", "right_optical", (0.1, 0, 0), (0, 0, 0, 1))])
    rig, notes = read(bag)
    np.testing.assert_allclose(rig.T_cam_world[1][:3, 3], [-BASELINE, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(rig.T_cam_world[1][:3, :3], np.eye(3))
    assert notes == ("the pose of right is from /right/camera_info",)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_optical_frames_stand_as_the_static_transforms_say(kind: str) -> None:
    rng = np.random.default_rng(0)
    names = ["left_mount", "left_optical_frame", "right_mount", "/right_optical_frame"]
    parents = ["bench", "left_mount", "bench", "right_mount"]
    T = [pin.SE3.Random() for _ in names]
    transforms = [
        (parent, child, M.translation, pin.Quaternion(M.rotation).coeffs() * rng.choice([-1.0, 1.0]))
        for parent, child, M in zip(parents, names, T, strict=True)
    ]
    bag = pair(kind)
    bag.static(START, transforms[:1])
    bag.static(START, transforms[1:])
    rig, notes = read(bag)
    expected = (T[2] * T[3]).inverse() * (T[0] * T[1])
    np.testing.assert_allclose(rig.T_cam_world[1], expected.homogeneous, atol=1e-14)
    assert notes == ("the pose of right is from /tf_static",)


def test_of_a_transform_that_is_given_twice_the_last_one_counts() -> None:
    bag, turn = pair(), np.array([0.0, 0.0, 0.0, 1.009])  # about as long as tf2 allows
    for x in (0.1, 0.2):
        bag.static(START, [("left_optical_frame", "right_optical_frame", (x, 0, 0), turn)])
    np.testing.assert_allclose(read(bag)[0].T_cam_world[1][:3], np.eye(4)[:3] - [[0, 0, 0, 0.2], [0] * 4, [0] * 4])


@pytest.mark.parametrize(
    ("frames", "transforms"),
    [
        (("left_optical", "right_optical"), [("bench", "left_optical", (1, 0, 0), (0, 0, 0, 1))]),
        (("left_optical", "right_optical"), [("left_optical", "right_optical", (0, 0, 0), (0, 0, 0, 1))]),
        (("left_link", "right_link"), [("left_link", "right_link", (1, 0, 0), (0, 0, 0, 1))]),
        (("left_optical", "right_link"), [("left_optical", "right_link", (1, 0, 0), (0, 0, 0, 1))]),
        (("left_link", "right_optical"), [("left_link", "right_optical", (1, 0, 0), (0, 0, 0, 1))]),
    ],
    ids=["not connected", "a placeholder", "x is forward", "x is forward in one", "x is forward in the other"],
)
def test_what_the_transforms_do_not_determine_is_estimated(frames: tuple[str, str], transforms: Any) -> None:
    bag = Recording("sqlite3")
    for (_, topic), frame in zip(TOPICS, frames, strict=True):
        bag.info(topic, START, frame=frame)
    bag.static(START, transforms)
    assert read(bag)[0].T_cam_world[1] is None


def looped() -> Recording:
    bag = pair()
    turn = (0.0, 0.0, 0.0, 1.0)
    bag.static(START, [("b", "left_optical_frame", (1, 0, 0), turn), ("left_optical_frame", "b", (1, 0, 0), turn)])
    return bag


def no_transform() -> Recording:
    bag = pair()
    bag.static(START, [("b", "left_optical_frame", (1, 0, 0), (0.0, 0.0, 0.0, 0.0))])
    return bag


def not_finite() -> Recording:
    bag = pair()
    bag.static(START, [("b", "left_optical_frame", (np.nan, 0, 0), (0.0, 0.0, 0.0, 1.0))])
    return bag


def zoomed() -> Recording:
    bag = pair()
    bag.info(TOPICS[0][1], START + 1, focal=90.0, frame="left_optical_frame")
    return bag


def without(topic: str) -> Recording:
    bag = pair()
    bag.drop(topic)
    return bag


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (looped, "'left_optical_frame' is its own ancestor"),
        (no_transform, "the transform from 'left_optical_frame' to 'b' is not rigid"),
        (not_finite, "from 'left_optical_frame' to 'b' is not rigid"),
        (zoomed, "/left/camera_info: it changes during the recording"),
        (lambda: without("/right/camera_info"), "/right/camera_info: there is no camera_info.*--cameras FILE"),
        (
            lambda: pair(model="rational_polynomial", d=(0.1,) * 8),
            r"\(distortion_model\): .* 'rational_polynomial' is not",
        ),
        (lambda: pair(model="", d=D), "distortion model '' is not supported"),
        (lambda: pair(focal=float("nan")), r"\(k\): it has values that are not finite"),
        (lambda: pair(focal=1.0), "left"),
        (lambda: pair(binning=(2, 1)), "binned or cut out"),
        (lambda: pair(binning=(1, 2)), "binned or cut out"),
        (lambda: pair(roi=(0, 0, 32, 48)), "binned or cut out"),
    ],
)
def test_cameras_that_cannot_be_used_are_refused(make: Callable[[], Recording], message: str) -> None:
    with pytest.raises(CameraError, match=message):
        read(make())


def test_drivers_that_leave_rectification_and_projection_zero_are_understood() -> None:
    bag = pair()
    for _, _, content in bag.messages:
        content.r[:] = 0.0
        content.p[:] = 0.0
    rig = read(bag)[0]
    assert rig.cameras[1].intrinsics.tolist() == [80.0, 81.0, 32.25, 23.5]
    assert rig.T_cam_world[1] is None


def test_rectification_alone_may_be_left_zero() -> None:
    bag = Recording("sqlite3")
    bag.info(TOPICS[0][1], START)
    bag.info(TOPICS[1][1], START, baseline=BASELINE)
    for _, _, content in bag.messages:
        content.r[:] = 0.0
    np.testing.assert_allclose(read(bag)[0].T_cam_world[1][:3, 3], [-BASELINE, 0.0, 0.0], atol=1e-15)


def test_an_uncalibrated_camera_is_distinguished_from_a_broken_one() -> None:
    bag = pair()
    bag.messages[0][2].k[:] = 0.0
    with pytest.raises(
        CameraError, match=r"not calibrated: its matrix is zero\. Describe the cameras with --cameras FILE"
    ):
        read(bag)


def test_the_whole_image_may_be_said_as_a_region() -> None:
    assert read(pair(roi=(0, 0, 64, 48), binning=(1, 1)))[0].cameras[0].resolution == (64, 48)
