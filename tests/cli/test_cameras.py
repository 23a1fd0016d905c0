from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import click
import numpy as np
import pinocchio as pin
import pytest

from tests.cameras.board.boards import CHARUCO, PAIR, errors, held
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.board.detection import detect_board
from urdfcal.cameras.io.formats import read_cameras, read_kalibr, write_kalibr
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.cli.cameras import command
from urdfcal.errors import CameraError
from urdfcal.images.files import write_image

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from urdfcal.cameras.board.board import Board
    from urdfcal.cameras.board.corners import Corners

CHARUCO_OPTIONS = "--board charuco 10x7 --square 0.03 --marker 0.022 --dictionary DICT_5X5_100"
CHARUCO_FILE = "{type: charuco, columns: 10, rows: 7, square: 0.03, marker: 0.022, dictionary: DICT_5X5_100}"


@pytest.fixture(scope="module", autouse=True)
def looked_at_once() -> Iterator[None]:
    """The same board is looked for in the same picture once, which takes most of the time."""
    seen: dict[object, Corners | None] = {}

    def look(image: np.ndarray, board: Board) -> Corners | None:
        key = image.shape, image.tobytes(), board
        if key not in seen:
            seen[key] = detect_board(image, board)
        return seen[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("urdfcal.cameras.board.views.detect_board", look)
        yield


def cameras(*arguments: object) -> None:
    command.main([str(a) for a in arguments], prog_name="urdfcal cameras", standalone_mode=False)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(3)
    poses = held(PAIR, CHARUCO, 8, rng, far=0.55)
    for camera, T_cam_world in zip(PAIR.cameras, PAIR.T_cam_world, strict=True):
        (folder / camera.name).mkdir()
        renderer = BoardRenderer(camera)
        for i, T in enumerate(poses):
            image = renderer.render(CHARUCO, T_cam_world @ T, noise=2.0, rng=rng)
            write_image(folder / camera.name / f"{i}.png", image)
        write_image(folder / camera.name / "wall.png", np.full_like(image, 90))
    return folder


def test_a_folder_of_pictures_becomes_a_camera_file(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras(images, "-o", tmp_path / "a.yaml", *CHARUCO_OPTIONS.split())
    text = capsys.readouterr().out
    rig = read_kalibr(tmp_path / "a.yaml")
    assert rig.names == ("left", "right")
    sigma = np.concatenate([*(s.parameters for s in rig.sigmas), rig.sigmas[1].pose])
    assert np.abs(errors(rig, PAIR) / sigma).max() < 3.5
    for expected in ("charuco 10 x 7, 30 mm squares", "coverage", "tilt", "fx", "±", "left/wall not used: no board is"):
        assert expected in text
    assert f"{rig.cameras[0].intrinsics[0]:.3f}" in text


def test_the_measured_length_of_the_board_is_in_the_file_and_in_sessions(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], simulated: Callable
) -> None:
    cameras(images, "-o", tmp_path / "said.yaml", *CHARUCO_OPTIONS.split())
    assert "--measured 8 0.2003 0.0002" in " ".join(capsys.readouterr().out.split())
    cameras(images, "-o", tmp_path / "a.yaml", *CHARUCO_OPTIONS.split(), *["--measured", "8", "0.2424", "0.00048"])
    assert "30.3 mm squares" in (text := capsys.readouterr().out)
    assert "measured to 0.2 %" in " ".join(text.split())  # wherever it is wrapped
    said, rig = read_kalibr(tmp_path / "said.yaml"), read_kalibr(tmp_path / "a.yaml")
    assert (said.scale_sigma, rig.scale_sigma) == (None, pytest.approx(0.002, rel=0.02))
    np.testing.assert_allclose(rig.T_cam_world[1][:3, 3], 1.01 * said.T_cam_world[1][:3, 3], rtol=1e-6)
    session = simulated("ur5", poses=4).session
    assert replace(session, rig=rig).scale_sigma == rig.scale_sigma
    assert replace(session, rig=rig, scale_sigma=0.0).scale_sigma == 0.0
    assert session.scale_sigma is None
    with pytest.raises(CameraError, match=r"-11 % off squares of 0.03 m"):
        cameras(images, "-o", tmp_path / "b.yaml", *CHARUCO_OPTIONS.split(), *["--measured", "9", "0.2403", "0.0005"])
    assert not (tmp_path / "b.yaml").exists()


def test_the_board_may_be_described_in_the_folder_and_the_command_be_named(images: Path, tmp_path: Path) -> None:
    (images / "board.yaml").write_text(CHARUCO_FILE)
    cameras("-o", tmp_path / "b.yaml", images)
    cameras("calibrate", images, "-o", tmp_path / "c.yaml")
    assert (tmp_path / "b.yaml").read_bytes() == (tmp_path / "c.yaml").read_bytes()
    (images / "board.yaml").unlink()


def test_without_a_board_nothing_is_done(images: Path, tmp_path: Path) -> None:
    output = tmp_path / "cameras.yaml"
    with pytest.raises(CameraError, match=r"there is no board.yaml that describes the board. Write one"):
        cameras(images, "-o", output)
    for options, message in (
        ("--square 0.03", "go with --board"),
        ("--board charuco 10x7", "needs --square"),
        ("--board charuco ten --square 0.03", "not two whole numbers"),
        ("--board dots 9x6 --square 0.03", "dots"),
    ):
        with pytest.raises(click.UsageError, match=message):
            cameras(images, "-o", output, *options.split())
    with pytest.raises(CameraError, match="there is no such folder"):
        cameras(tmp_path / "nowhere", "-o", output, *CHARUCO_OPTIONS.split())
    (tmp_path / "two" / "left").mkdir(parents=True)
    for name in ("0.png", "1.png"):
        shutil.copy(images / "left" / name, tmp_path / "two" / "left")
    with pytest.raises(CameraError, match=r"camera 'left': only 0 of its .* markers of DICT_5X5 up to number"):
        cameras(tmp_path / "two", "-o", output, "--board", "chessboard", "12x9", "--square", "0.03")
    assert not output.exists()


def test_files_are_converted_there_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = tmp_path / "cameras.yaml"
    sigmas = CameraSigma(np.full(8, 0.1)), CameraSigma(np.full(8, 0.1), np.full(6, 1e-3))
    write_kalibr(start, Rig(PAIR.cameras, PAIR.T_cam_world, sigmas))
    cameras("convert", start, tmp_path / "stereo.yml")
    cameras("convert", tmp_path / "stereo.yml", tmp_path / "stereo.xml")
    assert capsys.readouterr().err.count("not kept: the standard deviations") == 1
    cameras("convert", tmp_path / "stereo.xml", tmp_path / "ros")
    assert {path.name for path in (tmp_path / "ros").iterdir()} == {"left.yaml", "right.yaml"}
    cameras("convert", tmp_path / "ros" / "left.yaml", tmp_path / "ros" / "right.yaml", tmp_path / "again.yaml")
    # The folder itself is read, too, from the first camera on, whatever the files are called.
    cameras("convert", tmp_path / "ros", tmp_path / "back.yaml")
    assert (tmp_path / "back.yaml").read_bytes() == (tmp_path / "again.yaml").read_bytes()
    (tmp_path / "ros" / "left.yaml").rename(tmp_path / "ros" / "z.yaml")
    cameras("convert", tmp_path / "ros", tmp_path / "back.yaml")
    assert (tmp_path / "back.yaml").read_bytes() == (tmp_path / "again.yaml").read_bytes()
    (tmp_path / "empty").mkdir()
    with pytest.raises(CameraError, match="there are no camera files"):
        cameras("convert", tmp_path / "empty", tmp_path / "back.yaml")
    capsys.readouterr()
    cameras("convert", start, tmp_path / "again.yaml")
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "again.yaml")
    rig = read_kalibr(tmp_path / "again.yaml")
    assert rig.names == PAIR.names
    for got, expected in zip(rig.cameras, PAIR.cameras, strict=True):
        np.testing.assert_array_equal(got.parameters, expected.parameters)
    np.testing.assert_allclose(rig.T_cam_world[1], PAIR.T_cam_world[1], rtol=0, atol=1e-14)


