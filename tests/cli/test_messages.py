"""What a new user gets wrong, and what is said of it."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cli import run
from urdfcal.cli.console import say, status_line
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.result.calibration import Calibration
from urdfcal.robot.dh import PARAMETERS
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.mark.parametrize(("payload", "said"), [
    ("tip:1:0,0", "has a centre of 2 numbers, not three: write tool0:1.2 (kg) or tool0:1.2:0,0,0.05 (m), or nothing"),
    ("tip:0", "weighs nothing: write --payload nothing"),
    ("tip:-1", "weighs -1 kg: write"),
    ("tip:nan", "weighs nan kg: write"),
    ("tip", "is no payload: write"),
])  # fmt: skip
def test_a_payload_that_is_none_is_explained(payload: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["compensate", "result", "path.csv", "-o", "out.csv", "--payload", payload]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", ["compensate {} path.csv -o out.csv", "apply {} other.urdf", "export {} --to dh-csv"]
)
def test_a_urdf_is_no_result(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.urdf").write_text("<robot/>")
    assert run(command.format(tmp_path / "x.urdf").split()) == 2
    said = capsys.readouterr().err
    assert "this is a robot's description, and no result" in said
    assert "Name a folder that `urdfcal calibrate` wrote." in said


def test_an_overlay_of_pose_1_is_that_of_01(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = str(calibrated("elbow3r") / "result")
    assert run(["view", result, "--overlay", "1", "--save", str(tmp_path / "one.png")]) == 0
    assert (tmp_path / "one.png").stat().st_size > 1000
    assert run(["view", result, "--overlay", "51"]) == 2
    assert "there is no pose '51'. There are 01, 02, 03 to 50." in capsys.readouterr().err


def test_the_size_of_images_is_written_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cameras", "convert", "--help"]) == 0
    assert re.search(r"--size WxH\s", capsys.readouterr().out)


def test_dh_takes_a_result_and_prints_its_rows(
    calibrated: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result = calibrated("elbow3r") / "result"
    assert run(["dh", str(result), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    entries = Calibration.load(result).document.dh
    expected = np.reshape([entry.nominal + entry.offset for entry in entries], (len(rows), len(PARAMETERS)))
    np.testing.assert_allclose([[row[name] for name in PARAMETERS] for row in rows], expected, atol=1e-15)
    assert run(["dh", str(result)]) == 0
    assert "standard DH, calibrated" in capsys.readouterr().out
    assert run(["dh", str(result), "--tip", "tip"]) == 2
    assert "a result names its links" in capsys.readouterr().err
    assert run(["dh", "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"]) == 2
    assert "a URDF needs --tip LINK" in capsys.readouterr().err


def test_another_session_of_the_same_arm_is_one_option(tmp_path: Path) -> None:
    rig = read_rig(find_rig("elbow3r"))
    monday, tuesday = (simulate(rig, seed=seed, arm_seed=7, poses=5) for seed in (1, 2))
    np.testing.assert_array_equal(monday.truth.offsets, tuesday.truth.offsets)
    assert np.abs(monday.session.q - tuesday.session.q).max() > 0.1
    np.testing.assert_array_equal(simulate(rig, seed=7, poses=5).truth.offsets, monday.truth.offsets)
    assert (
        run(["simulate", "elbow3r", "-o", str(tmp_path / "s"), "--poses", "5", "--seed", "2", "--arm-seed", "7"]) == 0
    )
    truth = json.loads((tmp_path / "s" / "truth.json").read_text())
    assert (truth["seed"], truth["arm_seed"]) == (2, 7)
    assert (tmp_path / "s" / "truth.urdf").read_bytes() == tuesday.truth.urdf


def test_sentences_fit_on_a_terminal_and_are_whole_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "- " + " ".join(f"word{k}" for k in range(30)) + "\nsecond"
    say(text)
    assert capsys.readouterr().out == text + "\n"
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    say(text, err=True)
    lines = capsys.readouterr().err.splitlines()
    assert max(map(len, lines)) <= 80
    assert [line[:2] for line in lines] == ["- ", "  ", "  ", "se"]
    assert " ".join(" ".join(lines).split()) == " ".join(text.split())


@pytest.mark.parametrize("command", ["compare {0}/result {0}/result", "apply {0}/result {0}/nominal.urdf",
                                     "export {0}/result --to dh-csv -o {0}/out", "dh {0}/result"])  # fmt: skip
def test_commands_on_a_result_fit_80_columns(
    command: str, calibrated: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    folder = calibrated("elbow3r")
    (tmp_path / "result").symlink_to(folder / "result")
    (tmp_path / "nominal.urdf").write_bytes((find_rig("elbow3r") / "elbow3r.urdf").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert run(command.format(".").split()) == 0
    captured = capsys.readouterr()
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", captured.out + captured.err).splitlines()
    assert lines
    assert all(len(line) <= 80 for line in lines)


def test_reasons_to_check_stand_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], calibrated: Callable[[str], Path]
) -> None:
    session = calibrated("elbow3r") / "session"
    for path in session.iterdir():
        text = path.read_text()
        (tmp_path / path.name).write_text(
            re.sub(r"pixel: [0-9.]+", "pixel: 0.06", text) if path.name == "session.yaml" else text
        )
    assert run(["calibrate", str(tmp_path), "-o", str(tmp_path / "out"), "--force"]) == 0
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    lines = capsys.readouterr().out.splitlines()
    assert document["verdict"]["reasons"]
    assert [line[2:] for line in lines if line.startswith("! ")] == document["verdict"]["reasons"]


@pytest.mark.usefixtures("no_trials")
@pytest.mark.usefixtures("no_trials")
def test_nothing_is_printed_in_the_spinners_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    small_session: Path,
) -> None:  # fmt: skip
    monkeypatch.setenv("FORCE_COLOR", "1")
    for path in small_session.iterdir():
        (tmp_path / path.name).write_text(path.read_text())
    table = tmp_path / "detections.csv"
    header, *rows = table.read_text().splitlines()
    us = [row.split(",")[3] for row in rows]  # of other poses: nothing fits
    table.write_text("\n".join([header, *(",".join([*row.split(",")[:3], u, row.split(",")[4]]) for row, u in
                                          zip(rows, us[::-1], strict=True))]) + "\n")  # fmt: skip
    assert run(["calibrate", str(tmp_path), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    end = said.rfind("\x1b[?25h")  # the cursor is shown again: the spinner is gone
    assert end >= 0
    assert "urdfcal: " in said[end:]
    assert "\n- " not in said[:end]


def test_a_status_line_is_gone_when_it_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    with status_line() as show:
        show("working")
    assert "\x1b[2K" in capsys.readouterr().err
