from __future__ import annotations

import csv
import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from tests.io.making import URDF
from tests.rosbag.bags import KINDS, moving, recording
from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.simulation.simulate import Simulated


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
        (["import", "bag"], "-o, --urdf and --tip are needed; --list prints the topics"),
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
    bag = moving("sqlite3", simulated, seconds=6.0, offsets=(0.020, -0.007)).write(tmp_path / "bag")
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