def test_the_format_may_be_named_and_a_missing_size_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_kalibr(tmp_path / "one.yaml", Rig(PAIR.cameras[:1], (np.eye(4),)))
    cameras("convert", tmp_path / "one.yaml", tmp_path / "info.yaml", "--to", "ros")
    assert "image_width: 640" in (tmp_path / "info.yaml").read_text()
    cameras("convert", tmp_path / "info.yaml", tmp_path / "cv.yml")
    text = (tmp_path / "cv.yml").read_text()
    (tmp_path / "cv.yml").write_text(text.replace("image_width", "w").replace("image_height", "h"))
    with pytest.raises(CameraError, match="Give it: --size 1280x1024"):
        cameras("convert", tmp_path / "cv.yml", tmp_path / "b.yaml")
    cameras("convert", "--size", "640x512", tmp_path / "cv.yml", tmp_path / "b.yaml")
    assert read_cameras([tmp_path / "b.yaml"]).cameras[0].resolution == (640, 512)
    with pytest.raises(click.UsageError, match="does not tell a format"):
        cameras("convert", tmp_path / "one.yaml", tmp_path / "b.txt")
    write_kalibr(tmp_path / "two.yaml", Rig(PAIR.cameras, (np.eye(4), None)))
    cameras("convert", tmp_path / "two.yaml", tmp_path / "two.yml")
    assert "not known: where right stands" in capsys.readouterr().err


def test_help_names_both_ways(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--help"], ["calibrate", "--help"], ["convert", "--help"]):
        cameras(*arguments)
    text = capsys.readouterr().out
    assert "BOARD_FOLDER -o OUT | convert IN... OUT" in text
    assert "inner corners" in text
    assert all(suffix in text for suffix in (".png", ".jpg", ".jpeg", ".tif"))
    assert "--to" in text


def test_a_pair_is_told_with_the_turn_between_its_cameras(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras(images, "-o", tmp_path / "a.yaml", *CHARUCO_OPTIONS.split())
    (row,) = [line.split() for line in capsys.readouterr().out.splitlines() if "turned against left (mrad)" in line]
    T = read_kalibr(tmp_path / "a.yaml").T_cam_world[1]
    assert float(row[-2]) == pytest.approx(1e3 * np.linalg.norm(pin.log3(T[:3, :3])), abs=1e-3)


def test_what_kalibr_itself_does_not_read_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for count, said in ((4, False), (5, True)):
        lens = {"distortion_model": "radtan", "distortion": np.array([0.1, 0.01, 0.001, 0.0, 0.02])[:count]}
        rig = Rig((replace(PAIR.cameras[0], **lens),), (np.eye(4),))
        write_kalibr(tmp_path / "a.yaml", rig)
        cameras("convert", tmp_path / "a.yaml", tmp_path / f"{count}.yaml")
        assert ("left: radtan with five coefficients" in capsys.readouterr().err) == said
