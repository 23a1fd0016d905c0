from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from tests.io.broken import append, swap
from tests.io.making import POSES, measured, write_points, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.folder import read_points, read_rig, read_session
from urdfcal.session.knowledge import Estimate

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_measured = pytest.mark.skipif(not MEASURED.is_dir(), reason=f"the measured sessions are not at {MEASURED}")


def test_the_folder_and_its_yaml_are_the_same_session(tmp_path: Path) -> None:
    write_valid(tmp_path)
    for path in (tmp_path, tmp_path / "session.yaml", str(tmp_path)):
        session = read_session(path)
        assert session.folder == tmp_path
        assert len(session.poses) == POSES


def test_everything_is_where_it_belongs(tmp_path: Path) -> None:
    session = read_session(write_valid(tmp_path))
    readings, uv = measured()
    assert np.array_equal(session.readings, readings)
    assert session.rig is not None
    assert session.rig.names == ("left", "right")
    assert session.led_names == ("red", "blue")
    table = session.find(Detections)
    assert table is not None
    assert np.array_equal(table.uv, uv[table.pose, table.camera, table.led])
    assert len(table) == POSES * 4
    assert set(table.sigma) == {0.1}
    assert session.leds[0].sigma == 0.005
    assert session.urdf is not None
    assert session.urdf.path == tmp_path / "arm.urdf"


def test_the_base_is_the_root_unless_named(tmp_path: Path) -> None:
    write_valid(tmp_path)
    swap("session.yaml", "  base_link: base\n", "")(tmp_path)
    assert read_session(tmp_path).chain.base_link == "base"


def test_every_input_is_hashed(tmp_path: Path) -> None:
    session = read_session(write_valid(tmp_path))
    names = {"session.yaml", "arm.urdf", "cameras.yaml", "joints.csv", "detections.csv"}
    assert session.sha256 == {name: hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() for name in names}


def test_files_may_lie_elsewhere(tmp_path: Path) -> None:
    write_valid(tmp_path / "monday")
    (tmp_path / "monday" / "cameras.yaml").rename(tmp_path / "cameras.yaml")
    swap("session.yaml", "cameras.yaml", "../cameras.yaml")(tmp_path / "monday")
    session = read_session(tmp_path / "monday")
    assert "../cameras.yaml" in session.sha256


def test_a_robot_from_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_valid(tmp_path / "session")
    (tmp_path / "ws" / "my_arm").mkdir(parents=True)
    (tmp_path / "session" / "arm.urdf").rename(tmp_path / "ws" / "my_arm" / "arm.urdf")
    swap("session.yaml", "arm.urdf", "package://my_arm/arm.urdf")(tmp_path / "session")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ws"))
    session = read_session(tmp_path / "session")
    assert session.urdf_reference == "package://my_arm/arm.urdf"
    assert session.urdf_reference in session.sha256


def test_a_folder_of_another_kind_says_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="there is no such folder"):
        read_session(tmp_path / "nowhere")
    with pytest.raises(SessionError, match=r"Name a folder with a session.yaml"):
        read_session(tmp_path)
    (tmp_path / "rig.yaml").touch()
    with pytest.raises(SessionError, match="It is a rig"):
        read_session(tmp_path)
    write_valid(tmp_path / "session")
    with pytest.raises(SessionError, match="It is a session, not a rig"):
        read_rig(tmp_path / "session")


def rig(folder: Path) -> Path:
    write_valid(folder)
    (folder / "session.yaml").rename(folder / "rig.yaml")
    swap("rig.yaml", "joints: joints.csv\ndetections: detections.csv\n", "")(folder)
    append("rig.yaml", "stand: {position: [2.4, 0.3, 0.9], look_at: [0.6, 0, 0.5]}\n")(folder)
    return folder


def test_a_rig_is_a_session_without_measurements(tmp_path: Path) -> None:
    found = read_rig(rig(tmp_path))
    assert found.stand.position.tolist() == [2.4, 0.3, 0.9]
    assert found.stand.look_at.tolist() == [0.6, 0.0, 0.5]
    assert found.rig is not None
    assert found.rig.names == ("left", "right")
    assert found.chain.actuated == ("waist", "shoulder", "slide", "roll")
    assert found.folder == tmp_path


def test_a_rig_is_refused_with_its_place(tmp_path: Path) -> None:
    rig(tmp_path)
    swap("rig.yaml", "look_at", "lookat")(tmp_path)
    with pytest.raises(SessionError, match=r"rig.yaml:10:36, key 'stand.lookat': unknown key 'lookat'"):
        read_rig(tmp_path)


def test_points_of_another_instrument(tmp_path: Path) -> None:
    session = read_session(write_points(tmp_path))
    path = tmp_path / "laser.csv"
    path.write_text("pose,led,x,y,z\n5,reflector,1,2,3\n2,reflector,4,5,6\n")
    points, leds = read_points(path, session)
    assert [led.name for led in leds] == ["reflector"]
    assert leds[0].position is None
    assert points.pose.tolist() == [2, 5]
    assert points.xyz.tolist() == [[4, 5, 6], [1, 2, 3]]
    assert points.sigma.tolist() == [session.noise.point] * 2
    path.write_text("pose,led,x,y,z\n9,reflector,1,2,3\n")
    with pytest.raises(SessionError, match=r"laser.csv:2:1: there is no pose '9'"):
        read_points(path, session)


@needs_measured
def test_the_measured_session_with_cameras() -> None:
    session = read_session(MEASURED / "motoman_right")
    assert session.estimate == Estimate()
    assert (len(session.poses), len(session.leds)) == (216, 6)
    assert session.find(Detections) is not None
    assert len(session.find(Detections)) == 1314
    assert session.rig is not None
    assert session.rig.T_cam_world[1] is None
    still, turned = session.warnings
    assert "joint 'E' never moves" in still
    assert "width and height" in turned
    points, (led,) = read_points(MEASURED / "motoman_right" / "check_points.csv", session)
    assert len(points) == 212
    assert led.name == "reflector"


@needs_measured
def test_the_measured_session_with_points() -> None:
    session = read_session(MEASURED / "irb120_liaowu")
    assert session.warnings == ()
    assert session.find(Points) is not None
    assert session.find(Points).xyz.shape == (108, 3)
    assert set(session.find(Points).sigma) == {1e-4}
