from __future__ import annotations

import re
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import yaml

from tests.cameras.board.boards import PAIR, placed, turned
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.formats import format_of, read_cameras, write_cameras
from urdfcal.cameras.io.kalibr import read_kalibr, write_kalibr
from urdfcal.cameras.io.opencv import read_opencv, write_opencv
from urdfcal.cameras.io.ros import read_ros, write_ros
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.errors import CameraError, OutputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SIZE = (1280, 1024)
K = [1400.123456789, 1 / 3 * 4200, 640.1, 511.7]
CAMERAS = [
    Camera("none", SIZE, K),
    Camera("radtan4", SIZE, K, "radtan", [-0.28, 0.1 + 0.02, 1.2e-3, -0.7e-3]),
    Camera("radtan5", SIZE, K, "radtan", [-0.30, 0.09, 1e-3, -5e-4, 1 / 97]),
    Camera("equidistant", SIZE, [620.0, 618.0, 630.0, 520.0], "equidistant", [-0.02, 0.01, -0.003, 1 / 3e4]),
]
FISHEYES = Rig((CAMERAS[3], CAMERAS[1]), (np.eye(4), placed([0.1, -0.2, 0.05], [-0.3, 0.05, 0.02])))
RIGS = [*(Rig((camera,), (np.eye(4),)) for camera in CAMERAS), PAIR, FISHEYES, Rig(PAIR.cameras, (np.eye(4), None))]
NAMES = [*(camera.name for camera in CAMERAS), "pair", "fisheyes", "unplaced"]
each_rig = pytest.mark.parametrize("rig", RIGS, ids=NAMES)


def assert_same(got: Rig, expected: Rig, tolerance: float = 0.0) -> None:
    assert got.names == expected.names
    for a, b in zip(got.cameras, expected.cameras, strict=True):
        assert (a.resolution, a.distortion_model) == (b.resolution, b.distortion_model)
        np.testing.assert_array_equal(a.parameters, b.parameters)
    for T, U in zip(got.T_cam_world, expected.T_cam_world, strict=True):
        assert (T is None) == (U is None)
        if T is not None:
            np.testing.assert_allclose(T, U, rtol=0, atol=tolerance)


@each_rig
@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencv_files_come_back_to_the_last_bit(tmp_path: Path, rig: Rig, suffix: str) -> None:
    path = tmp_path / f"cameras{suffix}"
    write_opencv(path, rig)
    assert format_of(path) == "opencv"
    assert_same(read_cameras([path]), rig)


@each_rig
def test_ros_files_come_back(tmp_path: Path, rig: Rig) -> None:
    paths = write_ros(tmp_path / ("cameras" if len(rig.cameras) > 1 else "camera.yaml"), rig)
    assert len(paths) == len(rig.cameras)
    assert all(format_of(path) == "ros" for path in paths)
    assert_same(read_cameras(paths), rig, 2e-15)


@each_rig
def test_kalibr_files_come_back_to_the_last_bit(tmp_path: Path, rig: Rig) -> None:
    paths = write_cameras(tmp_path / "cameras.yaml", rig, "kalibr")
    assert format_of(paths[0]) == "kalibr"
    assert_same(read_cameras(paths), rig)


