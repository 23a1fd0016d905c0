from __future__ import annotations

import csv
import hashlib
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pytest
import yaml
import yourdfpy

from urdfcal.cli import run
from urdfcal.cli.workspace import along
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.result.calibration import Calibration
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture
def result(calibrated: Callable[[str], Path]) -> Path:
    return calibrated("elbow3r") / "result"


@pytest.fixture
def mujoco_model(calibrated: Callable[[str], Path], tmp_path: Path) -> Path:
    """MuJoCo's own conversion of the drawn robot."""
    (tmp_path / "model").mkdir()
    path = tmp_path / "model" / "elbow3r.xml"
    path.write_text(mujoco.MjSpec.from_file(str(calibrated("elbow3r") / "session" / "elbow3r.urdf")).to_xml())
    return path


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["ros-kinematics"], ["kinematics.yaml"]),
        (["ros-kinematics", "--link-keys"], ["kinematics.yaml"]),
        (["ros-static-tf"], ["static_transforms.launch.xml"]),
        (["ros-static-tf", "--add-frames"], ["elbow3r_calibrated_frames.urdf"]),
        (
            ["offsets"],
            ["joint_offsets.csv", "joint_offsets.ros2_control.xml", "elbow3r_calibrated_without_offsets.urdf"],
        ),
        (["dh-csv"], ["dh.csv", "dh_frames.csv"]),
        (["xacro-patch"], ["origins.yaml"]),
    ],
)
def test_files_are_written_and_named(
    arguments: list[str], names: list[str], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    before = {path.name: path.read_bytes() for path in result.iterdir()}
    assert run(["export", str(result), "--to", *arguments, "-o", str(out)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(out / name) for name in names]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    assert {path.name: path.read_bytes() for path in result.iterdir()} == before
    for path in out.glob("*.urdf"):
        assert set(Urdf.read(path).joints) >= set(Calibration.load(result).chain.names)
        assert yourdfpy.URDF.load(str(path), load_meshes=False).validate()


def test_kinematics_name_their_calibration_and_links(result: Path, tmp_path: Path) -> None:
    assert run(["export", str(result), "--to", "ros-kinematics", "--link-keys", "-o", str(tmp_path)]) == 0
    kinematics = yaml.safe_load((tmp_path / "kinematics.yaml").read_text())["kinematics"]
    digest = hashlib.sha256((result / "calibration.json").read_bytes()).hexdigest()
    assert kinematics.pop("hash") == f"urdfcal_{digest}"
    robot = yourdfpy.URDF.load(str(result / "elbow3r_calibrated.urdf"), load_meshes=False)
    for joint in robot.actuated_joints:
        numbers = kinematics.pop(joint.child.removesuffix("_link"))
        np.testing.assert_allclose(joint.origin[:3, 3], [numbers[key] for key in "xyz"], atol=1e-15)
    assert not kinematics


def test_a_mujoco_model_is_written_beside_the_one_given(
    result: Path, mujoco_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(result), "--to", "mjcf", "--model", str(mujoco_model)]) == 0
    written = mujoco_model.with_name("elbow3r_calibrated.xml")
    assert capsys.readouterr().out == f"{written}\n"
    assert written.read_text() != mujoco_model.read_text()
    assert mujoco.MjModel.from_xml_path(str(written)).njnt == 3
    assert run(["export", str(result), "--to", "mjcf", "--model", str(written)]) == 2
    assert "as calibrated already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "nonsense"], "'nonsense' is not one of"),
        (["--to", "mjcf"], "--to mjcf needs --model FILE"),
        (["--to", "mjcf", "--model", "nowhere.xml"], "nowhere.xml: cannot be read"),
        (["--to", "dh-csv", "--add-frames"], "--add-frames goes with --to ros-static-tf"),
        (["--to", "dh-csv", "--link-keys"], "--link-keys goes with --to ros-kinematics"),
        (["--to", "offsets", "--model", "a.xml"], "--model goes with --to mjcf"),
    ],
)
def test_wrong_calls_say_what_is_wrong(
    arguments: list[str], message: str, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(result), *arguments, "-o", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_calibration_without_its_urdf_says_what_is_missing(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "calibration.json").write_bytes((result / "calibration.json").read_bytes())
    assert run(["export", str(tmp_path), "--to", "offsets"]) == 2
    assert "the corrected URDF is not beside calibration.json" in capsys.readouterr().err
    assert run(["export", str(tmp_path / "calibration.json"), "--to", "dh-csv"]) == 0
    assert (tmp_path / "dh.csv").exists()


def test_without_mujoco_it_says_how_to_install_it(
    result: Path, mujoco_model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert run(["export", str(result), "--to", "mjcf", "--model", str(mujoco_model)]) == 2
    assert "pip install 'urdfcal[mjcf]'" in capsys.readouterr().err


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a session of an arm that sags, and its result."""
    folder = tmp_path_factory.mktemp("bent")
    rig = folder / "rig"
    shutil.copytree(find_rig("ur5"), rig)
    with (rig / "rig.yaml").open("a") as file:
        file.write("errors: {compliance: 5.0e-5}\n")
    assert run(["simulate", str(rig), "-o", str(folder / "session"), "--poses", "40"]) == 0
    assert run(["calibrate", str(folder / "session"), "-o", str(folder / "result"), "-q"]) == 0
    return folder


@pytest.mark.parametrize("workspace", ["", "0.2:0.6,-0.3:0.3,0.1:0.5", "path.csv", "session"])
def test_the_urdf_of_an_arm_that_bends_is_the_nearest_for_a_workspace(
    workspace: str, bent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = Calibration.load(bent / "result")
    joints = bent / "session" / "joints.csv"
    (bent / "path.csv").write_text(joints.read_text())
    named = str(bent / workspace) if (bent / workspace).exists() else workspace
    arguments = ["--workspace", named] if workspace else []
    assert run(["export", str(bent / "result"), "--to", "urdf", "-o", str(tmp_path), *arguments]) == 0
    path, said = capsys.readouterr().out.splitlines()
    assert path == str(tmp_path / "ur5_robot_calibrated_region.urdf")
    found = re.search(r"in (\d+) configurations of (.*) its tip\s+is ([\d.]+) mm rms off.*URDF's ([\d.]+) mm rms", said)
    count, what, after, before = found.groups()
    kind = "the moves of " if "csv" in named else "" if "ses" in named else "the box "
    assert what == (f"{kind}{named}" if workspace else "the measured domain")
    assert float(after) < 0.9 * float(before)
    robots = [
        yourdfpy.URDF.load(str(of), load_meshes=False)
        for of in (Path(path), bent / "result" / "ur5_robot_calibrated.urdf")
    ]
    assert [joint.name for joint in robots[0].robot.joints] == [joint.name for joint in robots[1].robot.joints]
    if named.endswith((".csv", "session")):  # the configurations that the figures are of
        with joints.open() as file:
            rows = list(csv.DictReader(file))
        q = np.array([[float(row[name]) for name in calibration.chain.actuated] for row in rows])
        q = along(q) if named.endswith(".csv") else q
        assert len(q) == int(count)
        true = calibration.forward(q)[:, :3, 3]
        for robot, figure in zip(robots, (after, before), strict=True):
            tips = []
            for values in q:
                robot.update_cfg(dict(zip(calibration.chain.actuated, values, strict=True)))
                tips.append(robot.get_transform("tool0", "base_link")[:3, 3])
            off = 1e3 * np.sqrt(np.mean(np.sum((np.array(tips) - true) ** 2, axis=1)))
            assert off == pytest.approx(float(figure), rel=0.06)  # printed with two digits


@pytest.mark.parametrize(
    ("workspace", "code", "message"),
    [
        ("nonsense", 2, "is no box, no file and no folder. Write a box as x0:x1,y0:y1,z0:z1"),
        ("1:0,0:1,0:1", 2, "is no box, no file and no folder"),
        ("5:6,0:1,0:1", 2, "Name a box that the measured poses reach"),
        ("nowhere.csv", 2, "nowhere.csv"),
    ],
)
def test_a_workspace_that_is_none_is_refused(
    workspace: str, code: int, message: str, bent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["export", str(bent / "result"), "--to", "urdf", "-o", str(out), "--workspace", workspace]) == code
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_a_rigid_arm_s_urdf_is_the_corrected_one(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(result), "--to", "urdf", "-o", str(tmp_path)]) == 0
    assert "this arm is rigid: it is the corrected URDF" in capsys.readouterr().out
    same = (tmp_path / "elbow3r_calibrated_region.urdf").read_bytes()
    assert same == (result / "elbow3r_calibrated.urdf").read_bytes()
    assert run(["export", str(result), "--to", "dh-csv", "--workspace", "0:1,0:1,0:1"]) == 2
    assert "--workspace goes with --to urdf" in capsys.readouterr().err


def test_a_mujoco_arm_s_servos_yield_as_its_joints_do(
    bent: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = re.sub(r"<(visual|collision)\b.*?</\1>", "", read_rig(find_rig("ur5")).urdf.text, flags=re.DOTALL)
    specification = mujoco.MjSpec.from_string(urdf)
    specification.compile()
    joints = Calibration.load(bent / "result").chain.actuated
    servos = "".join(f'<position joint="{joint}" kp="100"/>' for joint in joints)
    model = tmp_path / "arm.xml"
    model.write_text(specification.to_xml().replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>"))
    assert run(["export", str(bent / "result"), "--to", "mjcf", "--model", str(model), "--servos"]) == 0
    path, said = capsys.readouterr().out.splitlines()
    assert re.search(r"- servos of \d joints yield to gravity as they do, \w+_joint the most \(\d.*N m a radian", said)
    gains = mujoco.MjModel.from_xml_path(path).actuator_gainprm[:, 0]
    assert gains[1] == pytest.approx(1.0 / 5e-5, rel=0.1)
    assert gains[5] == 100.0  # it carries nothing
    assert run(["export", str(bent / "result"), "--to", "dh-csv", "--servos"]) == 2
    assert "--servos goes with --to mjcf" in capsys.readouterr().err
