from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest
import yaml

from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.errors import OutputError, RobotError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.robot.chain import Chain, Tree
from urdfcal.session.attachments import CameraMount, attach
from urdfcal.session.knowledge import Led
from urdfcal.simulation.simulate import write_simulated

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TREES = ["tiago", "tiago_dual", "ur5_handeye"]


def moved(x: float) -> np.ndarray:
    return pin.exp6(np.array([x, 0.1, 0.2, 0.1, 0.2, 0.3])).homogeneous


def test_leds_and_cameras_are_sorted_by_what_carries_them() -> None:
    rig = read_rig(find_rig("tiago"))
    assert isinstance(rig.chain, Tree)
    assert rig.attachments.frames == ("world", "arm_tool_link", "xtion_rgb_optical_frame")
    assert rig.attachments.led.tolist() == [1, 1, 1]
    assert rig.attachments.camera.tolist() == [2]
    assert not len(rig.attachments.eye_to_hand)
    hand = read_rig(find_rig("ur5_handeye"))
    assert isinstance(hand.chain, Chain)
    assert hand.attachments.led.tolist() == [0] * 4
    assert hand.attachments.frames[hand.attachments.camera[0]] == "tool0"


def test_two_cameras_on_a_link_go_together() -> None:
    one = read_rig(find_rig("tiago"))
    camera, apart = one.rig.cameras[0], moved(-0.06)
    pair = Rig((camera, replace(camera, name="second")), (np.eye(4), apart))
    given = one.mounts[0]
    frames = attach(one.chain, [None], [], pair, {"head": given, "second": CameraMount("second", given.link)})
    assert frames.reference.tolist() == [0, 0]
    np.testing.assert_allclose(frames.T_cam_frame[1], apart @ inverse(given.T_link_camera), atol=1e-15)
    unknown = {"head": CameraMount("head", given.link), "second": CameraMount("second", given.link)}
    frames = attach(one.chain, [None], [], pair, unknown)
    assert frames.T_cam_frame == (None, None)
    np.testing.assert_array_equal(frames.T_cam_reference[1], apart)


def test_a_place_by_a_camera_on_something_else_is_refused() -> None:
    one = read_rig(find_rig("tiago"))
    pair = Rig((one.rig.cameras[0], replace(one.rig.cameras[0], name="second")), (np.eye(4), moved(-0.06)))
    with pytest.raises(SessionError, match=r"second.*T_cn_cnm1 places it by a camera"):
        attach(one.chain, [None], [], pair, {"head": one.mounts[0]})


def test_a_second_camera_on_a_link_has_no_place_of_its_own_there() -> None:
    one = read_rig(find_rig("tiago"))
    pair = Rig((one.rig.cameras[0], replace(one.rig.cameras[0], name="second")), (np.eye(4), None))
    mounts = {"head": one.mounts[0], "second": replace(one.mounts[0], camera="second")}
    with pytest.raises(SessionError, match=r"camera 'second'.*there it goes with 'head'"):
        attach(one.chain, [None], [], pair, mounts)


def test_something_must_be_on_the_robot() -> None:
    rig = read_rig(find_rig("ur5"))
    with pytest.raises(SessionError, match="no LED, target or camera is on the robot"):
        replace(rig, leds=(Led("led", np.zeros(3), link="world"),))
    with pytest.raises(RobotError, match="'forearm_link' is none of the tip links"):
        replace(rig, leds=(Led("led", np.zeros(3), link="forearm_link"),))
    with pytest.raises(SessionError, match="there is no camera 'cam9'"):
        replace(rig, mounts=(CameraMount("cam9", "tool0"),))


@pytest.mark.parametrize(
    ("mount", "message"),
    [
        ({"link": "world"}, "a camera that stands in the world is on no link"),
        ({"T_link_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rigid"),
        ({"sigma": np.ones(6)}, "sigma is given without a place"),
        ({"T_link_camera": np.eye(4), "sigma": np.zeros(6)}, "not six positive numbers"),
    ],
)
def test_mounts_that_make_no_sense_are_refused(mount: dict, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        CameraMount(**{"camera": "cam", "link": "tool0", **mount})


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", TREES)
def test_a_session_reads_back_as_it_was_written(rig: str, tmp_path: Path, simulated: Callable) -> None:
    data = simulated(rig, poses=12)
    write_simulated(tmp_path / "s", data)
    found, session = read_session(tmp_path / "s"), data.session
    assert found.chain.names == session.chain.names
    assert found.chain.parents == session.chain.parents
    assert [(led.name, led.link) for led in found.leds] == [(led.name, led.link) for led in session.leds]
    assert found.attachments.frames == session.attachments.frames
    for a, b in zip(found.mounts, session.mounts, strict=True):
        np.testing.assert_allclose(a.T_link_camera, b.T_link_camera, atol=1e-15)
        np.testing.assert_array_equal(a.sigma, b.sigma)
    np.testing.assert_array_equal(found.find(Detections).uv, session.find(Detections).uv)
    np.testing.assert_array_equal(found.q, session.q)


def test_what_a_file_cannot_say_of_a_mount_is_refused(tmp_path: Path, simulated: Callable) -> None:
    session = simulated("ur5_handeye", poses=12).session
    (mount,) = session.mounts
    uneven = replace(session, mounts=(replace(mount, sigma=1e-3 * np.arange(1.0, 7.0)),))
    with pytest.raises(OutputError, match="camera 'hand': the standard deviations of its place differ by direction"):
        write_session(tmp_path / "s", uneven)
    assert not list(tmp_path.iterdir())


def broken(folder: Path, **changes: object) -> Path:
    """A copy of the head-camera rig with keys of its file changed."""
    folder.mkdir()
    source = find_rig("tiago")
    (folder / "cameras.yaml").write_bytes((source / "cameras.yaml").read_bytes())
    content = yaml.safe_load((source / "rig.yaml").read_text())
    content.update(changes)
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"leds": {"a": {"link": "nose"}}}, r"rig\.yaml:\d+:\d+.*no link 'nose'"),
        (
            {"cameras": {"file": "cameras.yaml", "hed": {"link": "head_2_link"}}},
            r"rig\.yaml:\d+.*no camera 'hed'.*head",
        ),
        ({"cameras": {"file": "cameras.yaml", "head": {"link": "hed_2_link"}}}, r"no link 'hed_2_link'.*head_2_link"),
        ({"cameras": {"file": "cameras.yaml", "head": {"lnk": "head_2_link"}}}, "unknown key 'lnk'"),
        (
            {"cameras": {"file": "cameras.yaml", "head": {"link": "head_2_link", "position": [0, 0, 0]}}},
            "position and rpy are given together",
        ),
        ({"cameras": {"head": {"link": "head_2_link"}}}, "the key 'file' is missing"),
        (
            {"cameras": {"file": "cameras.yaml", "head": {"link": "world"}}},
            "'head'.*a camera that stands in the world is on no link",
        ),
        ({"cameras": "cameras.yaml"}, "the key 'stand' is missing"),
        ({"stand": {"position": [1, 0, 0], "look_at": [0, 0, 0]}}, "key 'stand': no camera stands: all ride"),
    ],
)
def test_what_is_wrong_in_a_file_is_told_with_its_place(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        read_rig(broken(tmp_path / "rig", **changes))