@pytest.mark.parametrize("seed", range(5))
def test_any_pair_survives_all_formats(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turned(rng.normal(0.0, 0.5, 3)), rng.normal(0.0, 0.5, 3)
    rig = Rig(PAIR.cameras, (np.eye(4), T))
    write_opencv(tmp_path / "a.yml", rig)
    write_kalibr(tmp_path / "b.yaml", read_opencv([tmp_path / "a.yml"]))
    files = write_ros(tmp_path / "c", read_kalibr(tmp_path / "b.yaml"))
    write_opencv(tmp_path / "d.xml", read_ros(files))
    assert_same(read_cameras([tmp_path / "d.xml"]), rig, 1e-14)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencv_reads_what_is_written_and_projects_alike(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cameras{suffix}"
    rig = Rig((PAIR.cameras[0], CAMERAS[3]), PAIR.T_cam_world)
    write_opencv(path, rig)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, t = (storage.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T"))
    assert storage.getNode("camera_name1").string() == "left"
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.8], [0.3, 0.3, 1.5], (50, 3))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), M1, D1)[0].reshape(-1, 2)
    again = read_opencv([path])
    np.testing.assert_allclose(again.cameras[0].project(points), theirs, rtol=0, atol=1e-9)
    moved = points @ R.T + t.ravel()
    theirs = cv2.fisheye.projectPoints(moved[None], np.zeros(3), np.zeros(3), M2, D2)[0].reshape(-1, 2)
    T = again.T_cam_world[1]
    np.testing.assert_allclose(again.cameras[1].project(points @ T[:3, :3].T + T[:3, 3]), theirs, rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_what_opencv_writes_is_read(tmp_path: Path, suffix: str) -> None:
    intrinsics, extrinsics = tmp_path / f"intrinsics{suffix}", tmp_path / f"extrinsics{suffix}"
    R, t = np.array(PAIR.T_cam_world[1][:3, :3]), np.array(PAIR.T_cam_world[1][:3, 3:])
    storage = cv2.FileStorage(str(intrinsics), cv2.FILE_STORAGE_WRITE)
    for i, camera in enumerate(PAIR.cameras, start=1):
        fx, fy, cx, cy = camera.intrinsics
        storage.write(f"M{i}", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        storage.write(f"D{i}", np.concatenate([camera.distortion, np.zeros(10)])[None])
    storage.release()
    storage = cv2.FileStorage(str(extrinsics), cv2.FILE_STORAGE_WRITE)
    storage.write("R", R)
    storage.write("T", t)
    storage.release()
    rig = read_cameras([intrinsics, extrinsics], (640, 512))
    assert rig.names == ("cam0", "cam1")
    for got, expected in zip(rig.cameras, PAIR.cameras, strict=True):
        np.testing.assert_array_equal(got.parameters[:8], expected.parameters)
    np.testing.assert_array_equal(rig.T_cam_world[1], PAIR.T_cam_world[1])
    with pytest.raises(CameraError, match=r"does not tell the size of the image\. Give it: --size"):
        read_cameras([intrinsics, extrinsics])


SAMPLE = """\
%YAML:1.0
---
calibration_time: "Tue Nov 22 01:00:00 2011"
nr_of_frames: 14
image_width: 1280
image_height: 1024
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1400., 0., 640., 0., 1401., 512., 0., 0.,
       1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.e-01, 2.0000000000000000e-01, 0., 0., 0. ]
avg_reprojection_error: 2.1e-01
"""


def test_the_output_of_opencvs_calibration_sample_is_read(tmp_path: Path) -> None:
    path = tmp_path / "out_camera_data.yml"
    path.write_text(SAMPLE)
    camera = read_cameras([path]).cameras[0]
    assert camera.name == "out_camera_data"
    assert camera.parameters.tolist() == [1400.0, 1401.0, 640.0, 512.0, -0.1, 0.2, 0.0, 0.0, 0.0]
    fisheye = SAMPLE.replace("fisheye_model: 0", "fisheye_model: 1").replace("rows: 5", "rows: 4")
    path.write_text(fisheye.replace("0., 0., 0. ]", "0., 0. ]"))
    assert read_cameras([path]).cameras[0].distortion_model == "equidistant"


ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_left
camera_matrix:
  rows: 3
  cols: 3
  data: [438.76, 0, 305.59, 0, 437.27, 243.74, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3613, 0.1215, 0.0011, -0.0027, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.65, 0, 322.79, 0, 0, 393.65, 241.09, 0, 0, 0, 1, 0]
"""


def test_a_rectified_pair_tells_its_baseline(tmp_path: Path) -> None:
    left, right = tmp_path / "left.yaml", tmp_path / "right.yaml"
    left.write_text(ROS)
    right.write_text(ROS.replace("narrow_left", "narrow_right").replace("322.79, 0, 0,", "322.79, -47.238, 0,"))
    rig = read_cameras([left, right])
    assert rig.names == ("narrow_left", "narrow_right")
    np.testing.assert_allclose(rig.T_cam_world[1][:3, 3], [-0.12, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(rig.cameras[0].distortion, [-0.3613, 0.1215, 0.0011, -0.0027])
    swapped = read_cameras([right, left])
    np.testing.assert_allclose(swapped.T_cam_world[1][:3, 3], [0.12, 0.0, 0.0], atol=1e-12)
    # Two files as a driver's calibration leaves them, both of one name and neither rectified
    right.write_text(ROS)
    rig = read_cameras([left, right])
    assert rig.names == ("left", "right")
    assert rig.T_cam_world[1] is None


@pytest.mark.parametrize(
    "T", [PAIR.T_cam_world[1], np.linalg.inv(PAIR.T_cam_world[1]), placed([0.2, 0, 0], [0, 0.3, 0])]
)
def test_the_rectification_written_puts_both_pictures_on_common_lines(tmp_path: Path, T: np.ndarray) -> None:
    rig = Rig(PAIR.cameras, (np.eye(4), T))
    infos = [yaml.safe_load(path.read_text()) for path in write_ros(tmp_path / "pair", rig)]
    assert infos[0]["distortion_coefficients"]["data"][4] == 0.0
    middle = np.array([0.0, 0.0, 1.0]) * 0.8
    points = np.random.default_rng(0).normal(middle, 0.1, (20, 3))
    pixels = []
    for info, U in zip(infos, rig.T_cam_world, strict=True):
        R = np.array(info["rectification_matrix"]["data"]).reshape(3, 3)
        P = np.array(info["projection_matrix"]["data"]).reshape(3, 4)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert R[2, 2] > 0.5  # not upside down, not backwards
        seen = (points @ U[:3, :3].T + U[:3, 3]) @ R.T @ P[:, :3].T
        pixels.append(seen[:, :2] / seen[:, 2:])
        assert P[2, 3] == pytest.approx(0.0, abs=1e-12)
    difference = pixels[1] - pixels[0]
    across = 1 if abs(T[0, 3]) > abs(T[1, 3]) else 0
    np.testing.assert_allclose(difference[:, across], 0.0, atol=1e-9)
    assert np.abs(difference[:, 1 - across]).min() > 10.0


def test_what_a_format_cannot_say_is_refused(tmp_path: Path) -> None:
    three = Rig((*PAIR.cameras, CAMERAS[0]), (*PAIR.T_cam_world, None))
    with pytest.raises(CameraError, match=r"one camera or a pair, not of 3\. Write Kalibr"):
        write_ros(tmp_path / "x", three)
    with pytest.raises(CameraError, match="one camera or a pair, not 3"):
        write_opencv(tmp_path / "x.yml", three)
    behind = Rig(PAIR.cameras, (np.eye(4), placed([0, 0, 0], [0, 0, -0.5])))
    with pytest.raises(CameraError, match="cannot be rectified"):
        write_ros(tmp_path / "x", behind)
    opposite = Rig(PAIR.cameras, (np.eye(4), placed([0, np.pi, 0], [0.1, 0, 1.0])))
    with pytest.raises(CameraError, match="cannot be rectified"):
        write_ros(tmp_path / "x", opposite)
    named = Rig((Camera("a/b", SIZE, K), CAMERAS[0]), (np.eye(4), None))
    with pytest.raises(CameraError, match="'a/b' cannot be the name of a file"):
        write_ros(tmp_path / "x", named)
    with pytest.raises(OutputError):
        write_opencv(tmp_path / "nowhere" / "x.yml", PAIR)
    assert not list(tmp_path.iterdir())


def edited(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


BROKEN_ROS = {
    "rational": ("plumb_bob", "rational_polynomial", r"yaml:8:19 \(distortion_model\): .*'rational_polynomial' is not"),
    "no width": ("image_width: 640\n", "", r"\(image_width\): image_width is missing"),
    "fraction": ("640", "640.5", r"yaml:1:14 \(image_width\): image_width 640.5 is not a whole number"),
    "text": ("438.76", "wide", r"yaml:7:10 \(camera_matrix.data\): 'wide' is not a finite number"),
    "skew": ("438.76, 0,", "438.76, 0.1,", r"camera_matrix must be \[fx 0 cx"),
    "shape": ("rows: 3\n  cols: 3", "rows: 1\n  cols: 9", "camera_matrix must have 3 rows of 3 numbers"),
    "count": ("cols: 5", "cols: 4", r"yaml:12:9 \(distortion_coefficients.data\): 5 numbers do not make 1 rows of 4"),
    "eight": ("cols: 5\n  data: [", "cols: 8\n  data: [1, 2, 3, ", "takes 4 or 5 coefficients, 8 are given"),
    "millimetres": ("438.76, 0, 305.59, 0, 437.27", "4, 0, 305, 0, 4", "like millimetres"),
    "singular": ("data: [393.65, 0, 322.79", "data: [0, 0, 322.79", "left part of projection_matrix has no inverse"),
    "skewed R": ("[1, 0, 0, 0, 1, 0", "[1, 0.1, 0, 0, 1, 0", "is off by 0.1 from a rotation matrix"),
    "mm baseline": ("322.79, 0, 0,", "322.79, -47238, 0,", "are 120 m apart; it looks like millimetres"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BROKEN_ROS.values(), ids=BROKEN_ROS.keys())
def test_a_broken_camera_info_is_refused_with_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    left, right = tmp_path / "left.yaml", tmp_path / "right.yaml"
    left.write_text(ROS)
    right.write_text(edited(ROS.replace("322.79, 0, 0,", "322.79, -47.238, 0,") if old not in ROS else ROS, old, new))
    if "skewed" in message or "rotation" in message:
        right.write_text(right.read_text().replace("322.79, 0, 0,", "322.79, -47.238, 0,"))
    with pytest.raises(CameraError, match=message) as caught:
        read_cameras([left, right])
    assert str(right) in str(caught.value)
    assert "\n" not in str(caught.value)


BROKEN_OPENCV = {
    "rational": ("rows: 5", "rows: 8", "0., 0., 0. ]", "0., 0., 0., 1., 1., 1. ]", "rational model's 8 coefficients"),
    "skew": ("1400., 0.,", "1400., 2.,", "", "", r"camera_matrix must be \[fx 0 cx"),
    "count": ("rows: 3", "rows: 2", "", "", r"yml:13:10 \(camera_matrix.data\): 9 numbers do not make 2 rows of 3"),
    "NaN": ("1400.", ".Nan", "", "", r"yml:13:12 \(camera_matrix.data\): '.Nan' is not a finite number"),
    "other names": ("camera_matrix", "cam", "", "", "there is no camera matrix in it. It is called one of: camera_m"),
    "twice": ("flags: 0", "image_width: 3", "", "", "yml:7:1: 'image_width' stands here a second time"),
    "three sides": ("flags: 0", "imageSize: [3, 4, 5]", "image_width", "w", r"imageSize \[3.0, 4.0, 5.0\] is not"),
    "no size": ("image_width", "width", "", "", "does not tell the size of the image"),
    "unknown model": ("fisheye_model: 0", "distortion_model: fov", "", "", "distortion model 'fov' is not supported"),
    "deep": ("nr_of_frames: 14", "nr: " + "[" * 500, "", "", "this is not a YAML text file"),
    "syntax": ("data: [ 1400.", "data: [ 1400. [", "", "", "this is not YAML"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "also", "by", "message"), BROKEN_OPENCV.values(), ids=BROKEN_OPENCV.keys())
def test_a_broken_opencv_file_is_refused(tmp_path: Path, old: str, new: str, also: str, by: str, message: str) -> None:
    path = tmp_path / "camera.yml"
    path.write_text(edited(edited(SAMPLE, old, new), also, by))
    with pytest.raises(CameraError, match=message) as caught:
        read_cameras([path])
    assert str(path) in str(caught.value)


def test_a_rotation_or_translation_of_another_shape_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    write_opencv(path, PAIR)
    text = path.read_text()
    for old, new in (
        ("R: !!opencv-matrix\n   rows: 3\n   cols: 3", "R: !!opencv-matrix\n   rows: 1\n   cols: 9"),
        (
            "T: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ ",
            "T: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n   data: [ 0, ",
        ),
    ):
        path.write_text(edited(text, old, new))
        with pytest.raises(CameraError, match=r"\(R\): R must be 3 x 3 and T have three numbers"):
            read_opencv([path])


BROKEN_XML = {
    "entities": '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>',
    "unclosed": '<?xml version="1.0"?><opencv_storage><a>',
    "deep": "<a>" * 100_000,
    "no storage": "<a/>",
    "empty": '<?xml version="1.0"?><opencv_storage></opencv_storage>',
}


@pytest.mark.parametrize("text", BROKEN_XML.values(), ids=BROKEN_XML.keys())
def test_broken_xml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.xml"
    path.write_text(text)
    with pytest.raises(CameraError, match=re.escape(str(path))):
        read_cameras([path])


def test_files_of_different_formats_are_not_mixed(tmp_path: Path) -> None:
    write_kalibr(tmp_path / "a.yaml", PAIR)
    (tmp_path / "b.yaml").write_text(ROS)
    with pytest.raises(CameraError, match="different formats: kalibr, ros"):
        read_cameras([tmp_path / "a.yaml", tmp_path / "b.yaml"])
    with pytest.raises(CameraError, match="a camchain is one file"):
        read_cameras([tmp_path / "a.yaml", tmp_path / "a.yaml"])
    with pytest.raises(CameraError, match="cannot be read: No such file"):
        read_cameras([tmp_path / "none.yaml"])


def known(rig: Rig, seed: int = 0) -> Rig:
    """The rig with standard deviations."""
    rng = np.random.default_rng(seed)
    correlation = np.corrcoef(rng.normal(size=(60, 100)))
    correlation = 0.5 * (correlation + correlation.T)
    sigmas, before = [], 0
    for i, (camera, T) in enumerate(zip(rig.cameras, rig.T_cam_world, strict=True)):
        pose = None if i == 0 or T is None else rng.uniform(0, 1e-3, 6)
        end = before + len(camera.parameters) + (6 if pose is not None else 0)
        sigmas.append(CameraSigma(rng.uniform(0, 0.1, len(camera.parameters)), pose, correlation[before:end, :end]))
        before = end
    return Rig(rig.cameras, rig.T_cam_world, tuple(sigmas))


@each_rig
def test_standard_deviations_come_back_from_kalibr_files(tmp_path: Path, rig: Rig) -> None:
    path = tmp_path / "cameras.yaml"
    write_kalibr(path, known(rig))
    for got, expected in zip(read_kalibr(path).sigmas, known(rig).sigmas, strict=True):
        np.testing.assert_array_equal(got.parameters, expected.parameters)
        np.testing.assert_array_equal(got.correlations, expected.correlations)
        assert (got.pose is None) == (expected.pose is None)
        if got.pose is not None:
            np.testing.assert_array_equal(got.pose, expected.pose)
    write_kalibr(path, rig)
    assert read_kalibr(path).sigmas == (None,) * len(rig.cameras)


def contradict(sigma: dict) -> None:
    """The first two go together, the third with one of them and against the other."""
    for i, j, value in ((0, 1, 0.9), (0, 2, 0.9), (1, 2, -0.9)):
        sigma["correlations"][i][j] = sigma["correlations"][j][i] = value


BROKEN_SIGMA: dict[str, tuple[Callable[[dict], object], str]] = {
    "three": (lambda s: s["intrinsics"].pop(), r"cam.urdfcal_sigma.intrinsics\): intrinsics must be 4 standard dev"),
    "negative": (lambda s: s["intrinsics"].__setitem__(0, -1.0), "4 standard deviations, none negative"),
    "missing": (lambda s: s.pop("distortion_coeffs"), "distortion_coeffs is missing"),
    "too many": (lambda s: s["distortion_coeffs"].append(1.0), "must be 4 standard deviations"),
    "unknown": (lambda s: s.__setitem__("focus", 1.0), "key 'focus' of urdfcal_sigma is not known"),
    "text": (lambda s: s["intrinsics"].__setitem__(0, "wide"), "'wide' is not a finite number"),
    "short correlations": (lambda s: s["correlations"].pop(), r"cameras.yaml \(camera 'cam'\): its correlations are"),
    "ragged correlations": (lambda s: s["correlations"][0].pop(), "must have rows of equally many numbers"),
    "large correlation": (lambda s: s["correlations"][3].__setitem__(3, 1.1), "numbers from -1 to 1"),
    "lopsided correlations": (lambda s: s["correlations"][3].__setitem__(2, 0.123), "symmetric"),
    "contradictory correlations": (contradict, "correlations contradict each other"),
    "place of the world": (lambda s: s.__setitem__("T_cn_c0", [0.0] * 6), "T_cn_c0"),
}


@pytest.mark.parametrize(("change", "message"), BROKEN_SIGMA.values(), ids=BROKEN_SIGMA.keys())
def test_broken_standard_deviations_are_refused(tmp_path: Path, change: Callable[[dict], object], message: str) -> None:
    path = tmp_path / "cameras.yaml"
    camera = Camera("cam", SIZE, K, "radtan", [0.1, 0.0, 0.0, 0.0])
    write_kalibr(path, known(Rig((camera,), (np.eye(4),))))
    file = yaml.safe_load(path.read_text())
    change(file["cam"]["urdfcal_sigma"])
    path.write_text(yaml.safe_dump(file))
    with pytest.raises(CameraError, match=message):
        read_kalibr(path)


def test_a_rig_refuses_standard_deviations_of_something_else() -> None:
    eight, six = np.ones(8), np.ones(6)
    assert PAIR.sigmas == (None, None)
    Rig(PAIR.cameras, PAIR.T_cam_world, (CameraSigma(eight), CameraSigma(eight, six)))
    with pytest.raises(CameraError, match="2 cameras have 1 sets of standard deviations"):
        Rig(PAIR.cameras, PAIR.T_cam_world, (None,))
    with pytest.raises(CameraError, match="camera 'left': 8 parameters have 9 standard deviations"):
        Rig(PAIR.cameras, PAIR.T_cam_world, (CameraSigma(np.ones(9)), None))
    with pytest.raises(CameraError, match="camera 'left': its place is the world"):
        Rig(PAIR.cameras, PAIR.T_cam_world, (CameraSigma(eight, six), None))
    with pytest.raises(CameraError, match="camera 'right': its place is not known"):
        Rig(PAIR.cameras, (np.eye(4), None), (None, CameraSigma(eight, six)))
    assert PAIR.correlation.shape == (0, 0)
    loose = Rig(PAIR.cameras, PAIR.T_cam_world, (CameraSigma(eight), CameraSigma(2 * eight, 3 * six)))
    np.testing.assert_array_equal(loose.correlation, np.eye(22))
    for parameters, pose in ((-eight, None), (eight * np.nan, None), (eight, np.ones(5))):
        with pytest.raises(CameraError, match="make no sense"):
            CameraSigma(parameters, pose)
