from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yourdfpy

from urdfcal.cli import run

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def test_a_regenerated_urdf_gets_the_calibrated_origins(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = calibrated("elbow3r")
    other = tmp_path / "other.urdf"
    text = (folder / "session" / "elbow3r.urdf").read_text()
    other.write_text(text.replace("<joint ", "<!-- made anew -->\n<joint   "))
    for arguments, written in ([], tmp_path / "other_calibrated.urdf"), (["-o", str(tmp_path / "n.urdf")], None):
        assert run(["apply", str(folder / "result"), str(other), *arguments]) == 0
        path = written or tmp_path / "n.urdf"
        first, domain = capsys.readouterr().out.splitlines()
        assert first == str(path)
        measured = json.loads((folder / "result" / "calibration.json").read_text())["domain"]["joints"]
        low, high = measured["joint_2"]
        assert domain.startswith("- it was measured with joint_1 ")
        assert f"joint_2 {low:.2f} to {high:.2f} rad" in domain
        assert domain.endswith("; elsewhere it is extrapolated")
        assert "made anew" in path.read_text()
        applied, corrected = (
            yourdfpy.URDF.load(str(p), load_meshes=False) for p in (path, folder / "result" / "elbow3r_calibrated.urdf")
        )
        for q in np.random.default_rng(0).uniform(-1.5, 1.5, (10, 3)):
            tips = []
            for robot in (applied, corrected):
                robot.update_cfg(q)
                tips.append(robot.get_transform("tool0", "base_link"))
            np.testing.assert_allclose(*tips, atol=1e-12)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.replace('xyz="0 0 ', 'xyz="0.001 0 '), "is not the one that was calibrated: it is 1 mm off"),
        (lambda text: text.replace('"joint_2"', '"second"'), "'joint_2' does not hang where it did"),
        (
            lambda text: text.replace('"base_link"', '"root"'),
            "it describes 'elbow3r', which has no link 'base_link', and",
        ),
        (lambda text: text.replace("<robot", "<robots"), "mismatched tag"),
    ],
)
def test_another_robot_is_refused_and_nothing_written(
    edit: Callable[[str], str],
    message: str,
    calibrated: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = calibrated("elbow3r")
    other = tmp_path / "other.urdf"
    text = (folder / "session" / "elbow3r.urdf").read_text()
    other.write_text(edit(text))
    assert other.read_text() != text
    assert run(["apply", str(folder / "result"), str(other)]) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["other.urdf"]


def test_a_calibrated_urdf_is_not_calibrated_twice(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(calibrated("elbow3r") / "result" / "elbow3r_calibrated.urdf", tmp_path / "again.urdf")
    assert run(["apply", str(calibrated("elbow3r") / "result"), str(tmp_path / "again.urdf")]) == 2
    assert "already has its calibrated placement" in capsys.readouterr().err


def test_nothing_is_written_into_packages(calibrated: Callable[[str], Path], tmp_path: Path) -> None:
    result, urdf = (
        str(calibrated("ur5") / "result"),
        "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf",
    )
    assert run(["apply", result, urdf]) == 2
    assert run(["apply", result, urdf, "-o", str(tmp_path / "new.urdf")]) == 0
    corrected = calibrated("ur5") / "result" / "ur5_robot_calibrated.urdf"
    assert (tmp_path / "new.urdf").read_bytes() == corrected.read_bytes()
