from __future__ import annotations

import html
import json
import re
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

import urdfcal
from tests.io.broken import swap
from tests.worlds import images, slipped
from urdfcal.cli import run
from urdfcal.errors import CalibrationError
from urdfcal.io.writing import write_session
from urdfcal.output.findings import Overview
from urdfcal.output.pose_texts import pose_texts
from urdfcal.output.recording import _banner
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session


pytestmark = pytest.mark.usefixtures("no_trials", "once")


@pytest.fixture(scope="module")
def session(simulated: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose pixels have five times the noise that it declares."""
    folder = tmp_path_factory.mktemp("noisy") / "session"
    arm_alone = replace(simulated("elbow3r", poses=12).session, estimate=Estimate("dh", "fixed", "fixed"))
    write_session(folder, arm_alone)
    swap("session.yaml", "pixel: 0.1", "pixel: 0.02")(folder)
    return folder


@pytest.fixture(scope="module")
def made() -> dict[tuple, FittedCalibration]:
    return {}


@pytest.fixture
def once(made: dict[tuple, FittedCalibration], monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands calibrate a folder once: the tests are of what they then do with it. The library does each time."""
    calibrate = urdfcal.calibrate

    def known(session: Session, *, progress: object, **how: object) -> FittedCalibration:
        key = (session.folder, session.poses, *sorted(how.items()))
        if key not in made:
            made[key] = calibrate(session, **how)
        return made[key]

    monkeypatch.setattr("urdfcal.pipeline.calibrate", known)


def test_library_and_command_line_refuse_the_same(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(CalibrationError, match="times the declared noise") as error:
        urdfcal.calibrate(session)
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 1
    printed = " ".join(capsys.readouterr().err.split())
    assert printed.count(error.value.what) == 1
    assert printed.count("times the declared noise") == 1
    assert files(tmp_path / "out") == {"refused/report.html"}


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_what_is_refused_is_reported_until_a_run_succeeds(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, good = tmp_path / "out", tmp_path / "good"
    shutil.copytree(session, good)
    swap("session.yaml", "pixel: 0.02", "pixel: 0.1")(good)
    assert run(["calibrate", str(good), "-o", str(out), "-q"]) == 0
    results = {name: (out / name).read_bytes() for name in files(out)}
    for _ in range(2):
        assert run(["calibrate", str(session), "-o", str(out)]) == 1
        said = capsys.readouterr()
        assert said.out == ""
        assert f"{out / 'refused' / 'report.html'} shows it; --force writes it all the same." in said.err
        assert files(out) == {*results, "refused/report.html"}
        assert {name: (out / name).read_bytes() for name in results} == results
    page = (out / "refused" / "report.html").read_text()
    assert "times the declared noise" in page
    assert "nothing else was written" in page
    assert "Beside it" not in page
    assert run(["calibrate", str(session), "-o", str(out), "-q", "--force"]) == 0
    assert files(out) == set(results)
    assert not (out / "refused").exists()
    assert "Beside it" in (out / "report.html").read_text()


def test_other_files_in_the_folder_of_what_was_refused_stay(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(["calibrate", str(session), "-o", str(out)]) == 1
    (out / "refused" / "notes.txt").touch()
    assert run(["calibrate", str(session), "-o", str(out), "-q", "--force"]) == 0
    assert files(out / "refused") == {"notes.txt"}


def test_what_is_refused_where_nothing_can_be_written_is_still_refused(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").touch()
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "cannot write here" in said
    assert "times the declared noise" in said
    assert "shows it" not in said


def test_what_is_refused_says_which_poses_to_leave_out(
    tmp_path: Path, simulated: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path / "session", slipped(simulated("elbow3r", poses=50), 2e-3))
    call = ["calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "out")]
    assert run(call) == 1
    said = re.search(r", or leave out these poses \(exclude: \{poses: \[(.*)\]\}\)", capsys.readouterr().err)
    assert said
    assert said[0] in (tmp_path / "out" / "refused" / "report.html").read_text()
    assert run([*call, "-q", "--exclude-poses", said[1]]) == 0
    assert not (tmp_path / "out" / "refused").exists()


def test_what_is_so_wrong_that_some_numbers_are_none_is_written_by_force_alone(
    tmp_path: Path, simulated: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images upside down and mirrored, of an arm behind the cameras."""
    upside_down = images(simulated("so101", poses=10), 0.0, change=lambda uv, size: size - uv)
    write_session(tmp_path / "session", upside_down)
    call = ["calibrate", str(tmp_path / "session"), "-o", str(tmp_path / "out")]
    assert run(call) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "not written: " in said.err
    assert not (tmp_path / "out" / "calibration.json").exists()
    assert run([*call, "--force"]) == 0
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["regions"]["rms_nominal_mm"] is None


def test_all_outputs_show_one_assessment_and_each_reason_once(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = urdfcal.calibrate(session, force=True)
    said = calibration.assessment
    assert said.level == "bad"
    assert said.failures == calibration.failures != ()

    out = tmp_path / "out"
    assert run(["calibrate", str(session), "-o", str(out), "--force"]) == 0
    summary = capsys.readouterr().out
    assert run(["calibrate", str(session), "-o", str(out), "--force", "--json"]) == 0
    verdict = {"level": said.level, "sentence": said.sentence, "reasons": list(said.reasons)}
    assert json.loads(capsys.readouterr().out)["verdict"] == verdict
    assert json.loads((out / "calibration.json").read_text())["verdict"] == verdict
    assert urdfcal.Calibration.load(out).assessment == said

    page = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", (out / "report.html").read_text())).split())
    overview = Overview.of(calibration)
    for text in (" ".join(summary.split()), page, " ".join(pose_texts(overview)[0].split())):
        for reason in said.reasons:
            assert text.count(" ".join(reason.split())) == 1
    assert summary.splitlines()[0] == f"elbow3r: {said.sentence}"
    assert page.count(said.sentence) == 1
    assert _banner(overview).name.startswith(said.sentence)
