from __future__ import annotations

import csv
import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest
import yaml

from tests.io.making import URDF
from tests.rosbag.bags import KINDS, START, moving, recording, stopping
from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.simulation.truth import Simulated


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "arm.urdf").write_text(URDF)
    recording("mcap", 0.4).write(tmp_path / "bag")
    monkeypatch.chdir(tmp_path)
    return tmp_path


USUAL = ["import", "bag", "-o", "s", "--urdf", "arm.urdf", "--tip", "tip"]


@pytest.mark.parametrize("kind", KINDS)
def test_one_command_makes_a_session(folder: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(kind, 0.4).write(folder / kind)
    arguments = ["import", path.name, "-o", "s", "--urdf", "arm.urdf", "--tip", "tip", "--led", "red=0.03,0.02,-0.05"]
    assert run(arguments) == 0
    said = capsys.readouterr().out
    assert "/joint_states: 50 joint states at 125.0 Hz" in said
    assert "left: /left/image_raw, 12 images at 30.0 Hz, 64 x 48 px" in said
    assert "time 0 is 1700000123.987654321 s" in said
    assert "- the pose of right is from /right/camera_info" in said
    assert said.endswith("\ns\n")
    content = yaml.safe_load((folder / "s" / "session.yaml").read_text())
    assert content["leds"] == {"red": {"position": [0.03, 0.02, -0.05]}}
    assert sum(1 for _ in (folder / "s" / "images").rglob("*.png")) == 24


def test_topics_may_be_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    named = ["--joints", "/joint_states", "--camera", "b=/right/image_raw", "--camera"]
    assert run([*USUAL, *named, "a=/left/image_raw,/left/camera_info"]) == 0
    assert "the pose of a" in capsys.readouterr().out
    with (folder / "s" / "frames.csv").open() as file:
        assert [row["camera"] for row in csv.DictReader(file)] == ["b"] * 12 + ["a"] * 12


def test_cameras_may_be_described_by_a_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(USUAL) == 0
    assert "the pose of right" in capsys.readouterr().out
    assert run([*USUAL, "-o", "again", "--cameras", "s/cameras.yaml"]) == 0
    assert "the pose of right" not in capsys.readouterr().out
    for name in ("cameras.yaml", "frames.csv", "joints.csv", "session.yaml"):
        assert (folder / "again" / name).read_bytes() == (folder / "s" / name).read_bytes()


def test_list_shows_what_there_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["import", "bag", "--list"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["/joint_states", "sensor_msgs/msg/JointState", "50", "125.0"] in rows
    assert sorted(path.name for path in folder.iterdir()) == ["arm.urdf", "bag"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import", "bag"], "-o is needed; --list prints the topics"),
        (
            ["import", "bag", "-o", "s"],
            "no topic robot_description has a robot. Name the robot with --urdf ROBOT.urdf.",
        ),
        (USUAL[:-2], "--tip is needed; the links at the ends of arm are finger"),
        (["import", "nowhere", "--list"], "nowhere: there is no such bag"),
        (["import", "arm.urdf", "--list"], "bags do not end in '.urdf'"),
        ([*USUAL, "--tip", "nosuch"], "there is no link 'nosuch'"),
        ([*USUAL, "--urdf", "nowhere.urdf"], "nowhere.urdf"),
        ([*USUAL, "--joints", "/joints"], "there is no topic '/joints'. Did you mean '/joint_states'?"),
        ([*USUAL, "--camera", "left"], "'left' is not NAME=TOPIC"),
        ([*USUAL, "--camera", "../left=/left/image_raw"], "'../left' cannot be that of a folder"),
        ([*USUAL, "--camera", "a=/left/image_raw", "--camera", "a=/right/image_raw"], "two cameras have the same name"),
        ([*USUAL, "--led", "red=1,2"], "'1,2' is not three numbers"),
        ([*USUAL, "--led", "red=1,2,nan"], "LED 'red': position has values that are not finite"),
        ([*USUAL, "--led", "=1,2,3"], "an empty name"),
        ([*USUAL, "--cameras", "nowhere.yaml"], "nowhere.yaml"),
        ([*USUAL, "-o", "no/such/folder"], "no/such/folder: cannot write here"),
        ([*USUAL, "-o", "bag"], "bag: there is something already"),
    ],
)
def test_wrong_calls_say_what_is_wrong_and_leave_nothing(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.rglob("*"))
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert "Traceback" not in captured.err
    assert sorted(folder.rglob("*")) == before


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    rig = read_rig(find_rig("elbow3r"))
    assert rig.rig is not None
    # A quarter of the resolution: a sixteenth of the time.
    cameras = [replace(one, resolution=(320, 256), intrinsics=one.intrinsics / 4.0) for one in rig.rig.cameras]
    return simulate(replace(rig, rig=Rig(tuple(cameras), rig.rig.T_cam_world)), poses=8, seed=3)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_bag_of_a_moving_arm_calibrates_it(
    tmp_path: Path, simulated: Simulated, capsys: pytest.CaptureFixture[str]
) -> None:
    """Joints at 125 Hz, two cameras at 30 Hz whose clocks are 20 ms behind and 7 ms ahead: import, then calibrate."""
    session = simulated.session
    assert session.urdf is not None
    (tmp_path / "elbow3r.urdf").write_bytes(session.urdf.data)
    (tmp_path / "truth.urdf").write_bytes(simulated.truth.urdf)
    bag = moving("sqlite3", simulated, seconds=2.5, offsets=(0.020, -0.007)).write(tmp_path / "bag")
    drawn, links = str(tmp_path / "elbow3r.urdf"), ["--tip", "tool0", "--base", "base_link"]
    assert run(["import", str(bag), "-o", str(tmp_path / "s"), "--urdf", drawn, *links]) == 0
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "out")]) == 0
    cameras = json.loads((tmp_path / "out" / "calibration.json").read_text())["cameras"]
    offsets = [cameras[name]["time_offset"]["value"] for name in ("cam0", "cam1")]
    np.testing.assert_allclose(offsets, [0.020, -0.007], atol=2e-4)
    capsys.readouterr()
    errors = []
    for urdf in (drawn, str(tmp_path / "out" / "elbow3r_calibrated.urdf")):
        assert run(["evaluate", urdf, str(tmp_path / "truth.urdf"), *links, "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["position_mm"]["rms"])
    assert np.isfinite(errors).all()
    assert errors[1] < 0.1 * errors[0]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory, simulated: Simulated) -> Path:
    """The bag of an arm that stopped in each pose, which describes the robot and where the second camera stands."""
    bag, folder = stopping("mcap", simulated), tmp_path_factory.mktemp("stopped")
    assert simulated.session.urdf is not None
    bag.text("/robot_description", simulated.session.urdf.text)
    T = pin.SE3(np.linalg.inv(np.array(simulated.session.rig.T_cam_world[1])))
    first, second = (f"{name}_optical_frame" for name in simulated.session.rig.names)
    bag.static(START, [(first, second, T.translation, pin.Quaternion(T.rotation).coeffs())])
    (folder / "truth.urdf").write_bytes(simulated.truth.urdf)
    return bag.write(folder / "bag").parent


def test_the_bag_of_an_arm_that_stopped_gives_poses_and_calibrates_it(
    stopped: Path, simulated: Simulated, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "s"
    links = ["--tip", "tool0", "--base", "base_link"]
    assert run(["import", str(stopped / "bag"), "-o", str(session), *links, "--stills"]) == 0
    said = capsys.readouterr().out
    assert "the arm stood still 8 times; one image a camera and pose" in said
    assert "- the joints were read to " in said
    content = yaml.safe_load((session / "session.yaml").read_text())
    assert "frames" not in content
    assert 0.0 < content["noise"]["joint"] < 2e-5
    urdf = session / content["robot"]["urdf"]
    assert urdf.read_text() == simulated.session.urdf.text  # type: ignore[union-attr]
    rows = rows_of(session / "joints.csv")
    assert [row["pose"] for row in rows] == [f"{k:03d}" for k in range(1, 9)]
    read = np.array([[float(row[name]) for name in simulated.session.chain.actuated] for row in rows])
    np.testing.assert_allclose(read, simulated.session.chain.readings(simulated.truth.q), atol=2e-5)
    images = sorted(path.relative_to(session / "images").as_posix() for path in session.rglob("*.png"))
    assert images == [f"{camera}/{k:03d}.png" for camera in ("cam0", "cam1") for k in range(1, 9)]
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    errors = []
    for of in (urdf, tmp_path / "out" / "elbow3r_calibrated.urdf"):
        assert run(["evaluate", str(of), str(stopped / "truth.urdf"), *links, "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["position_mm"]["rms"])
    assert errors[1] < 0.2 * errors[0]


def test_a_bag_without_stops_has_no_poses(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*USUAL, "--stills"]) == 2
    assert "0 times: these are too few poses. Leave --stills out" in capsys.readouterr().err
    assert not (folder / "s").exists()


def test_a_camera_on_a_link_and_a_board_are_taken_from_the_bag_and_a_file(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = recording("mcap", 0.4)
    bag.static(
        START,
        [
            ("wrist", "left_mount", (0.1, 0, 0), (0, 0, 0, 1)),
            ("left_mount", "left_optical_frame", (0, 0, 0.02), (1, 0, 0, 0)),
        ],
    )
    bag.static(START, [("base", "right_optical_frame", (1.0, 0, 0), (0, 0, 0, 1))])
    bag.write(folder / "riding")
    (folder / "targets.yaml").write_text(
        "targets:\n  board: {kind: chessboard, size: [7, 5], square: 0.03, link: world}\n"
    )
    arguments = ["import", "riding", "-o", "s", "--urdf", "arm.urdf", "--tip", "tip", "--targets", "targets.yaml"]
    assert run(arguments) == 0
    assert "- left is on wrist, by /tf_static: where is estimated" in capsys.readouterr().out
    content = yaml.safe_load((folder / "s" / "session.yaml").read_text())
    assert "leds" not in content
    assert content["targets"]["board"] == {"kind": "chessboard", "size": [7, 5], "square": 0.03, "link": "world"}
    left = content["cameras"]["left"]
    assert left["link"] == "wrist"
    np.testing.assert_allclose(left["position"], [0.1, 0.0, 0.02])
    np.testing.assert_allclose(np.abs(left["rpy"]), [np.pi, 0.0, 0.0], atol=1e-12)
    assert "right" not in content["cameras"]
    assert run([*arguments, "-o", "t", "--led", "red"]) == 0
    assert yaml.safe_load((folder / "t" / "session.yaml").read_text())["leds"] == {"red": {}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "targets: {board: {kind: chess}}",
            "targets.yaml:1:11, key 'targets.board': the key 'kind' is missing, or none",
        ),
        ("targets: {board: {kind: chessboard, size: [7, 5], square: -1}}", "-1 is not greater than 0"),
        ("boards: {}", "unknown key 'boards'"),
    ],
)
def test_targets_that_are_none_are_named_with_their_place(
    folder: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "targets.yaml").write_text(text)
    assert run([*USUAL, "--targets", "targets.yaml"]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "s").exists()


def test_a_camera_that_an_unread_joint_moves_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = recording("mcap", 0.4)
    bag.static(START, [("finger", "left_optical_frame", (0.1, 0, 0), (0, 0, 0, 1))])
    bag.write(folder / "grasping")
    assert run(["import", "grasping", *USUAL[2:]]) == 0
    assert "- left is on finger, which grip moves: it is taken to stand still" in capsys.readouterr().out
    assert yaml.safe_load((folder / "s" / "session.yaml").read_text())["cameras"] == "cameras.yaml"


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({"/a/robot_description": URDF, "/b/robot_description": URDF}, "2 topics have a robot: /a/robot_description"),
        ({"/robot_description": "<robot"}, "/robot_description"),
    ],
)
def test_a_robot_that_the_bag_does_not_tell_is_asked_for(
    folder: Path, texts: dict[str, str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = recording("mcap", 0.4)
    for topic, text in texts.items():
        bag.text(topic, text)
    bag.write(folder / "told")
    assert run(["import", "told", "-o", "s", "--tip", "tip"]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "s").exists()
