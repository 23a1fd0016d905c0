"""A moving arm, the whole way through the command line."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest
import yaml

from tests.halved import halved
from urdfcal import Calibration
from urdfcal.cli import run
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session

if TYPE_CHECKING:
    from pathlib import Path

OFFSETS = {"cam0": 0.02, "cam1": -0.007}
MOVING = ["--trajectory", "--time-offset", "0.02", "--time-offset", "-0.007"]


def offsets_of(result: Path) -> dict[str, dict[str, float]]:
    document = json.loads((result / "calibration.json").read_text())
    return {name: camera["time_offset"] for name, camera in document["cameras"].items()}


def test_tables_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session, out = tmp_path / "s", tmp_path / "out"
    assert run(["simulate", "elbow3r", "-o", str(session), *MOVING, "--poses", "8", "--frame-rate", "4"]) == 0
    assert json.loads((session / "truth.json").read_text())["time_offsets"] == OFFSETS
    capsys.readouterr()
    assert run(["calibrate", str(session), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    told = re.search(r"time offsets, robot less camera: cam0 (\S+) ± \S+ ms, cam1 (\S+) ± \S+ ms", said)
    assert told is not None
    assert [float(value) for value in told.groups()] == pytest.approx([20.0, -7.0], abs=0.2)
    for name, found in offsets_of(out).items():
        assert abs(found["value"] - OFFSETS[name]) < min(2e-4, 4.0 * found["sigma"])
    assert Calibration.load(out).placements.shape == (3, 4, 4)
    page = (out / "report.html").read_text()
    assert "Time offset of cam0" in page
    assert "lag and backlash are not looked for" in " ".join(page.split())
    capsys.readouterr()
    assert run(["evaluate", str(out / "elbow3r_calibrated.urdf"), str(session), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_px"]["rms"] < 0.2


@pytest.mark.usefixtures("no_trials")
def test_offsets_that_are_fixed_are_zero_and_do_not_explain_the_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, out = tmp_path / "s", tmp_path / "out"
    assert run(["simulate", "elbow3r", "-o", str(session), *MOVING, "--poses", "6", "--frame-rate", "3"]) == 0
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text + "estimate: {time_offset: fixed, geometry: dh, intrinsics: fixed}\n")
    assert run(["calibrate", str(session), "-o", str(out), "--force"]) == 0
    assert offsets_of(out)["cam0"] == {"value": 0.0, "sigma": None}
    assert "cam0 0 (fixed)" in capsys.readouterr().out


@pytest.mark.no_cover
@pytest.mark.parametrize("form", ["--images", "--video"])
def test_pictures_and_videos_are_detected_and_calibrated(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, out = tmp_path / "s", tmp_path / "out"
    rate = ["--poses", "3", "--frame-rate", "1"]
    assert run(["simulate", str(halved("elbow3r", tmp_path / "rig")), "-o", str(session), *MOVING, *rate, form]) == 0
    assert not (session / "detections.csv").exists()
    names = {path.name for path in (session / "images").iterdir()}
    assert names == ({"cam0", "cam1"} if form == "--images" else {"cam0.mp4", "cam1.mp4"})
    assert run(["calibrate", str(session), "-o", str(out), "--no-priors"]) == 0
    assert "looking for the LEDs first" in capsys.readouterr().out
    read = read_session(session)
    assert len(read.find(Detections)) > 0.7 * len((session / "truth_detections.csv").read_text().splitlines())
    for name, found in offsets_of(out).items():
        assert abs(found["value"] - OFFSETS[name]) < 5.0 * found["sigma"] < 5e-3


def test_a_video_that_lost_pictures_is_refused_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "s"
    rate = ["--poses", "3", "--frame-rate", "1"]
    assert (
        run(["simulate", str(halved("elbow3r", tmp_path / "rig")), "-o", str(session), *MOVING, *rate, "--video"]) == 0
    )
    rows = (session / "frames.csv").read_text().splitlines()
    count = sum(row.startswith("cam0") for row in rows)
    rows.remove(next(row for row in reversed(rows) if row.startswith("cam0")))
    (session / "frames.csv").write_text("\n".join(rows) + "\n")
    before = sorted(path.name for path in session.iterdir())
    assert run(["detect", str(session)]) == 2
    assert f"has {count} images, and the table of frames {count - 1}" in capsys.readouterr().err
    assert sorted(path.name for path in session.iterdir()) == before
    (session / "images" / "cam0").mkdir()
    assert run(["detect", str(session)]) == 2
    assert "cam0 as well" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--video"], "--video goes with --trajectory"),
        (["--time-offset", "0.1"], "--time-offset goes with --trajectory"),
        (["--trajectory", "--images", "--video"], "choose one"),
        (["--trajectory", "--time-offset", "0.1"], "1 time offsets for 2 cameras"),
        (["--trajectory", "--time-offset", "nan", "--time-offset", "0"], "not all numbers"),
        (["--trajectory", "--speed", "0"], "--speed"),
    ],
)
def test_wrong_calls_say_what_is_wrong(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["simulate", "elbow3r", "-o", str(tmp_path / "s"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.no_cover
@pytest.mark.usefixtures("no_trials")
def test_a_rolling_shutter_is_found_with_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = str(halved("elbow3r", tmp_path / "rig"))
    cameras = yaml.safe_load((tmp_path / "rig" / "cameras.yaml").read_text())
    cameras["cam0"]["line_time"] = 4.0e-5
    (tmp_path / "rig" / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    session, out = tmp_path / "s", tmp_path / "out"
    arguments = ["simulate", rig, "-o", str(session), *MOVING, "--poses", "8", "--frame-rate", "10"]
    assert run(arguments) == 0
    truth = json.loads((session / "truth.json").read_text())["line_times"]
    assert list(truth) == ["cam0"]
    assert truth["cam0"] != 4.0e-5
    capsys.readouterr()
    assert run(["calibrate", str(session), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "rolling shutters, from row to row: cam0 " in said
    document = json.loads((out / "calibration.json").read_text())
    found = document["cameras"]["cam0"]["line_time"]
    assert abs(found["value"] - truth["cam0"]) < 4.0 * found["sigma"]
    assert found["sigma"] < 1e-6
    assert "line_time" not in document["cameras"]["cam1"]
    assert "Line time of cam0" in (out / "report.html").read_text()
    assert run(["evaluate", str(out / "elbow3r_calibrated.urdf"), str(session), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_px"]["rms"] < 0.2
    # Without, the same frames say that something is wrong.
    plain = (session / "cameras.yaml").read_text()
    (session / "cameras.yaml").write_text(re.sub(r"  line_time.*\n", "", plain))
    assert run(["calibrate", str(session), "-o", str(tmp_path / "worse")]) == 1
