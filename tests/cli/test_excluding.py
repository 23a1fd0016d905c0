"""Poses, cameras and LEDs left out, by session.yaml and by the command line, and where it shows."""

from __future__ import annotations

import html
import json
import re
import shutil
from typing import TYPE_CHECKING

import pytest

from tests.io.broken import put
from urdfcal.cli import run
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session
from urdfcal.io.shipped_rigs import find_rig

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def session(calibrated: Callable[[str], Path], tmp_path: Path) -> Path:
    folder = tmp_path / "session"
    shutil.copytree(calibrated("elbow3r") / "session", folder)
    return folder


def page(out: Path) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", (out / "report.html").read_text())).split())


def test_poses_left_out_by_either_way_give_the_same(
    session: Path, calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = read_session(session).poses
    assert (
        run(
            [
                "calibrate",
                str(session),
                "-o",
                str(tmp_path / "a"),
                "--exclude-poses",
                f"{poses[3]}-{poses[4]},{poses[9]}",
            ]
        )
        == 0
    )
    assert f"{len(poses) - 3} poses (3 poses excluded)" in capsys.readouterr().out
    with (session / "session.yaml").open("a") as file:
        file.write(f"exclude: {{poses: [{poses[3]}-{poses[4]}, {poses[9]}]}}\n")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "b"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    results = [json.loads((tmp_path / name / "calibration.json").read_text()) for name in "ab"]
    for result in (*results, printed):
        assert result["provenance"]["excluded"] == {"poses": [poses[3], poses[4], poses[9]]}
        assert result["fit"]["poses"] == len(poses) - 3
        assert result["verdict"]["level"] == "good"
    assert results[0]["dh"] == results[1]["dh"]
    assert f"3 poses excluded : {poses[3]}, {poses[4]}, {poses[9]}" in page(tmp_path / "b").replace(
        "excluded:", "excluded :"
    )
    result = calibrated("elbow3r") / "result"
    assert "excluded" not in json.loads((result / "calibration.json").read_text())["provenance"]
    assert "excluded" not in page(result)


def test_cameras_that_do_not_count(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second one goes; the first one stays as what the second is placed by."""
    text = (session / "session.yaml").read_text()
    first, second = read_session(session).rig.names
    for name, left in ((second, {first}), (first, {first, second})):
        (session / "session.yaml").write_text(text + f"exclude: {{cameras: [{name}]}}\n")
        assert run(["calibrate", str(session), "-o", str(tmp_path / name)]) == 0
        assert f"(camera {name!r} excluded)" in capsys.readouterr().out
        result = json.loads((tmp_path / name / "calibration.json").read_text())
        assert set(result["cameras"]) == left
        assert result["provenance"]["excluded"] == {"cameras": [name]}


def test_an_unknown_pose_is_refused(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--exclude-poses", "1-777"]) == 2
    assert "--exclude-poses: there is no pose '" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_led_that_only_a_distance_keeps(tmp_path: Path) -> None:
    """Nothing sees it, and the calibration does without it."""
    rig, session, out = tmp_path / "rig", tmp_path / "session", tmp_path / "out"
    shutil.copytree(find_rig("elbow3r"), rig)
    text, count = re.subn(r"leds:\n", "leds:\n  other: {position: [0.0, 0.05, 0.03]}\n", (rig / "rig.yaml").read_text())
    assert count == 1
    (rig / "rig.yaml").write_text(text + "led_distances: [{leds: [led, other], distance: 0.02, sigma: 1.0e-3}]\n")
    assert run(["simulate", str(rig), "-o", str(session)]) == 0
    with (session / "session.yaml").open("a") as file:
        file.write("exclude: {leds: [other]}\n")
    assert run(["calibrate", str(session), "-o", str(out)]) == 0
    result = json.loads((out / "calibration.json").read_text())
    assert set(result["leds"]) == {"led", "other"}
    assert result["provenance"]["excluded"] == {"leds": ["other"]}


def test_limits_are_ignored_on_demand(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An URDF whose limits are too narrow for what the arm did."""
    urdf = session / "elbow3r.urdf"
    joint = read_session(session).chain.joints[1]
    widest = read_session(session).readings[:, 1].max()
    text = urdf.read_text()
    start = text.index("<joint", text.index(f'name="{joint.name}"') - 10)
    narrow, count = re.subn(r'upper="[^"]*"', f'upper="{widest - 0.1:.4f}"', text[start:], count=1)
    assert count == 1
    urdf.write_text(text[:start] + narrow)
    call = ["calibrate", str(session), "-o", str(tmp_path / "out")]
    assert run(call) == 2
    assert "`urdfcal calibrate --ignore-limits`" in capsys.readouterr().err
    assert run([*call, "--ignore-limits"]) == 0
    assert f"{joint.name} is 0.1 rad beyond its limits" in capsys.readouterr().out


def test_a_detection_outside_the_image_costs_no_session(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = len(read_session(session).find(Detections))
    put("detections.csv", 20, u="-40.5")(session)
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["fit"]["observations"] == 2 * (before - 1)
    (warning,) = result["warnings"]
    assert re.search(r"detections.csv:22:\d+: \(-40.5, .*\) lies outside the .* left out$", warning)
    assert result["verdict"]["level"] == "doubtful"
