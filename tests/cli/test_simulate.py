"""``urdfcal simulate`` and ``urdfcal demo``: which options go together, and what is said."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from urdfcal.cli import run
from urdfcal.errors import SessionError
from urdfcal.io import folder as folders
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.trajectory import Trajectory
from urdfcal.simulation import simulate as simulation

if TYPE_CHECKING:
    from urdfcal.session.rig_description import RigDescription

SHORT = ["simulate", "elbow3r", "-o", "s", "--poses", "3", "--seed", "1"]


@pytest.fixture(autouse=True)
def _inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--distractors"], "--distractors goes with --images"),
        (["--poses", "80", "--at", "plan.csv"], "--poses does not go with --at"),
        (["--images", "--pixel", "0.1"], "--pixel and --outliers do not go with --images"),
        (["--images", "--outliers", "0.1"], "--pixel and --outliers do not go with --images"),
        (["--video", "--trajectory", "--pixel", "0"], "--pixel and --outliers do not go with --images"),
        (["--video"], "--video goes with --trajectory"),
        (["--video", "--images", "--trajectory"], "--images and --video: choose one"),
        (["--time-offset", "0.1"], "--time-offset goes with --trajectory"),
        (["--trajectory", "--time-offset", "0.1"], "1 time offsets for 2 cameras"),
        (["--poses", "2"], "--poses"),
        (["--outliers", "1.1"], "--outliers"),
        (["--speed", "0", "--trajectory"], "--speed"),
        (["--peak", "0", "--images"], "--peak"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_options_that_do_not_go_together_are_refused(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SHORT, *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""
    assert not list(tmp_path.iterdir())


def test_where_the_truth_of_joints_that_err_is_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(find_rig("elbow3r"), "rig")
    with Path("rig/rig.yaml").open("a") as file:
        file.write("errors: {backlash: default}\n")
    assert run(["simulate", "rig", "-o", "s", "--poses", "3"]) == 0
    assert capsys.readouterr().out.endswith("in truth.urdf, what its joints do beside in truth.json\n")


def test_a_session_and_its_truth_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*SHORT, "--pixel", "0.2", "--outliers", "0.5", "--error-scale", "2"]) == 0
    captured = capsys.readouterr()
    assert captured.out == "s: 3 poses of elbow3r, seed 1; the truth is in truth.urdf\n"
    assert captured.err == ""
    truth = json.loads((tmp_path / "s" / "truth.json").read_text())
    assert (truth["noise"]["pixel"], truth["outlier_share"], truth["error_scale"]) == (0.2, 0.5, 2.0)
    assert len(truth["outliers"]) == 3
    assert read_session(tmp_path / "s").noise.pixel == 0.2


def test_an_arm_may_move(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--trajectory", "--speed", "2", "--frame-rate", "5", "--joint-rate", "50"]
    assert run([*SHORT, *options, "--time-offset", "0.01", "--time-offset", "-0.02"]) == 0
    session = read_session(tmp_path / "s")
    assert isinstance(session.motion, Trajectory)
    assert f"s: the arm moves; {len(session.poses)} frames\n" in capsys.readouterr().out
    assert json.loads((tmp_path / "s" / "truth.json").read_text())["time_offsets"] == {"cam0": 0.01, "cam1": -0.02}


def test_images_are_written_instead_of_detections(tmp_path: Path) -> None:
    assert run([*SHORT, "--images", "--distractors", "--peak", "2000"]) == 0
    assert not (tmp_path / "s" / "detections.csv").exists()
    assert len(list((tmp_path / "s" / "images").rglob("*.png"))) == 6


def test_videos_are_written_instead_of_detections(tmp_path: Path) -> None:
    assert run([*SHORT, "--video", "--trajectory", "--speed", "4", "--frame-rate", "1"]) == 0
    assert {path.name for path in (tmp_path / "s" / "images").iterdir()} == {"cam0.mp4", "cam1.mp4"}


def test_what_could_not_be_checked_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = folders.read_rig

    def without_solids(path: Path) -> RigDescription:
        rig = read(path)
        return replace(rig, urdf=Urdf.parse(rig.urdf.data.replace(b"collision", b"visual")))

    monkeypatch.setattr(folders, "read_rig", without_solids)
    assert run(SHORT) == 0
    assert "- elbow3r.urdf: no collision geometry, the poses were not checked" in capsys.readouterr().err


def test_a_demo_never_writes_into_a_folder_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: Any, **__: Any) -> None:
        raise SessionError("far enough")

    monkeypatch.setattr(simulation, "simulate", stop)
    for _ in range(3):
        assert run(["demo", "elbow3r"]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["urdfcal-demo", "urdfcal-demo-2", "urdfcal-demo-3"]
    capsys.readouterr()
    assert run(["demo", "elbow3r", "-o", "urdfcal-demo"]) == 2
    assert "urdfcal-demo: cannot make this folder: File exists. Name a new one with -o." in capsys.readouterr().err


def test_poses_of_a_plan_are_measured_and_those_passed_through_are_not(capsys: pytest.CaptureFixture[str]) -> None:
    joints = ["joint_1", "joint_2", "joint_3"]
    rows = {"1": (0.1, 0.2, 0.3), "pass1": (0.0, 0.0, 0.0), "check1": (0.2, 0.3, 0.1), "2": (0.0, 0.4, 0.5)}
    lines = [["pose", *joints], *([name, *values] for name, values in rows.items())]
    Path("plan.csv").write_text("\n".join(",".join(map(str, line)) for line in lines) + "\n")
    assert run(["simulate", "elbow3r", "--at", "plan.csv", "-o", "s"]) == 0
    assert capsys.readouterr().out.startswith("s: 3 poses of elbow3r")
    session = read_session("s")
    # Where the arm passed tells where it came from; nothing is measured there.
    assert session.poses == ("1", "pass1", "check1", "2")
    assert session.warnings == ()
    np.testing.assert_allclose(session.q, list(rows.values()), atol=1e-3)
    (table,) = session.measurements
    assert set(table.index["pose"]) == {0, 2, 3}
    assert run(["simulate", "elbow3r", "--at", "plan.csv", "-o", "filmed", "--images"]) == 0
    assert sorted(path.stem for path in Path("filmed/images/cam0").iterdir()) == ["1", "2", "check1"]
    assert run(["simulate", "panda_sockets", "--at", "plan.csv", "-o", "t"]) == 2
    assert not Path("t").exists()


def test_a_rig_that_touches_places_finds_its_poses_itself() -> None:
    rig = read_rig(find_rig("panda_sockets"))
    with pytest.raises(SessionError, match="finds its poses itself"):
        simulation.simulate(rig, seed=0, at=(("1", "2", "3"), rig.chain.random_values(3, np.random.default_rng(0))))
