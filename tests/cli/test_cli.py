from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from tests.io.broken import BROKEN, Broken
from tests.io.making import write_valid
from urdfcal.cameras.io.formats import read_kalibr, write_kalibr
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.cli import run
from urdfcal.result.calibration import Calibration

if TYPE_CHECKING:
    from pathlib import Path

UR5 = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"


def tips(urdf: Path, q: np.ndarray, base: str, tip: str) -> np.ndarray:
    """By Pinocchio alone."""
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()
    result = []
    for q_k in q:
        pin.framesForwardKinematics(model, data, q_k)
        T = data.oMf[model.getFrameId(base)].inverse() * data.oMf[model.getFrameId(tip)]
        result.append(T.translation)
    return np.array(result)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration, by the real command in a process of its own."""
    folder = tmp_path_factory.mktemp("demo")
    ended = subprocess.run(
        [sys.executable, "-m", "urdfcal", "demo", "elbow3r", "-o", "d"], cwd=folder, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert "mm rms" in ended.stdout
    return folder / "d"


def test_demo_leaves_urdf_json_and_recording(demo: Path) -> None:
    names = {path.name for path in (demo / "result").iterdir()}
    assert names == {"elbow3r_calibrated.urdf", "calibration.json", "calibration.rrd", "report.html"}


def test_demo_brings_the_arm_nearer_to_the_truth(demo: Path) -> None:
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 3))
    drawn, truth = demo / "session" / "elbow3r.urdf", demo / "session" / "truth.urdf"
    true = tips(truth, q, "base_link", "tool0")
    before, after = (
        np.linalg.norm(tips(path, q, "base_link", "tool0") - true, axis=1).mean()
        for path in (drawn, demo / "result" / "elbow3r_calibrated.urdf")
    )
    assert after < 0.25 * before


def test_the_corrected_urdf_reads_alike_with_yourdfpy(demo: Path) -> None:
    path = demo / "result" / "elbow3r_calibrated.urdf"
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    robot = yourdfpy.URDF.load(io.BytesIO(path.read_bytes()), load_meshes=False)
    for q_k, expected in zip(q, tips(path, q, "base_link", "tool0"), strict=True):
        robot.update_cfg(q_k)
        np.testing.assert_allclose(robot.get_transform("tool0", "base_link")[:3, 3], expected, atol=1e-12)


def test_json_is_what_the_urdf_says(demo: Path) -> None:
    result = json.loads((demo / "result" / "calibration.json").read_text())
    robot = yourdfpy.URDF.load(str(demo / "result" / "elbow3r_calibrated.urdf"), load_meshes=False)
    for name, placement in result["placements"].items():
        np.testing.assert_allclose(robot.joint_map[name].origin[:3, 3], placement["xyz"], atol=1e-15)


def test_two_calibrations_give_the_same_bytes(demo: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run(["calibrate", str(demo / "session"), "-o", str(tmp_path / name)]) == 0
    for file in ("calibration.json", "elbow3r_calibrated.urdf"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_calibrate_never_reads_the_truth(demo: Path, tmp_path: Path) -> None:
    session = tmp_path / "session"
    session.mkdir()
    for path in (demo / "session").iterdir():
        if not path.name.startswith("truth"):
            (session / path.name).write_bytes(path.read_bytes())
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "calibration.json").read_bytes() == (demo / "result" / "calibration.json").read_bytes()


def test_points_that_cameras_triangulate_have_a_report_too(demo: Path, tmp_path: Path) -> None:
    assert run(["calibrate", str(demo / "session"), "--method", "points", "-o", str(tmp_path / "out")]) == 0
    assert "stands in the world, the frame that was measured in" in (tmp_path / "out" / "report.html").read_text()


def test_cameras_with_standard_deviations_are_refined_within_them(demo: Path, tmp_path: Path) -> None:
    session = tmp_path / "session"
    shutil.copytree(demo / "session", session)
    truth = read_kalibr(session / "cameras.yaml")
    # The second camera 2 mm and 2 mrad off, and its calibration says so.
    T = pin.exp6(pin.Motion(np.full(6, 2e-3))).homogeneous @ truth.T_cam_world[1]
    lens = np.array([0.5, 0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-5, 1e-5])
    sigmas = CameraSigma(lens), CameraSigma(lens, np.full(6, 2e-3))
    write_kalibr(session / "cameras.yaml", Rig(truth.cameras, (np.eye(4), T), sigmas))
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "calibration.json").read_text())
    chosen = next(model["model"] for model in result["models"] if model["chosen"])
    assert chosen == "DH rows, refined intrinsics, refined camera poses"
    second = result["cameras"][truth.names[1]]
    turned = np.array(second["T_cam_world"])[:3, :3] @ truth.T_cam_world[1][:3, :3].T
    assert np.arccos((np.trace(turned) - 1.0) / 2.0) < 1e-3
    refined = np.concatenate([second["sigma"][key] for key in ("intrinsics", "distortion", "T_cam_world")])
    assert (refined < [*lens, *[2e-3] * 6]).all()
    assert set(result["cameras"][truth.names[0]]["sigma"]) == {"intrinsics", "distortion"}
    assert len(Calibration.load(tmp_path / "out").chain.joints) == 3
    # What is said to be exact is held, and then it is refuted.
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text + "estimate: {intrinsics: fixed, extrinsics: fixed}\n")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "fixed")]) == 1
    assert [path.name for path in (tmp_path / "fixed").rglob("*")] == ["refused", "report.html"]


def test_evaluate_two_urdfs(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(demo / "result" / "elbow3r_calibrated.urdf"), str(demo / "session" / "truth.urdf")]
    assert run(["evaluate", *paths, "--tip", "tool0", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert 0.0 < result["position_mm"]["rms"] < 0.5
    assert result["position_mm"]["rms"] <= result["position_unaligned_mm"]["rms"] * 1.0001
    assert run(["evaluate", paths[0], paths[0], "--tip", "tool0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["position_mm"]["max"] < 1e-9


def test_evaluate_a_session(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared / "irb120_liaowu"
    assert run(["evaluate", str(folder / "irb120.urdf"), str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_mm"]["rms"] == pytest.approx(5.33, abs=0.01)


def test_evaluate_a_trackers_check_points(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared / "motoman_right"
    points = str(folder / "check_points.csv")
    assert run(["evaluate", str(folder / "motoman_right.urdf"), str(folder), "--points", points, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_mm"]["rms"] == pytest.approx(0.246, abs=0.001)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_dh_prints_a_table_and_json(convention: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["dh", UR5, "--tip", "tool0", "--base", "base_link", "--convention", convention]
    assert run([*arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["convention"] == convention
    assert next(row["joint"] for row in result["rows"]) == "shoulder_pan_joint"
    assert run(arguments) == 0
    assert "425.000 " in capsys.readouterr().out


def test_dh_leaves_names_whole_in_80_columns_which_a_pipe_has_if_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    tiago = "package://example-robot-data/robots/tiago_description/robots/tiago_dual.urdf"
    assert run(["dh", tiago, "--tip", "arm_left_7_link"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == 80
    assert [line.split()[0] for line in lines[4:6]] == ["torso_lift_joint", "arm_left_1_joint"]
    for cut in ("0", "40"):
        monkeypatch.setenv("COLUMNS", cut)
        assert run(["dh", tiago, "--tip", "arm_left_7_link"]) == 0
        assert "-686.500" in capsys.readouterr().out


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.name)
def test_broken_input_gives_its_message_and_nothing_else(
    broken: Broken, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, out = tmp_path / "session", tmp_path / "out"
    session.mkdir()
    write_valid(session)
    broken.edit(session)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert run(["calibrate", str(session), "-o", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("urdfcal: ")
    assert "Traceback" not in captured.err
    assert not out.exists()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_result_of_an_earlier_run_survives_bad_input(tmp_path: Path) -> None:
    session, out = tmp_path / "session", tmp_path / "out"
    session.mkdir()
    write_valid(session)
    out.mkdir()
    (out / "calibration.json").write_text("precious")
    (session / "joints.csv").write_text("pose\n")
    assert run(["calibrate", str(session), "-o", str(out)]) == 2
    assert [path.name for path in out.iterdir()] == ["calibration.json"]
    assert (out / "calibration.json").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibrate", "nowhere", "-o", "out"], "nowhere"),
        (["simulate", "nosuch", "-o", "out"], "elbow3r"),
        (["dh", "nowhere.urdf", "--tip", "x"], "no such file"),
        (["dh", UR5, "--tip", "nosuch"], "no link 'nosuch'"),
        (["evaluate", UR5, UR5], "--tip"),
        (["view", "nowhere"], "no recording"),
        (["nonsense"], "No such command"),
        (["simulate", "ur5"], "Missing option"),
    ],
)
def test_wrong_calls_say_what_is_wrong(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert "Traceback" not in captured.err
    assert not list(tmp_path.iterdir())


def test_debug_shows_the_traceback() -> None:
    with pytest.raises(Exception, match="there is no"):
        run(["dh", "nowhere.urdf", "--tip", "x", "--debug"])


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from urdfcal.cli import run; run(['--help']); sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_import_loads_nothing_heavy() -> None:
    code = "import sys, urdfcal; sys.exit(any(m in sys.modules for m in ('cv2', 'rerun', 'yaml', 'pydantic')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
