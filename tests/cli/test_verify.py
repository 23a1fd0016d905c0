from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cli import run
from urdfcal.cli.judging import _enlarged, _length, _verdict
from urdfcal.estimation.acceptance import Acceptance
from urdfcal.estimation.measurements import Detections
from urdfcal.io.writing import write_session
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

NEW = np.arange(50, 62)


@pytest.fixture
def result(calibrated: Callable[[str], Path]) -> Path:
    return calibrated("elbow3r") / "result"


@pytest.fixture
def new(simulated: Callable, tmp_path: Path) -> Path:
    """Twelve poses of the same arm, after those it was calibrated with."""
    session = simulated("elbow3r", poses=62).session
    write_session(tmp_path / "new", session.at(NEW))
    return tmp_path / "new"


def verified(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> dict[str, object]:
    assert run(["verify", *map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_the_verdict_is_the_exit_code(result: Path, new: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = verified(capsys, result, new, "--limit", "5mm")
    low, high = found["interval_mm"]
    assert 0.0 < low < found["rms_mm"] < high < 0.5
    assert (found["configurations"], found["limit_mm"], found["within"]) == (12, 5.0, True)
    for limit, code, words in (
        (1.01 * high, 0, r"within [\d.]+ mm"),
        (0.99 * high, 1, r"whether it is within [\d.]+ mm cannot be told: more poses are needed"),
        (1.01 * low, 1, r"whether it is within [\d.]+ mm cannot be told: more poses are needed"),
        (0.99 * low, 1, r"not within [\d.]+ mm"),
    ):
        assert run(["verify", str(result), str(new), "--limit", f"{limit:.6f}mm"]) == code
        line = capsys.readouterr().out.splitlines()[0]
        assert re.fullmatch(
            rf"[\d.]+ mm rms \(95 %: [\d.]+ to [\d.]+\), noise of measuring included, in 12 configurations: {words}",
            line,
        ), line
        within = verified(capsys, result, new, "--limit", f"{limit:.6f}mm", code=code)["within"]
        assert within is {"w": True, "n": False}.get(words[0] if "told" not in words else "")


def test_what_the_fit_takes_away_is_made_up_for_and_said(
    result: Path, new: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = verified(capsys, result, new, "--limit", "5mm")
    assert run(["evaluate", str(result), str(new), "--json"]) == 0
    residual = json.loads(capsys.readouterr().out)["across_rays_mm"]["rms"]
    assert found["enlarged"] > 1.05
    assert found["rms_mm"] == pytest.approx(found["enlarged"] * residual, rel=0.02)
    assert run(["verify", str(result), str(new), "--limit", "5mm"]) == 0
    assert f"the rms is {found['enlarged']:.2f} times that of the residuals" in capsys.readouterr().out
    assert _enlarged(Acceptance(1.0, (0.5, 2.0), 200, 400, 0, 2.0, enlarged=1.02)) == []


def test_the_nominal_arm_is_told_from_the_calibrated_one(
    result: Path, new: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limit = ["--limit", "0.5mm"]
    calibrated = verified(capsys, result / "elbow3r_calibrated.urdf", new, *limit)
    folder = verified(capsys, result, new, *limit)
    file = verified(capsys, result / "calibration.json", new, *limit)
    assert folder == file
    assert calibrated["rms_mm"] == pytest.approx(folder["rms_mm"], rel=1e-6)
    assert (calibrated["outside_domain"], type(folder["outside_domain"])) == (None, list)
    nominal = verified(capsys, new / "elbow3r.urdf", new, *limit, code=1)
    assert nominal["rms_mm"] > 3.0 * calibrated["rms_mm"]
    assert nominal["within"] is False


def test_a_session_of_the_corrected_robot_is_not_corrected_twice(
    result: Path, simulated: Callable, new: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = Urdf.read(result / "elbow3r_calibrated.urdf")
    session = simulated("elbow3r", poses=62).session.at(NEW)
    chain = type(session.chain).from_urdf(urdf, session.chain.tip_link, session.chain.base_link)
    again = replace(session, urdf=urdf, chain=chain, urdf_reference="elbow3r_calibrated.urdf")
    write_session(tmp_path / "again", again)
    found, first = (verified(capsys, result, of, "--limit", "5mm") for of in (tmp_path / "again", new))
    assert found["rms_mm"] == pytest.approx(first["rms_mm"], rel=1e-6)


def test_another_robots_result_is_refused(
    calibrated: Callable[[str], Path], new: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["verify", str(calibrated("ur5") / "result"), str(new), "--limit", "1mm"]) == 2
    assert "elbow3r.urdf: joint 'joint_1' was not calibrated. Calibrated are shoulder_pan_joint" in (
        capsys.readouterr().err
    )
    urdf = calibrated("ur5") / "result" / "ur5_robot_calibrated.urdf"
    assert run(["verify", str(urdf), str(new), "--limit", "1mm", "--tip", "tool0"]) == 2
    assert "the arm's joints are shoulder_pan_joint" in capsys.readouterr().err


def test_links_of_a_urdf_may_have_other_names(result: Path, new: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = result / "elbow3r_calibrated.urdf"
    renamed = new.parent / "renamed.xml"
    text = given.read_text()
    renamed.write_text(text.replace('"tool0"', '"flange"').replace('"base_link"', '"foot"'))
    assert '"flange"' in renamed.read_text()
    assert run(["verify", str(renamed), str(new), "--limit", "1mm"]) == 2
    assert "there is no link" in capsys.readouterr().err
    found = verified(capsys, renamed, new, "--limit", "1mm", "--tip", "flange", "--base", "foot")
    assert found["rms_mm"] == pytest.approx(verified(capsys, given, new, "--limit", "1mm")["rms_mm"], rel=1e-6)
    assert run(["verify", str(result), str(new), "--limit", "1mm", "--tip", "tool0"]) == 2
    assert "--tip and --base go with a URDF" in capsys.readouterr().err


def test_poses_outside_the_calibrated_ranges_are_said(
    result: Path, new: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads((result / "calibration.json").read_text())
    values = [line.split(",")[2] for line in (new / "joints.csv").read_text().splitlines()[1:]]
    low, high = min(map(float, values)), max(map(float, values))
    document["domain"]["joints"] = {"joint_2": [low, high - 0.2]}
    narrow = tmp_path / "calibration.json"
    narrow.write_text(json.dumps(document))
    data = verified(capsys, narrow, new, "--limit", "5mm")
    (one,) = data["outside_domain"]
    assert data["poses_outside_domain"] == one["poses"]
    assert (one["joint"], one["unit"]) == ("joint_2", "rad")
    assert one["beyond"] == pytest.approx(0.2)
    assert run(["verify", str(narrow), str(new), "--limit", "5mm"]) == 0
    assert "- joint_2 was calibrated from " in capsys.readouterr().out

    del document["domain"]  # as files of earlier versions
    narrow.write_text(json.dumps(document))
    assert verified(capsys, narrow, new, "--limit", "5mm")["outside_domain"] is None
    assert run(["verify", str(narrow), str(new), "--limit", "5mm"]) == 0
    assert "was calibrated from" not in capsys.readouterr().out


def test_the_measurements_of_the_calibration_are_no_new_ones(
    result: Path, new: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = "- these are the measurements that it was calibrated with: others will be further off"
    own = result.parent / "session"
    for session, code, is_new in ((own, 0, False), (new, 0, True)):
        assert verified(capsys, result, session, "--limit", "5mm", code=code)["new"] is is_new
        assert run(["verify", str(result), str(session), "--limit", "5mm"]) == code
        assert (said in capsys.readouterr().out.splitlines()) is not is_new
    # What is said of them does not make them new; the same path, measured anew, is.
    again = tmp_path / "again"
    shutil.copytree(own, again)
    (again / "session.yaml").write_text((again / "session.yaml").read_text() + "# a remark\n")
    assert verified(capsys, result, again, "--limit", "5mm")["new"] is False
    rows = (again / "detections.csv").read_text().splitlines()
    (again / "detections.csv").write_text("\n".join(rows[:-1]) + "\n")
    assert verified(capsys, result, again, "--limit", "5mm")["new"] is True
    assert verified(capsys, own / "truth.urdf", own, "--limit", "5mm")["new"] is True


def test_outliers_are_said(
    simulated: Callable, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = simulated("elbow3r", poses=62).session.at(NEW)
    (detections,) = session.measurements
    uv = np.array(detections.uv)
    uv[[3, 14]] -= 200.0 * np.sign(uv[[3, 14]] - [640.0, 512.0])
    write_session(tmp_path / "spoilt", replace(session, measurements=(replace(detections, uv=uv),)))
    assert run(["verify", str(result), str(tmp_path / "spoilt"), "--limit", "5mm"]) == 0
    assert "- 2 of 24 measurements are outliers, and do not count" in capsys.readouterr().out.splitlines()


def test_poses_that_are_no_configuration_of_their_own_are_named(
    result: Path, simulated: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = simulated("elbow3r", poses=62).session.at(NEW)
    seen = session.find(Detections)
    rows = np.concatenate([np.arange(len(seen)), np.flatnonzero(seen.pose == 0)])
    columns = {name: column[rows] for name, column in seen.arrays.items()}
    columns["pose"] = np.concatenate([seen.pose, np.full(len(rows) - len(seen), len(NEW))])
    columns["uv"] = columns["uv"] + 0.05 * (columns["pose"] == len(NEW))[:, None]
    q = np.concatenate([session.q, session.q[:1] + 0.001])
    near = replace(session, poses=(*session.poses, "again"), q=q, previous=None, measurements=(Detections(**columns),))
    write_session(tmp_path / "near", near)
    assert run(["verify", str(result), str(tmp_path / "near"), "--limit", "5mm"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "in 12 configurations" in printed
    assert (
        "- poses that repeat others to 0.05 rad or m in every joint are no configurations of their own: again"
        in printed
    )


def test_the_verdict_of_too_many_outliers_says_so() -> None:
    found = Acceptance(1.0, (0.25, 0.9), 12, 12, 12, 1e-3)
    assert "in 12 seconds of an arm that moves: " in _verdict(found, moving=True)
    assert _verdict(found, moving=False) == (
        "1000 mm rms (95 %: 250 to 900), noise of measuring included, in 12 configurations: whether it is within 1 mm "
        "cannot be told: too many measurements are outliers"
    )


@pytest.mark.parametrize(
    ("limit", "millimetres"), [("0.3mm", 0.3), ("3e-4m", 0.3), ("0.3 mm", 0.3), ("3E-1mm", 0.3), (".5m", 500.0)]
)
def test_a_limit_has_a_unit(limit: str, millimetres: float) -> None:
    assert 1e3 * _length(None, None, limit) == pytest.approx(millimetres)


@pytest.mark.parametrize(
    ("limit", "told"),
    [
        ("0.3", "is without a unit: write it as 0.3mm, or in metres as 3e-4m"),
        ("0.3cm", "is in cm, not in mm or m: write it as 0.3mm"),
        ("wide", "is no length: write it as 0.3mm or 3e-4m"),
        ("1.2.3mm", "is no length"),
        ("0mm", "is not positive"),
        ("-1mm", "is not positive"),
        ("1e999m", "is not positive"),
    ],
)
def test_what_is_no_length_is_refused(limit: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", "result", "session", f"--limit={limit}"]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_a_missing_result_is_told_how_to_make_one(new: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", str(new / "nowhere"), str(new), "--limit", "1mm"]) == 2
    assert "Name a folder that `urdfcal calibrate` wrote" in capsys.readouterr().err


def test_an_arm_that_bends_is_judged_with_its_joint_models(
    shared: Path, measured: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A UR10 before a tracker: 0.73 mm off with the corrected URDF alone, which cannot bend."""
    measured("ur10_spread").save(tmp_path / "calibration.json")
    assert run(["verify", str(tmp_path / "calibration.json"), str(shared / "ur10_cubes"), "--limit", "0.6mm"]) == 0
    assert "within 0.6 mm" in capsys.readouterr().out


def test_lenses_that_were_found_with_the_arm_judge_it_where_they_suit_better(
    simulated: Callable, new: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, session = simulated("elbow3r", poses=62).session, tmp_path / "session"
    wrong = [
        replace(camera, intrinsics=camera.intrinsics * np.array([1.02, 1.02, 1.0, 1.0])) for camera in data.rig.cameras
    ]
    given = replace(data, rig=replace(data.rig, cameras=tuple(wrong)), estimate=Estimate("dh", "free"))
    write_session(session, given.at(np.arange(50)))
    assert run(["calibrate", str(session), "-o", str(tmp_path / "result")]) == 0
    write_session(tmp_path / "wrong", given.at(NEW))
    lenses, rms = ", ".join(data.rig.names), {}
    for folder, said in (
        ("wrong", f"lenses of {lenses}: as found with the arm, which suit better than the session's"),
        ("new", "the session's, which suit better than those found with the arm"),
    ):
        capsys.readouterr()
        assert run(["evaluate", str(tmp_path / "result"), str(tmp_path / folder), "--json"]) == 0
        printed = capsys.readouterr()
        assert said in " ".join(printed.err.split())
        assert run(["evaluate", str(tmp_path / "result"), str(tmp_path / folder)]) == 0
        own = "nominal: the session's own arm with its own lenses"
        assert (own in " ".join(capsys.readouterr().out.split())) is (folder == "wrong")
        found = json.loads(printed.out)
        rms[folder] = found["residual_px"]["rms"]
        assert found["lenses"] == dict.fromkeys(data.rig.names, "calibration" if folder == "wrong" else "session")
        assert found["residual_px"]["rms_nominal"] > 2.0 * rms[folder]  # the nominal arm has the session's own
        assert run(["verify", str(tmp_path / "result"), str(tmp_path / folder), "--limit", "1mm"]) == 0
        assert said in " ".join(capsys.readouterr().out.split())
    # Camera by camera: since then the second is another one, with a file of its own, and it sees half of the poses.
    other = replace(data.rig.cameras[1], intrinsics=data.rig.cameras[1].intrinsics * np.array([1.1, 1.1, 1.0, 1.0]))
    mixed = replace(data, rig=replace(data.rig, cameras=(wrong[0], other)), estimate=given.estimate).at(NEW)
    seen = mixed.find(Detections)
    middle = other.intrinsics[2:]
    uv = np.where(seen.camera[:, None] == 1, middle + 1.1 * (seen.uv - middle), seen.uv)
    kept = replace(seen, uv=uv).rows(np.flatnonzero((seen.camera == 0) | (seen.pose % 2 == 0)))
    write_session(tmp_path / "mixed", replace(mixed, measurements=(kept,)))
    judged = verified(capsys, tmp_path / "result", tmp_path / "mixed", "--limit", "1mm")
    assert judged["lenses"] == dict(zip(data.rig.names, ("calibration", "session"), strict=True))
    # Where the two tell nothing apart, nothing is said: here the files are those that were found.
    entries = json.loads((tmp_path / "result" / "calibration.json").read_text())["cameras"]
    same = tuple(
        replace(one, intrinsics=np.array(entries[one.name]["intrinsics"]), distortion=entries[one.name]["distortion"])
        for one in data.rig.cameras
    )
    write_session(tmp_path / "same", replace(data, rig=replace(data.rig, cameras=same)).at(NEW))
    assert run(["verify", str(tmp_path / "result"), str(tmp_path / "same"), "--limit", "1mm"]) == 0
    assert "lenses of" not in capsys.readouterr().out
    # A URDF has no lenses: those of the session make it far worse.
    (urdf,) = (tmp_path / "result").glob("*.urdf")
    assert run(["evaluate", str(urdf), str(tmp_path / "wrong"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["residual_px"]["rms"] > 1.5 * rms["wrong"]
