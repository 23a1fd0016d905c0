"""``urdfcal plan``: from rig and session, what it writes, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from urdfcal.cli import run
from urdfcal.cli.plan import _print
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.tables import read_joints
from urdfcal.planning.files import labels
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Mechanism

RIG = ["plan", "elbow3r", "-o", "plan.csv", "--candidates", "300"]


@pytest.fixture(autouse=True)
def _inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # Poses are planned as well by a few rounds of refinement, but for a per mille of the tip's error.
    monkeypatch.setattr("urdfcal.planning.refinement._ROUNDS", 4)


def chain() -> Mechanism:
    return read_rig(find_rig("elbow3r")).chain


def test_a_plan_is_read_as_joints_and_drives_arms(capsys: pytest.CaptureFixture[str]) -> None:
    formats = [word for name in ("urscript", "ros", "lerobot") for word in ("--format", name)]
    assert run([*RIG, "--poses", "5", *formats, "--save", "plan.rrd"]) == 0
    said = capsys.readouterr()
    assert "plan.csv, plan.script, plan.yaml, plan.json, plan.rrd: 5 poses" in said.out
    assert " mm, as far as tolerances let it be off, to " in " ".join(said.out.split())
    assert Path("plan.rrd").stat().st_size > 0
    table = read_joints(Path("plan.csv"), chain(), chain().names)
    program = Path("plan.script").read_text()
    assert program.count("movej(") == len(table.poses)
    assert program.count("sleep(") == 9
    assert program.count(': ", get_actual_joint_positions())') == 9
    assert "where the arm stands now is not known" in said.err
    checks = [label for label in table.poses if label.startswith("check")]
    assert checks == [f"check{k}" for k in range(1, 5)]
    assert "4 random ones to check by: calibrate with --exclude-poses\n  check1,check2,check3,check4\n" in said.out
    trajectory = yaml.safe_load(Path("plan.yaml").read_text())
    assert trajectory["joint_names"] == list(chain().actuated)
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in trajectory["points"]]
    assert np.all(np.diff(times) > 0.0)
    assert len(times) == len(table.poses) + 9
    actions = json.loads(Path("plan.json").read_text())
    first = [actions[0]["action"][f"{name}.pos"] for name in chain().actuated]
    np.testing.assert_allclose(np.radians(first), table.readings[0])


def test_a_calibration_says_how_far_the_arm_is_off_in_the_poses_to_check_by(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", "elbow3r", "-o", "s", "--poses", "16"]) == 0
    for name in ("joints", "detections"):  # as if the last four had been planned to check by
        text = Path(f"s/{name}.csv").read_text()
        Path(f"s/{name}.csv").write_text(re.sub(r"^1([3-6]),", r"check\1,", text, flags=re.M))
    capsys.readouterr()
    assert run(["calibrate", "s", "-o", "out", "--exclude-poses", "check3,check4,check5,check6"]) == 0
    assert "in the 4 poses left out" in capsys.readouterr().out
    document = json.loads(Path("out/calibration.json").read_text())
    found = document["validation"]["left_out"]
    assert found["poses"] == 4
    assert found["rms_mm"] < min(found["max_mm"], 0.3 * document["validation"]["rms_nominal_mm"])
    assert "in the 4 poses left out" in Path("out/report.html").read_text()


def test_names_go_on_where_a_plan_goes_on_from_a_session(capsys: pytest.CaptureFixture[str]) -> None:
    """Check poses of both sessions can be left out by their names alone, those that are left out already, too."""
    assert run(["simulate", "elbow3r", "-o", "s", "--poses", "12"]) == 0
    for name in ("joints", "detections"):
        text = Path(f"s/{name}.csv").read_text()
        Path(f"s/{name}.csv").write_text(re.sub(r"^1([12]),", r"check\1,", text, flags=re.M))
    file = Path("s/session.yaml")
    file.write_text(f"{file.read_text()}exclude: {{poses: [check2]}}\n")
    capsys.readouterr()
    assert run(["plan", "s", "-o", "plan.csv", "--candidates", "300", "--poses", "3"]) == 0
    assert "calibrate with --exclude-poses\n  check3,check4,check5,check6\n" in capsys.readouterr().out
    table = read_joints(Path("plan.csv"), chain(), chain().names)
    assert [label for label in table.poses if label.isdigit()] == ["11", "12", "13"]


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        ((), ["1", "check1", "pass1", "2"]),
        (("08", "9", "check4", "pass2", "checked", "tool1"), ["10", "check5", "pass3", "11"]),
        (("1700000000123456",), ["1", "check1", "pass1", "2"]),
    ],
)
def test_names_of_a_plan_are_none_of_its_session(before: tuple[str, ...], expected: list[str]) -> None:
    rank, check = np.array([0, -1, -1, 1]), np.array([False, True, False, False])
    assert labels(SimpleNamespace(count=2, rank=rank, check=check, before=before)) == expected


def test_of_many_poses_every_tenth_is_in_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    errors, none = np.linspace(1e-3, 1e-4, 25), np.zeros(24, dtype=bool)
    plan = SimpleNamespace(
        count=24, errors=errors, likely=errors, measured=~none, check=none, rank=np.arange(24), before=()
    )
    _print(plan, ["plan.csv"], None, "")
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split()[0] for line in lines if re.fullmatch(r" *\d+( +[\d.]+){2} *", line)]
    assert rows == [*map(str, range(11)), "20", "24"]


def test_until_asks_for_as_few_as_needed_and_says_when_that_is_out_of_reach(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*RIG, "--until", "2mm", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["tip_at_most_mm"][-1] <= 2.0 < found["tip_at_most_mm"][-2]
    assert run([*RIG, "--until", "1um", "--poses", "4"]) == 1
    assert re.search(r"0.001 mm is not reached: 9 of 10 arms come to [0-9.]+ mm at most", capsys.readouterr().out)
    Path("plan.csv").unlink()
    assert run([*RIG, "--until", "1m"]) == 0
    assert "nothing more to measure" in capsys.readouterr().out
    assert not Path("plan.csv").exists()
    assert run([*RIG, "--until", "1m", "--save", "plan.rrd"]) == 0
    assert "there is nothing to record: plan.rrd is not written" in capsys.readouterr().err
    assert not Path("plan.rrd").exists()


@pytest.mark.parametrize(
    ("arguments", "place"),
    [(["--save", "nowhere/plan.rrd"], "nowhere/plan.rrd"), (["--format", "ros", "--save", "plan.rrd"], "plan.yaml")],
)
def test_a_plan_is_written_whole_or_not_at_all(
    arguments: list[str], place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("plan.yaml").mkdir()
    assert (
        run(["plan", "elbow3r", "-o", "plan.csv", "--candidates", "20", "--poses", "1", "--no-check", *arguments]) == 2
    )
    assert f"{place}: cannot write here" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["plan.yaml"]


@pytest.mark.parametrize(
    ("output", "arguments"),
    [
        ("plan.json", ["--format", "lerobot"]),
        ("plan.rrd", ["--save", "plan.rrd"]),
        ("plan.csv", ["--format", "ros", "--save", "./plan.yaml"]),
    ],
)
def test_no_two_files_are_one(output: str, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "elbow3r", "-o", output, *arguments]) == 2
    assert "two files of this plan would be one" in capsys.readouterr().err
    assert not list(Path().iterdir())


def test_a_session_is_gone_on_from_and_a_box_is_where_it_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", "elbow3r", "-o", "s", "--poses", "8"]) == 0
    assert run(["plan", "s", *RIG[2:], "--poses", "4", "--workspace", "session"]) == 0
    tip = tip_poses(chain(), chain().random_values(500, np.random.default_rng(0)))[:, :3, 3]
    box = [f"{low:.3f}:{high:.3f}" for low, high in np.percentile(tip, [20, 80], axis=0).T]
    assert run(["plan", "s", *RIG[2:], "--poses", "4", "--workspace", ",".join(box)]) == 0
    assert run(["plan", "s", *RIG[2:], "--poses", "4", "--workspace", "s/joints.csv"]) == 0
    said = capsys.readouterr()
    assert "tolerances let it be" not in said.out
    assert "where the arm stands" not in said.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "none.yaml"], "none.yaml"),
        (["--until", "0.2"], "write it with its unit"),
        (["--workspace", "1,2,3"], "is no box, no file and no folder"),
        (["--workspace", "0:1,0:1,0:x"], "is no box"),
        (["--workspace", "1:0,0:1,0:1"], "is no box"),
        (["--workspace", "8:9,8:9,8:9"], "random poses 0 bring"),
        (["--workspace", "session"], "nothing is measured yet"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*RIG, *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not Path("plan.csv").exists()


def test_a_result_is_planned_from_and_says_how_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", "elbow3r", "-o", "s", "--poses", "12"]) == 0
    assert run(["calibrate", "s", "-o", "result", "-q"]) == 0
    capsys.readouterr()
    for start in ("result", "result/calibration.json"):
        assert run(["plan", start, *RIG[2:], "--poses", "3"]) == 0
        said = capsys.readouterr()
        assert "plan.csv: 3 poses" in said.out
        assert "tolerances: {length: " in said.out
        assert len(said.err.splitlines()) == 1, "collisions are looked for"
        assert "where the arm stands now is not known" in said.err
        assert "robot: {urdf: elbow3r_calibrated.urdf, ...}\n" in said.out
    Path("result/calibration.json").write_text("{}")
    assert run(["plan", "result", "-o", "plan.csv"]) == 2
