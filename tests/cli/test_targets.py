"""A board before one camera, from its pictures to the corrected robot, on the command line."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

import urdfcal
from tests.halved import halved
from urdfcal.cli import run
from urdfcal.detection.targets.find import Found

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "session"
    assert run(["simulate", "panda_handeye", "-o", str(folder), "--images", "--poses", "10", "--seed", "1"]) == 0
    return folder


def test_pictures_of_a_board_by_a_camera_in_the_hand_calibrate_the_arm(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(pictures), "-o", str(tmp_path / "out")]) == 0
    assert "looking for" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "panda_calibrated.urdf", "calibration.json", "calibration.rrd", "report.html",
    }  # fmt: skip
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    truth = json.loads((pictures / "truth.json").read_text())
    found = document["targets"]["board"]
    assert found["link"] == "world"
    np.testing.assert_allclose(found["T_link_target"], truth["targets"]["board"], atol=1e-3)
    assert all(0.0 < sigma < 1e-3 for sigma in found["sigma"])
    assert document["fit"]["rms_px"] < 0.3 < document["fit"]["rms_nominal_px"]
    assert document["scale"]["tip_mm_per_permille"] > 0.1
    assert "target board fixed in the world" in (tmp_path / "out" / "report.html").read_text()


def test_detections_are_written_over_by_force_alone(pictures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    detections = pictures / "detections.csv"
    if not detections.exists():
        assert run(["detect", str(pictures)]) == 0
    detections.write_text("mine")
    assert run(["detect", str(pictures)]) == 2
    assert "there are detections already. Use --force" in capsys.readouterr().err
    assert detections.read_text() == "mine"
    drawings = pictures.parent / "drawings"
    assert run(["detect", str(pictures), "--force", "--debug-images", str(drawings)]) == 0
    assert detections.read_text().startswith("pose,camera,led,u,v,sigma\n01,hand,board:0,")
    assert len(list(drawings.glob("hand/*.png"))) == 10


def test_another_board_than_the_one_named_is_said_with_what_was_seen(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = yaml.safe_load((pictures / "session.yaml").read_text())
    content["targets"]["board"]["dictionary"] = "DICT_6X6_250"
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(content))
    for name in ("cameras.yaml", "joints.csv"):
        (tmp_path / name).symlink_to(pictures / name)
    (tmp_path / "images" / "hand").mkdir(parents=True)
    for picture in sorted((pictures / "images" / "hand").iterdir())[:3]:
        (tmp_path / "images" / "hand" / picture.name).symlink_to(picture)
    assert run(["detect", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "target 'board' is found in 0 of 3 images" in said
    assert "markers of DICT_5X5 up to number 16 were found, DICT_6X6_250 asked for" in said
    assert "neither dark nor glaring" not in said
    assert not (tmp_path / "detections.csv").exists()


def test_another_kind_of_board_is_said_before_every_picture_is_searched(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def in_vain(*_: object) -> Found:
        searched.append(1)
        return Found(np.full((1, 2), np.nan), np.full(1, np.nan), "it is not found")

    searched: list[int] = []
    for module in ("alternatives", "search"):
        monkeypatch.setattr(f"urdfcal.detection.targets.{module}.find_target", in_vain)
    content = yaml.safe_load((pictures / "session.yaml").read_text())
    content["targets"]["board"] = {"kind": "chessboard", "size": [5, 7], "square": 0.036, "link": "world"}
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(content))
    for name in ("cameras.yaml", "joints.csv", "images"):
        (tmp_path / name).symlink_to(pictures / name)
    assert run(["detect", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "markers of DICT_5X5 up to number 16 were found, a chessboard asked for. Write under targets what" in said
    assert len(searched) == 3


def test_a_board_that_looks_the_same_turned_around_is_read_as_the_arm_turns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, session = halved("panda_handeye", tmp_path / "rig"), tmp_path / "session"
    content = yaml.safe_load((rig / "rig.yaml").read_text())
    board = {"kind": "chessboard", "size": [6, 4], "square": 0.04, "link": "world"}
    content["targets"]["board"] = {**content["targets"]["board"], **board}
    for key in ("marker", "dictionary"):
        del content["targets"]["board"][key]
    (rig / "rig.yaml").write_text(yaml.safe_dump(content))
    assert run(["simulate", str(rig), "-o", str(session), "--images", "--poses", "14", "--seed", "1"]) == 0
    for known in (True, False):
        assert run(["detect", str(session), "--force"]) == 0
        found, truth = places(session / "detections.csv"), places(session / "truth_detections.csv")
        # As it is fastened where that is given, else one way in all.
        right = [np.linalg.norm(at - truth[of]) < 1.0 for of, at in found.items()]
        assert all(right) or not (known or any(right))
        assert len(found) > 0.8 * len(truth)
        content = yaml.safe_load((session / "session.yaml").read_text())
        for key in ("position", "rpy", "sigma"):
            content["targets"]["board"].pop(key, None)
        (session / "session.yaml").write_text(yaml.safe_dump(content))
    assert urdfcal.calibrate(session).document.fit.rms_px < 0.3
    # With another arm's readings no way round fits.
    rows = (session / "joints.csv").read_text().splitlines()
    head, order = rows[0], [*rows[8:], *rows[1:8]]
    names = [row.split(",")[0] for row in rows[1:]]
    mixed = [",".join([name, *row.split(",")[1:]]) for name, row in zip(names, order, strict=True)]
    (session / "joints.csv").write_text("\n".join([head, *mixed, ""]))
    capsys.readouterr()
    assert run(["detect", str(session), "--force"]) == 2
    assert "target 'board' looks the same turned around, and" in capsys.readouterr().err


def places(path: Path) -> dict[tuple[str, str, str], np.ndarray]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["pose"], row["camera"], row["led"]): np.array([float(row["u"]), float(row["v"])]) for row in rows}
