from __future__ import annotations

import html
import json
import re
import shutil
from typing import TYPE_CHECKING

import pytest

import urdfcal
from urdfcal.cli import run
from urdfcal.errors import CalibrationError
from urdfcal.output.findings import Overview, pose_texts
from urdfcal.output.recording import _banner

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def session(calibrated: Callable[[str], Path], tmp_path: Path) -> Path:
    """A session whose pixels have five times the noise that it declares."""
    folder = tmp_path / "session"
    shutil.copytree(calibrated("elbow3r") / "session", folder)
    text, count = re.subn(r"pixel: [0-9.]+", "pixel: 0.02", (folder / "session.yaml").read_text())
    assert count == 1
    (folder / "session.yaml").write_text(text)
    return folder


def test_library_and_command_line_refuse_the_same(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(CalibrationError, match="times the declared noise") as error:
        urdfcal.calibrate(session)
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 1
    printed = " ".join(capsys.readouterr().err.split())
    assert printed.count(error.value.what) == 1
    assert printed.count("times the declared noise") == 1
    assert not (tmp_path / "out").exists()


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
