from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import click
import numpy as np
import pytest

from tests.cameras.board.boards import CHARUCO, PAIR, errors, held
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.io.formats import read_cameras, read_kalibr, write_kalibr
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.cli.cameras import command
from urdfcal.errors import CameraError
from urdfcal.images.files import write_image

if TYPE_CHECKING:
    from pathlib import Path

CHARUCO_OPTIONS = "--board charuco 10x7 --square 0.03 --marker 0.022 --dictionary DICT_5X5_100"
CHARUCO_FILE = "{type: charuco, columns: 10, rows: 7, square: 0.03, marker: 0.022, dictionary: DICT_5X5_100}"


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
    assert "--to" in text
