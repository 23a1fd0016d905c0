"""Samples of hand-eye calibrations, from the files that others write to where the camera is."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from urdfcal.cli import run

if TYPE_CHECKING:
    from pathlib import Path

SIGMA, SIGMA_RAD = 1e-3, 2e-3


def pose(rotvec: Any, xyz: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), xyz
    return T


CAMERA = {"hand": pose([0.1, -0.2, 1.5], [0.05, 0.02, 0.07]), "base": pose([2.0, 0.3, -0.4], [1.0, 0.1, 0.6])}
TARGET = {"hand": pose([3.0, 0.1, 0.2], [0.5, 0.1, 0.02]), "base": pose([0.2, 0.1, 0.3], [0.0, 0.05, 0.1])}


def sampled(eye: str, count: int = 25) -> list[tuple[np.ndarray, np.ndarray]]:
    """T_base_hand and T_cam_target."""
    rng, samples = np.random.default_rng(1), []
    for _ in range(count):
        T_base_hand = pose(rng.normal([3, 0, 0], 0.5), rng.uniform([0.25, -0.2, 0.3], [0.65, 0.2, 0.7]))
        T_other_eye = T_base_hand if eye == "hand" else np.linalg.inv(T_base_hand)
        seen = np.linalg.inv(T_other_eye @ CAMERA[eye]) @ TARGET[eye]
        noise = pose(rng.normal(scale=SIGMA_RAD, size=3), np.zeros(3))
        seen = seen @ noise
        seen[:3, 3] += rng.normal(scale=SIGMA, size=3)
        samples.append((T_base_hand, seen))
    return samples


def transform(T: np.ndarray) -> dict:
    q = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", q.tolist(), strict=True)),
    }


def easy(eye: str, *, told: bool = True) -> dict:
    names = {"robot_base_frame": "base_link", "robot_effector_frame": "flange", "tracking_marker_frame": "tag"}
    parameters = {"calibration_type": f"eye_{'in_hand' if eye == 'hand' else 'on_base'}" if told else "", **names}
    robots = ((T if eye == "hand" else np.linalg.inv(T), seen) for T, seen in sampled(eye))
    pairs = [{"robot": transform(robot), "tracking": transform(seen)} for robot, seen in robots]
    return {"parameters": {**parameters, "move_group": "arm"}, "samples": pairs}


def moveit(eye: str) -> list[dict]:
    return [
        {"effector_wrt_world": T.ravel().tolist(), "object_wrt_sensor": seen.ravel().tolist()}
        for T, seen in sampled(eye)
    ]


@pytest.mark.parametrize(("kind", "eye"), [("easy", "hand"), ("easy", "base"), ("moveit", "hand"), ("moveit", "base")])
def test_the_camera_is_found_where_it_is(
    tmp_path: Path, kind: str, eye: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, said = tmp_path / f"a.{'samples' if kind == 'easy' else 'yaml'}", ["--eye", eye] if kind == "moveit" else []
    path.write_text(yaml.safe_dump(easy(eye) if kind == "easy" else moveit(eye)))
    assert run(["import", str(path), "-o", str(tmp_path / "s"), *said]) == 0
    assert f"{path}: 25 samples, the camera is on" in capsys.readouterr().out
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    carrier = {"easyhand": "flange", "easybase": "base_link", "moveithand": "hand", "moveitbase": "base"}[kind + eye]
    assert f"tracker in {carrier}: " in printed
    assert "Trust it" in printed
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    # A camera is found; of an arm of which nothing was estimated nothing is claimed.
    assert "nothing of it was estimated: of its tip nothing is claimed" in printed
    assert "tip" not in found
    assert found["fit"]["rms_mm"] == pytest.approx(1e3 * SIGMA * 3**0.5, rel=0.2)
    assert run(["export", str(tmp_path / "out"), "--to", "ros-static-tf"]) == 0
    nodes = ET.parse(tmp_path / "out" / "static_transforms.launch.xml").getroot()  # noqa: S314 - our own text
    words = next(words for node in nodes if "tracker" in (words := node.get("args", "").split()))
    value = {key: float(words[words.index(f"--{key}") + 1]) for key in ("x", "y", "z", "qx", "qy", "qz", "qw")}
    error = np.array([value[k] for k in "xyz"]) - CAMERA[eye][:3, 3]
    turn = Rotation.from_quat([value[k] for k in ("qx", "qy", "qz", "qw")]).inv() * Rotation.from_matrix(
        CAMERA[eye][:3, :3]
    )
    said_mm = float(printed.split(f"tracker in {carrier}: ")[1].split("± ")[1].split(" mm")[0])
    assert 0.3 < said_mm < 0.8
    assert np.abs(1e3 * error).max() < 3.0 * said_mm
    assert turn.magnitude() < 2e-3


def changed(**sample: Any) -> str:
    content = easy("hand")
    content["samples"][3] |= sample
    return yaml.safe_dump(content)


def in_millimetres(samples: list[dict]) -> list[dict]:
    return [
        {key: [1e3 * value if k in (3, 7, 11) else value for k, value in enumerate(T)] for key, T in sample.items()}
        for sample in samples
    ]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.samples", yaml.safe_dump(easy("hand", told=False)), "--eye hand or --eye base"),
        ("a.yaml", yaml.safe_dump(moveit("hand")), "the file does not say where the camera was"),
        ("a.yaml", "robot: {}\n", "these are no hand-eye samples"),
        ("a.samples", changed(tracking=None), "nothing stands where a mapping of keys to values belongs"),
        ("a.samples", changed(robot={"translation": {"x": 0, "y": 0, "z": 0}}), "'rotation' is missing"),
        (
            "a.samples",
            changed(robot=transform(np.eye(4)) | {"rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 2.0}}),
            "key 'robot.rotation': the quaternion is not of length 1",
        ),
        (
            "a.yaml",
            yaml.safe_dump([{"effector_wrt_world": [1.0] * 15, "object_wrt_sensor": [0.0] * 16}]),
            "a.yaml:1:3, key 'effector_wrt_world': it has 15 values, not the 16 of a matrix",
        ),
        (
            "a.yaml",
            yaml.safe_dump([{"effector_wrt_world": [1.0] * 16, "object_wrt_sensor": [0.0] * 16}]),
            "it is no pose",
        ),
        (
            "a.yaml",
            yaml.safe_dump(in_millimetres(moveit("hand"))),
            "more. Write positions in metres; if they are in millimetres, divide them by 1000.",
        ),
        (
            "a.samples",
            changed(tracking=transform(pose([0, 0, 0], [300.0, 0.0, 400.0]))),
            "key 'tracking': the position of sample 4, [300, 0, 400], is 500 m away. Write",
        ),
        ("a.samples", yaml.safe_dump(easy("hand") | {"samples": easy("hand")["samples"][:2]}), "2 poses are too few"),
        (
            "a.samples",
            yaml.safe_dump(
                easy("hand") | {"parameters": {"calibration_type": "eye_in_hand", "robot_base_frame": "hand"}}
            ),
            "base and hand are both called 'hand'",
        ),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, name: str, content: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(content)
    assert run(["import", str(tmp_path / name), "-o", str(tmp_path / "s")]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "s").exists()


def test_a_sample_that_is_wrong_is_named_by_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.samples").write_text(changed(tracking=5))
    assert run(["import", str(tmp_path / "a.samples"), "-o", str(tmp_path / "s")]) == 2
    line = next(
        k for k, text in enumerate((tmp_path / "a.samples").read_text().splitlines(), 1) if "tracking: 5" in text
    )
    assert f"a.samples:{line}:3, key 'tracking'" in capsys.readouterr().err


def test_an_eye_that_the_file_contradicts_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.samples").write_text(yaml.safe_dump(easy("base")))
    assert run(["import", str(tmp_path / "a.samples"), "--eye", "hand", "-o", str(tmp_path / "s")]) == 2
    assert "the file says that its camera is on the base, not the hand" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("eye", "rolled", "what"),
    [
        ("base", False, "(of hand-eye samples: the other --eye)"),
        ("hand", True, "the quaternions of poses.csv are in the order qw, qx, qy, qz"),
    ],
)
def test_samples_that_are_others_are_refused(
    tmp_path: Path, eye: str, rolled: bool, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(moveit("hand")))
    assert run(["import", str(tmp_path / "a.yaml"), "-o", str(tmp_path / "s"), "--eye", eye]) == 0
    head, *rows = [line.split(",") for line in (tmp_path / "s" / "poses.csv").read_text().splitlines()]
    assert head[-4:] == ["qx", "qy", "qz", "qw"]
    written = [[*row[:-4], row[-1], *row[-4:-1]] if rolled else row for row in rows]
    (tmp_path / "s" / "poses.csv").write_text("".join(",".join(row) + "\n" for row in (head, *written)))
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert what in said
    # The samples say nothing of noise: what residuals are of any size would be explained.
    assert ("nothing measures as badly as the residuals are, of which no noise is declared: pose_rad" in said) == rolled


def test_options_that_do_not_belong_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["import", "some.bag", "--eye", "hand", "-o", str(tmp_path / "s")]) == 2
    assert "--eye goes with hand-eye samples" in capsys.readouterr().err
    for option in ("--urdf", "--tip", "--base", "--led", "--camera=a=b", "--cameras", "--joints", "--targets"):
        words = [option] if "=" in option else [option, "a"]
        assert run(["import", "some.samples", *words, "-o", str(tmp_path / "s")]) == 2
        assert f"{option[:8]}" in (said := capsys.readouterr().err)
        assert "this is hand-eye samples" in said
    assert run(["import", "some.samples"]) == 2
    assert "-o is needed" in capsys.readouterr().err
