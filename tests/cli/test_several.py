"""Several sessions of one arm, and a session in which something moved, through the command line."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import ALONE, EVENT, bumped
from urdfcal.arrays import inverse
from urdfcal.cli import run
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.io.folder import read_session, read_sessions
from urdfcal.io.writing import write_session
from urdfcal.pipeline import calibrate
from urdfcal.result.calibration import Calibration
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, simulated: Callable) -> Path:
    """The session of an arm whose base was bumped, whole and in two."""
    folder = tmp_path_factory.mktemp("several")
    whole = replace(bumped(simulated("ur5", poses=60), 0.02), **ALONE)
    poses = np.arange(60)
    for name, some in (("whole", poses), ("before", poses[:EVENT]), ("after", poses[EVENT:])):
        write_session(folder / name, whole.at(some))
    return folder


@pytest.fixture(scope="module")
def together(folders: Path) -> Path:
    """The result of both."""
    output = folders / "result"
    assert run(["calibrate", str(folders / "before"), str(folders / "after"), "-o", str(output), "-q"]) == 0
    return output


def test_two_sessions_are_one_calibration(folders: Path, together: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = ["calibrate", str(folders / "before"), str(folders / "after"), "-o", str(folders / "json"), "--json"]
    assert run(call) == 0
    printed = json.loads(capsys.readouterr().out)
    del printed["files"]
    assert printed == json.loads((together / "calibration.json").read_text())
    assert Calibration.load(together).to_dict() == printed
    before, after = printed["sessions"]["before"], printed["sessions"]["after"]
    assert before["T_world_base"] == printed["T_world_base"]
    moved = inverse(np.array(before["T_world_base"])) @ after["T_world_base"]
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.02, abs=2e-3)
    assert (before["poses"], after["poses"]) == (30, 30)
    assert (before["leds"], after["leds"]) == (["before/led"], ["after/led"])
    assert list(printed["leds"]) == ["before/led", "after/led"]
    for session in (before, after):
        (residual,) = session["residuals"]
        assert residual["rms"] < 0.2 < residual["rms_nominal"]
    assert {name.split("/")[0] for name in printed["provenance"]["sha256"]} == {"before", "after"}
    assert run([*call[:-3], "-o", str(folders / "text")]) == 0
    assert re.search(
        r"^before: 30 poses, 0\.\d+ px rms; after: 30 poses, 0\.\d+ px rms$", capsys.readouterr().out, re.M
    )
    page = (together / "report.html").read_text()
    for key in ("sessions/after/poses", "sessions/after/T_world_base/0/3", "sessions/after/residuals/0/rms"):
        assert f'data-key="{key}"' in page


def test_the_result_is_one_like_any(folders: Path, together: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", str(together), str(folders / "after"), "--limit", "1mm"]) == 0
    assert "calibrated with" in capsys.readouterr().out
    assert run(["evaluate", str(together / "ur5_robot_calibrated.urdf"), str(folders / "before")]) == 0
    assert run(["compare", str(together), str(together)]) == 0
    assert run(["export", str(together), "--to", "ros-static-tf", "-o", str(folders / "frames")]) == 0
    written = next((folders / "frames").rglob("*.xml")).read_text()
    document = json.loads((together / "calibration.json").read_text())
    T = inverse(np.array(document["sessions"]["after"]["T_world_base"]))  # the first camera is the world
    x = re.search(r"--x (\S+) .*child-frame-id cam0_optical_frame", written)
    assert float(x[1]) == pytest.approx(T[0, 3])
    assert "after_led" in written


@pytest.mark.usefixtures("no_trials")
def test_what_moved_is_proposed_and_mends_it(folders: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = ["calibrate", str(folders / "whole"), "-o", str(tmp_path / "out")]
    assert run(call) == 1
    said = re.search(r"say that it moved \((moved: \{base: \[.*?\]\})\), or leave out", capsys.readouterr().err)
    file = folders / "whole" / "session.yaml"
    file.write_text(f"{file.read_text()}{said[1]}\n")
    assert run(call) == 0
    assert "Trust it" in capsys.readouterr().out
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert list(document["sessions"]) == ["base", "base@31"]
    assert run(["verify", str(tmp_path / "out"), str(folders / "whole"), "--limit", "1mm"]) == 0
    capsys.readouterr()
    assert run(["evaluate", str(tmp_path / "out" / "ur5_robot_calibrated.urdf"), str(folders / "whole"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_px"]["rms"] < 0.2
    points = triangulate(read_session(folders / "whole"))
    labels = read_session(folders / "whole").poses
    rows = [f"{labels[k]},led,{x},{y},{z}" for k, (x, y, z) in zip(points.pose[:20], points.xyz[:20], strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(["pose,led,x,y,z", *rows]))
    urdf = str(tmp_path / "out" / "ur5_robot_calibrated.urdf")
    assert run(["evaluate", urdf, str(folders / "whole"), "--points", str(tmp_path / "points.csv")]) == 0
    file.write_text(file.read_text().replace("base: [31]", "base: [99]"))
    with pytest.raises(SessionError, match=r"session\.yaml:\d+:\d+, key 'moved\.base': there is no pose '99'"):
        read_session(folders / "whole")


@pytest.mark.parametrize(
    ("names", "more", "message"),
    [
        (("before", "before"), [], r"before: this session is named twice\. Measurements count once"),
        (("before", "after/../before"), [], "this session is named twice"),
        (("before", "after"), ["33", "99"], r"'99' is in none of the sessions\. Write before/99"),
        (("before", "after"), ["after/3"], "--exclude-poses: there is no pose '3'"),
    ],
)
def test_what_is_no_several_sessions_is_refused(
    names: tuple[str, str], more: list[str], message: str, folders: Path
) -> None:
    with pytest.raises(SessionError, match=message):
        read_sessions([folders / name for name in names], exclude_poses=more)


def test_a_pose_that_two_sessions_have_needs_the_name_of_one(folders: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_session(tmp_path / name, read_session(folders / "before"))
    with pytest.raises(SessionError, match=r"--exclude-poses: '03' is in each of a, b\. Write a/03 or b/03\."):
        read_sessions([tmp_path / name for name in ("a", "b")], exclude_poses=["03"])


def test_poses_that_one_session_alone_has_need_no_name_before_them_and_are_predicted(folders: Path) -> None:
    one = read_sessions([folders / name for name in ("before", "after")], exclude_poses=["33-36", "after/38"])
    assert one.excluded.poses == (*(f"after/{k}" for k in range(33, 37)), "after/38")
    calibration = calibrate(replace(one, estimate=Estimate("dh", "fixed", "fixed")), force=True)
    left_out = calibration.evidence.left_out
    assert left_out is not None
    assert left_out.poses == 5
    assert left_out.rms < 1e-3


def test_names_are_as_long_as_they_must(folders: Path, tmp_path: Path) -> None:
    for day, name in (("monday", "before"), ("tuesday", "after")):
        (tmp_path / day).mkdir()
        write_session(tmp_path / day / "s", read_session(folders / name))
    one = read_sessions([tmp_path / "monday" / "s", tmp_path / "tuesday" / "s"], exclude_poses=["tuesday/s/31-33"])
    assert one.parts == ("monday/s", "tuesday/s")
    assert len(one.poses) == 57
    assert one.excluded.poses == ("tuesday/s/31", "tuesday/s/32", "tuesday/s/33")
    assert read_sessions([folders / "before"]).parts == ("",)
