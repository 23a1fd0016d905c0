from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.formats import read_kalibr, write_kalibr
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError, OutputError

if TYPE_CHECKING:
    from pathlib import Path

KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  distortion_model: radtan
  intrinsics: [461.629, 460.152, 362.68, 246.049]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -8.121e-05
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.07]
  - [-1.0, 0.0, 0.0, -0.02]
  - [0.0, 0.0, 1.0, 0.004]
  - [0.0, 0.0, 0.0, 1.0]
cam1:
  T_cn_cnm1:
  - [0.9999, 0.0, -0.01414178, -0.11]
  - [0.0, 1.0, 0.0, 0.0004]
  - [0.01414178, 0.0, 0.9999, -0.0009]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 2e-3, 1E-4, .5]
  distortion_model: equidistant
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
"""


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "cameras.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def turned(rng: np.random.Generator, shift: float = 0.5) -> np.ndarray:
    """A random T_a_b."""
    Q, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(upper))
    T = np.eye(4)
    T[:3, :3] = Q * np.linalg.det(Q)
    T[:3, 3] = rng.uniform(-shift, shift, 3)
    return T


def random_rig(seed: int, names: list[str]) -> Rig:
    rng = np.random.default_rng(seed)
    models = [("radtan", 4), ("radtan", 5), ("equidistant", 4), ("none", 0)]
    cameras = []
    for i, name in enumerate(names):
        model, count = models[i % len(models)]
        intrinsics = rng.uniform([1000, 1000, 600, 450], [1500, 1500, 700, 550])
        cameras.append(Camera(name, (1280, 1024), intrinsics, model, rng.normal(0.0, 1e-3, count)))
    return Rig(tuple(cameras), (np.eye(4), *(turned(rng) for _ in names[1:])))


def assert_same_cameras(got: Rig, expected: Rig) -> None:
    assert got.names == expected.names
    for a, b in zip(got.cameras, expected.cameras, strict=True):
        assert a.resolution == b.resolution
        assert a.distortion_model == b.distortion_model
        np.testing.assert_array_equal(a.parameters, b.parameters)


def test_a_file_as_kalibr_writes_it(tmp_path: Path) -> None:
    rig = read_kalibr(written(tmp_path, KALIBR))
    assert rig.names == ("cam0", "cam1")
    first, second = rig.cameras
    assert first.resolution == (752, 480)
    assert first.parameters.tolist() == [
        461.629,
        460.152,
        362.68,
        246.049,
        -0.27695497,
        0.06712482,
        8.7538e-4,
        1.1556e-4,
    ]
    assert second.distortion_model == "equidistant"
    assert second.distortion.tolist() == [-0.01, 2e-3, 1e-4, 0.5]
    np.testing.assert_array_equal(rig.T_cam_world[0], np.eye(4))
    T = rig.T_cam_world[1]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(T[0], [0.9999, 0.0, -0.01414178, -0.11], rtol=0, atol=1e-6)


def test_the_chain_is_multiplied_from_camera_to_camera(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    T_1_0, T_2_1 = turned(rng), turned(rng)
    file = yaml.safe_load(KALIBR)
    file["cam1"]["T_cn_cnm1"] = T_1_0.tolist()
    file["cam2"] = {**file["cam1"], "T_cn_cnm1": T_2_1.tolist()}
    rig = read_kalibr(written(tmp_path, yaml.safe_dump(file)))
    np.testing.assert_array_equal(rig.T_cam_world[1], T_1_0)
    point = np.array([0.1, 0.2, 0.3, 1.0])
    np.testing.assert_allclose(rig.T_cam_world[2] @ point, T_2_1 @ (T_1_0 @ point), rtol=0, atol=1e-15)


def test_a_missing_step_leaves_all_later_places_open(tmp_path: Path) -> None:
    file = yaml.safe_load(KALIBR)
    file["cam2"] = dict(file["cam1"])
    del file["cam1"]["T_cn_cnm1"]
    rig = read_kalibr(written(tmp_path, yaml.safe_dump(file)))
    assert [T is None for T in rig.T_cam_world] == [False, True, True]


def test_numbered_cameras_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    rig = random_rig(1, [f"cam{i}" for i in range(12)])
    path = tmp_path / "cameras.yaml"
    write_kalibr(path, rig)
    in_order = path.read_text()
    path.write_text(yaml.safe_dump(yaml.safe_load(in_order)))  # sorted as text, as Kalibr does: cam0, cam1, cam10 ...
    assert path.read_text().index("cam10:") < path.read_text().index("cam2:")
    assert_same_cameras(read_kalibr(path), rig)


def test_other_names_are_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = KALIBR.replace("cam0:", "right_eye:").replace("cam1:", "left_eye:")
    assert read_kalibr(written(tmp_path, text)).names == ("right_eye", "left_eye")


def test_shorter_spellings(tmp_path: Path) -> None:
    text = KALIBR.replace("equidistant", "equi")
    assert read_kalibr(written(tmp_path, text)).cameras[1].distortion_model == "equidistant"
    text = re.sub("  distortion_coeffs.*\n  distortion_model: radtan", "  distortion_model: none", KALIBR)
    assert read_kalibr(written(tmp_path, text)).cameras[0].distortion.shape == (0,)


@pytest.mark.parametrize("seed", range(5))
def test_every_number_comes_back(tmp_path: Path, seed: int) -> None:
    rig = random_rig(seed, ["right", "left", "no", "4", "up: #1"])
    path = tmp_path / "cameras.yaml"
    write_kalibr(path, rig)
    again = read_kalibr(path)
    assert_same_cameras(again, rig)
    np.testing.assert_array_equal(again.T_cam_world[1], rig.T_cam_world[1])
    for got, expected in zip(again.T_cam_world, rig.T_cam_world, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-15)
    assert [entry.name for entry in tmp_path.iterdir()] == ["cameras.yaml"]


def test_how_well_the_scale_is_known_stands_with_the_first_camera(tmp_path: Path) -> None:
    rig = replace(read_kalibr(written(tmp_path, KALIBR)), scale_sigma=1.3e-3)
    write_kalibr(path := tmp_path / "scaled.yaml", rig)
    assert read_kalibr(path).scale_sigma == rig.scale_sigma == rig.at(np.array([0])).scale_sigma
    text = path.read_text()
    for wrong, message in (("-0.1", "is no standard deviation of a share"), ("one", "is not a finite number")):
        path.write_text(text.replace("urdfcal_scale_sigma: 0.0013", f"urdfcal_scale_sigma: {wrong}"))
        with pytest.raises(CameraError, match=rf"scaled.yaml:\d+:\d+ \(cam0.urdfcal_scale_sigma\).*{message}"):
            read_kalibr(path)
    path.write_text(text.replace("  urdfcal_scale_sigma: 0.0013\n", "") + "  urdfcal_scale_sigma: 0.0013\n")
    with pytest.raises(CameraError, match="It belongs to the first camera"):
        read_kalibr(path)
    with pytest.raises(CameraError, match="makes no sense"):
        replace(rig, scale_sigma=-1.0)


def test_unknown_places_come_back_unknown(tmp_path: Path) -> None:
    rig = random_rig(3, ["a", "b", "c"])
    rig = Rig(rig.cameras, (np.eye(4), rig.T_cam_world[1], None))
    write_kalibr(tmp_path / "cameras.yaml", rig)
    assert "T_cn_cnm1" not in (tmp_path / "cameras.yaml").read_text().split("c:\n")[-1]
    assert read_kalibr(tmp_path / "cameras.yaml").T_cam_world[2] is None


def test_what_a_camchain_cannot_say_is_refused(tmp_path: Path) -> None:
    rig = random_rig(4, ["a", "b", "c"])
    path = tmp_path / "cameras.yaml"
    with pytest.raises(CameraError, match=r"place of 'c' is known, that of 'b' before it is not. Put"):
        write_kalibr(path, Rig(rig.cameras, (np.eye(4), None, rig.T_cam_world[2])))
    with pytest.raises(CameraError, match="cam1, cam0 are not in the order of their numbers"):
        write_kalibr(path, random_rig(5, ["cam1", "cam0"]))
    with pytest.raises(OutputError):
        write_kalibr(tmp_path / "nowhere" / "cameras.yaml", rig)
    assert not list(tmp_path.iterdir())


INTRINSICS = "intrinsics: [461.629, 460.152, 362.68, 246.049]"
STEP = """\
  - [0.9999, 0.0, -0.01414178, -0.11]
  - [0.0, 1.0, 0.0, 0.0004]
  - [0.01414178, 0.0, 0.9999, -0.0009]
  - [0.0, 0.0, 0.0, 1.0]
  camera"""
COEFFICIENTS = "  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]\n"


def with_step(*rows: list[float]) -> tuple[str, str]:
    return STEP, "".join(f"  - {row}\n" for row in rows) + "  camera"


X, Y, Z, LAST = [1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]

# What is replaced in the file above, by what, and what is then said.
BROKEN = {
    "omni": ("model: pinhole", "model: omni", r"yaml:3:17 \(cam0.camera_model\): camera model 'omni' is"),
    "model list": ("model: pinhole", "model: [pinhole]", r"\(cam0.camera_model\): camera_model must be one word"),
    "no model": ("  camera_model: pinhole\n", "", r"\(cam0.camera_model\): camera_model is missing"),
    "fov": ("model: radtan", "model: fov", r"5:21 \(cam0.distortion_model\): .* 'fov' is not supported. Use one of: r"),
    "unknown key": ("cam_overlaps", "cam_overlap", r"yaml:2:16: key 'cam_overlap' of camera 'cam0' .* Allowed: "),
    "no coefficients": (COEFFICIENTS, "", r"\(cam0.distortion_coeffs\): distortion_coeffs is missing"),
    "three coefficients": (", 0.00011556]", "]", r"\(cam0\): radtan distortion takes 4 or 5 coefficients, 3 are given"),
    "no intrinsics": (f"  {INTRINSICS}\n", "", r"\(cam0.intrinsics\): intrinsics is missing"),
    "three intrinsics": (", 246.049]", "]", r"\(cam0\): intrinsics need the 4 numbers fx fy cx cy, 3 are given"),
    "decimal comma": ("461.629, 460", "461,629, 460", r"intrinsics need the 4 numbers fx fy cx cy, 5"),
    "text": ("461.629,", "wide,", r"yaml:6:16 \(cam0.intrinsics\): 'wide' is not a finite number"),
    "NaN": ("461.629,", ".nan,", r"yaml:6:16 \(cam0.intrinsics\): '.nan' is not a finite number"),
    "too large": ("461.629,", "1e999,", r"'1e999' is not a finite number"),
    "true": ("461.629,", "true,", "'true' is not a finite number"),
    "nested": ("461.629,", "[461.629],", "'a nested value' is not a finite number"),
    "no list": (INTRINSICS, "intrinsics: 461.6", r"yaml:6:15 \(cam0.intrinsics\): intrinsics must be a list of num"),
    "millimetres": (INTRINSICS, "intrinsics: [6.0, 6.0, 362, 246]", r"\(cam0\): focal length \(6, 6\) .*millimetres"),
    "normalised": (INTRINSICS, "intrinsics: [461, 461, 0.48, 0.51]", r"\(cam0\): principal point \(0.48, 0.51\) .*cor"),
    "fractional size": ("[752, 480]", "[752.5, 480]", r"\(cam0.resolution\): resolution \[752.5, 480.0\] is not"),
    "negative size": ("[752, 480]", "[752, -480]", r"\(cam0.resolution\): resolution .* whole positive"),
    "one size": ("[752, 480]", "[752]", r"\(cam0.resolution\): resolution .* whole positive"),
    "line time in us": (INTRINSICS, f"{INTRINSICS}\n  line_time: 22", "line_time 22 .* is no time from one row"),
    "line time": (INTRINSICS, f"{INTRINSICS}\n  line_time: fast", r"\(cam0.line_time\): 'fast' is not a finite"),
    "duplicate camera": ("cam1:", "cam0:", r"yaml:15:1: 'cam0' stands here a second time"),
    "duplicate key": ("  rostopic:", f"  {INTRINSICS}\n  rostopic:", r"yaml:8:3: 'intrinsics' stands here a second"),
    "gap": ("cam1:", "cam2:", "'cam2' comes after 'cam0': .* a camera that is missing. Number the cameras"),
    "syntax": ("[752, 480]", "[752, 480", r"yaml:8:11: this is not YAML: "),
    "tab": ("  cam_overlaps", "\tcam_overlaps", r"yaml:2:1: this is not YAML: found character '\\t'"),
    "alias": ("cam_overlaps: [1]", "cam_overlaps: *x", r"yaml:2:17: this is not YAML: found undefined alias"),
    "camera without keys": (KALIBR, "cam0: pinhole", r"yaml:1:7: the keys of 'cam0' are expected here"),
    "a list of cameras": (KALIBR, "- cam0\n- cam1\n", r"yaml:1:1: cameras by name are expected here"),
    "a word": (KALIBR, "cameras", "yaml:1:1: cameras by name are expected here"),
    "key is a list": (KALIBR, "[1, 2]: 3", "yaml:1:1: a key must be one word"),
    "empty": (KALIBR, "", "yaml: the file holds nothing"),
    "only a comment": (KALIBR, "# nothing\n", "the file holds nothing"),
    "empty mapping": (KALIBR, "{}", "the file holds nothing"),
    "two documents": (KALIBR, "a: 1\n---\nb: 2\n", r"yaml:2:1: this is not YAML: but found another document"),
    "binary": (KALIBR, "\x00\x01\x02", "this is not a YAML text file"),
    "deep": (KALIBR, "[" * 500, "this is not a YAML text file"),
    "first has a step": ("cam_overlaps:", "T_cn_cnm1:", r"\(cam0.T_cn_cnm1\): the first camera has no camera"),
    "three rows": (*with_step(X, Y, Z), r"\(cam1.T_cn_cnm1\): .*must have 4 rows of 4 numbers"),
    "short row": (*with_step(X, Y, Z, [0, 0, 1]), r"17:3 \(cam1.T_cn_cnm1\): T_cn_cnm1 must have 4 rows of 4"),
    "scalar step": (f"\n{STEP}", " 1\n  camera", r"\(cam1.T_cn_cnm1\): T_cn_cnm1 must have 4 rows"),
    "transposed": (
        *with_step([1, 0, 0, 0], Y, Z, [-0.11, 0, 0, 1]),
        r"last row of T_cn_cnm1 is \[-0.11, 0.0, 0.0, 1.0\], .* Rows and columns are exchanged",
    ),
    "last row": (*with_step(X, Y, Z, [0, 0, 0, 0]), r"last row of T_cn_cnm1 is .* not \[0, 0, 0, 1\]"),
    "swapped rows": (*with_step(Y, X, Z, LAST), r"is mirrored \(determinant -1\). Two of its rows are exchanged"),
    "mirrored": (*with_step([-1, 0, 0, 0.1], Y, Z, LAST), "is mirrored"),
    "skewed": (*with_step([1, 0.01, 0, 0.1], Y, Z, LAST), r"rotation part of T_cn_cnm1 is off by 0.01 from a rotation"),
    "scaled": (*with_step([2, 0, 0, 0.1], [0, 2, 0, 0], [0, 0, 2, 0], LAST), "off by 3 from a rotation matrix"),
    "millimetre baseline": (*with_step([1, 0, 0, -110], Y, Z, LAST), "are 110 m apart; it looks like millimetres"),
    "placeholder": (*with_step([1, 0, 0, 0], Y, Z, LAST), "are in the same place. Leave T_cn_cnm1 out"),
}  # fmt: skip


def test_how_fast_a_rolling_shutter_rolls_stands_beside_the_camera(tmp_path: Path) -> None:
    for said, expected in (
        ("line_time: 2.2e-5", (2.2e-5, 2.2e-6)),
        ("line_time: 2.2e-5\n  line_time_sigma: 0", (2.2e-5, 0.0)),
        ("line_time_sigma: 3e-5", (0.0, 3e-5)),
    ):
        rig = read_kalibr(written(tmp_path, KALIBR.replace(INTRINSICS, f"{INTRINSICS}\n  {said}", 1)))
        first, second = rig.cameras
        assert (first.line_time, first.line_time_sigma) == pytest.approx(expected)
        assert first.rolling
        assert not second.rolling
        write_kalibr(tmp_path / "again.yaml", rig)
        again = read_kalibr(tmp_path / "again.yaml").cameras[0]
        assert (again.line_time, again.line_time_sigma) == (first.line_time, first.line_time_sigma)


@pytest.mark.parametrize(("old", "new", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_file_is_refused_with_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in KALIBR
    path = written(tmp_path, KALIBR.replace(old, new, 1))
    with pytest.raises(CameraError, match=message) as caught:
        read_kalibr(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_or_not_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"missing.yaml: the file cannot be read: No such file"):
        read_kalibr(tmp_path / "missing.yaml")
    with pytest.raises(CameraError, match="cannot be read: Is a directory"):
        read_kalibr(tmp_path)
    with pytest.raises(CameraError, match="this is not a YAML text file"):
        read_kalibr(written(tmp_path, b"cam0: \xff\xfe"))


def test_nothing_in_a_file_is_executed(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    text = KALIBR.replace("rostopic: /cam0/image_raw", f"rostopic: !!python/object/apply:os.mkdir ['{mark}']")
    assert read_kalibr(written(tmp_path, text)).names == ("cam0", "cam1")
    assert not mark.exists()
