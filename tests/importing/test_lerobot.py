"""Data sets of LeRobot: joint states in Parquet, videos, and LeRobot's own calibration of the motors."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.formats import write_kalibr
from urdfcal.cameras.rig import Rig
from urdfcal.cli import run
from urdfcal.images.files import read_image, write_video
from urdfcal.io.folder import read_positions, read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig

if TYPE_CHECKING:
    from collections.abc import Sequence

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
MOTORS = (*JOINTS, "gripper")
FPS, KEY = 30, "observation.images.front"
LENS = Camera("front", (64, 48), np.array([60.0, 60.0, 31.5, 23.5]))
# Steps between which each motor goes; as LeRobot's calibration has it.
RANGES = {name: (700 + 10 * k, 3300 - 7 * k) for k, name in enumerate(MOTORS)}


def stopping(stops: int, seed: int) -> np.ndarray:
    """Joint values (K, 5) of an arm that stops for a second, then goes on for half of one. [rad]"""
    at = np.random.default_rng(seed).uniform(-0.8, 0.8, (stops + 1, 5))
    way = np.linspace(0.0, 1.0, 15, endpoint=False)[:, None]
    return np.concatenate([np.vstack([np.repeat(a[None], 30, axis=0), a + way * (b - a)]) for a, b in pairwise(at)])


EPISODES = [stopping(3, 0), stopping(2, 1)]


def grey(episode: int, row: int) -> int:
    return 40 + 100 * episode + row // 2


def write_data_set(
    folder: Path, episodes: Sequence[np.ndarray], version: str, state: str = "degrees", **info: Any
) -> Path:
    """Write episodes of joint values in rad as LeRobot does, the gripper behind them."""
    rows: list[dict[str, list]] = []
    for e, q in enumerate(episodes):
        steps = np.array([RANGES[name] for name in JOINTS])
        raw = np.degrees(q) if state == "degrees" else np.degrees(q) * 4095 / 360 / np.diff(steps)[:, 0] * 200
        states = np.column_stack([np.clip(raw, -100, 100) if state == "normalized" else raw, np.full(len(q), 50.0)])
        frame = np.arange(len(q))
        columns = {
            "observation.state": states.astype(np.float32).tolist(),
            "timestamp": (frame / FPS).astype(np.float32),
        }
        rows.append({**columns, "frame_index": frame, "episode_index": np.full(len(q), e)})
    lengths = [len(q) for q in episodes]
    images = [[np.full((48, 64), grey(e, k), np.uint8) for k in range(n)] for e, n in enumerate(lengths)]
    (folder / "meta").mkdir(parents=True)
    if version == "v3.0":
        data, video = (
            "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        )
        start = np.concatenate([[0], np.cumsum(lengths)[:-1]])
        table = {
            "episode_index": list(range(len(lengths))),
            "length": lengths,
            f"videos/{KEY}/from_timestamp": start / FPS,
        }
        table |= {
            f"{of}/{name}": [0] * len(lengths)
            for of in ("data", f"videos/{KEY}")
            for name in ("chunk_index", "file_index")
        }
        (folder / "meta/episodes/chunk-000").mkdir(parents=True)
        pq.write_table(pa.table(table), folder / "meta/episodes/chunk-000/file-000.parquet")
        files = {
            folder / "data/chunk-000/file-000.parquet": {
                k: np.concatenate([of[k] for of in rows]).tolist() for k in rows[0]
            }
        }
        films = {folder / f"videos/{KEY}/chunk-000/file-000.mp4": [image for of in images for image in of]}
    else:
        data, video = (
            "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        )
        lines = [json.dumps({"episode_index": e, "tasks": ["calibrate"], "length": n}) for e, n in enumerate(lengths)]
        (folder / "meta/episodes.jsonl").write_text("\n".join([*lines, ""]))
        files = {folder / f"data/chunk-000/episode_{e:06d}.parquet": of for e, of in enumerate(rows)}
        films = {folder / f"videos/chunk-000/{KEY}/episode_{e:06d}.mp4": of for e, of in enumerate(images)}
    for path, table in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), path)
    for path, film in films.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_video(path, film, (64, 48), FPS)
    names = [f"main_{name}" if version == "v2.0" else f"{name}.pos" for name in MOTORS]
    features = {
        "observation.state": {
            "dtype": "float32",
            "shape": [6],
            "names": {"motors": names} if version == "v2.0" else names,
        }
    }
    features[KEY] = {"dtype": "video", "shape": [48, 64, 3]}
    content = {"codebase_version": version, "fps": FPS, "chunks_size": 1000, "data_path": data, "video_path": video}
    (folder / "meta/info.json").write_text(
        json.dumps({**content, "robot_type": "so101_follower", "features": features, **info}, indent=4)
    )
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    urdf = read_rig(find_rig("so101")).urdf
    assert urdf is not None
    (tmp_path / "so101.urdf").write_bytes(urdf.data)
    write_kalibr(tmp_path / "cams.yaml", Rig((LENS,), (np.eye(4),)))
    motors = {
        name: {"id": k, "drive_mode": 0, "homing_offset": -7, "range_min": a, "range_max": b}
        for k, (name, (a, b)) in enumerate(RANGES.items())
    }
    (tmp_path / "motors.json").write_text(json.dumps(motors))
    monkeypatch.chdir(tmp_path)
    return tmp_path


DEGREES = ["--state", "degrees"]
IMPORT = ["import", "data", "-o", "s", "--urdf", "so101.urdf", "--tip", "gripper_frame_link", "--cameras", "cams.yaml"]


@pytest.mark.parametrize(("version", "state"), [("v2.0", "degrees"), ("v2.1", "normalized"), ("v3.0", "degrees")])
def test_an_arm_that_stopped_gives_a_pose_and_an_image_a_stop(
    folder: Path, version: str, state: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_data_set(folder / "data", EPISODES, version, state)
    motors = ["--motors", "motors.json"] if state == "normalized" else []
    assert run([*IMPORT, "--stills", "--state", state, *motors]) == 0
    assert f"data: {sum(map(len, EPISODES))} frames of 2 episodes" in capsys.readouterr().out
    positions = read_positions(folder / "s")
    stops = np.concatenate([q[:-15][::45] for q in EPISODES])
    np.testing.assert_allclose(positions.readings, stops, atol=1e-6)
    images = [float(read_image(folder / "s/images/front" / f"{label}.png").mean()) for label in positions.poses]
    # Each from the middle of its stop, which is 30 frames long: 15 counts, and video is off by some.
    expected = [grey(e, 45 * k + 15) for e, q in enumerate(EPISODES) for k in range(len(q) // 45)]
    np.testing.assert_allclose(images, expected, atol=6.0)


def test_an_episode_begins_where_nobody_knows_how_the_arm_came_there(folder: Path) -> None:
    write_data_set(folder / "data", EPISODES, "v2.1")
    assert run([*IMPORT, "--stills", *DEGREES]) == 0
    poses = read_positions(folder / "s").poses
    rows = [f"{pose},front,led,{20 + k},{20 + k}" for k, pose in enumerate(poses)]
    (folder / "s/detections.csv").write_text("\n".join(["pose,camera,led,u,v", *rows, ""]))
    session = read_session(folder / "s")
    np.testing.assert_array_equal(session.came_from, session.q[[0, 0, 1, 3, 3]])


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_arm_that_moved_gives_a_log_and_frames_with_a_gap_between_episodes(
    folder: Path, version: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_data_set(folder / "data", EPISODES, version)
    assert run([*IMPORT, "--state", "degrees"]) == 0
    assert "times of data sets are counted, not taken" in capsys.readouterr().out
    positions = read_positions(folder / "s")
    (gap,) = (warning for warning in positions.warnings if "gaps of up to" in warning)
    assert "10" in gap
    frames = {positions.label(k): q for k, q in enumerate(positions.q)}
    assert len(frames) > 0.9 * sum(map(len, EPISODES))
    for label in ("000070", f"{len(EPISODES[0]) + 41:06d}"):
        e, row = (0, int(label) - 1) if int(label) <= len(EPISODES[0]) else (1, int(label) - 1 - len(EPISODES[0]))
        np.testing.assert_allclose(positions.chain.readings(frames[label][None])[0], EPISODES[e][row], atol=1e-5)
        assert float(read_image(folder / f"s/images/front/{label}.png").mean()) == pytest.approx(grey(e, row), abs=6.0)


def test_a_motor_at_the_end_of_its_range_says_nothing_of_its_joint(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q = stopping(5, 2)
    q[:30, 2] = 1.9  # 2576 steps are 1.977 rad to each side
    q[45:75, 1] = 2.1
    write_data_set(folder / "data", [q], "v2.1", "normalized")
    assert run([*IMPORT, "--stills", "--state", "normalized", "--motors", "motors.json"]) == 0
    assert "frames are left out, in which a joint is at an end of its range" in capsys.readouterr().out
    np.testing.assert_allclose(read_positions(folder / "s").readings, q[[0, 90, 135, 180]], atol=1e-6)


def test_a_motor_may_have_another_name_and_a_camera_be_on_the_arm(folder: Path) -> None:
    write_data_set(folder / "data", EPISODES[:1], "v2.1")
    info = folder / "data/meta/info.json"
    info.write_text(info.read_text().replace("elbow_flex.pos", "motor_3"))
    board = "targets:\n  board: {kind: chessboard, size: [7, 5], square: 0.03, link: world}\n"
    (folder / "board.yaml").write_text(board)
    write_kalibr(folder / "cams.yaml", Rig((replace(LENS, name="wrist"),), (np.eye(4),)))
    options = [
        "--column",
        "elbow_flex=motor_3",
        "--camera",
        f"wrist={KEY}",
        "--mount",
        "wrist=gripper_link",
        "--targets",
        "board.yaml",
    ]
    assert run([*IMPORT, "--stills", "--state", "degrees", *options]) == 0
    positions = read_positions(folder / "s")
    assert [(mount.camera, mount.link) for mount in positions.mounts] == [("wrist", "gripper_link")]
    assert [target.name for target in positions.targets] == ["board"]
    assert not positions.leds


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({}, [], "a data set needs --state"),
        ({}, ["--state", "normalized"], "how far the motors go from -100 to 100 is not known. Name LeRobot's"),
        ({}, [*DEGREES, "--motors", "motors.json"], "--motors goes with --state normalized"),
        ({}, [*DEGREES, "--decimal", "comma"], "--decimal goes with a table: this is a LeRobot data set"),
        ({}, [*DEGREES, "--camera", "front=top"], "there is no video 'top'. The videos are: observation."),
        ({}, [*DEGREES, "--camera", "frnt=front"], "--camera: there is no camera 'frnt'. Did you mean 'front'?"),
        ({}, [*DEGREES, "--camera", "front=front,x"], "--camera front=front,x: a data set has no camera_info; --cam"),
        ({}, [*DEGREES, "--column", "elbw_flex=x"], "--column: there is no joint 'elbw_flex'. Did you mean 'elbow_f"),
        ({}, [*DEGREES, "--column", "elbow_flex=x"], "there is no motor 'x' for elbow_flex. The motors are: should"),
        ({}, [*DEGREES, "--tip", "moving_jaw_so101_v1_link"], "the gripper as a share of its range, not as an"),
        ({"codebase_version": "v1.6"}, DEGREES, "'codebase_version': it is of format v1.6, not 2.0, 2.1 or 3.0"),
        ({"features": {}}, DEGREES, "there is no video 'front'"),
        ({"data_path": "data/{episode_index}.parquet"}, DEGREES, "data/data/0.parquet: there is no such file. Fet"),
        ({"fps": "fast"}, DEGREES, "'fast' stands where a number belongs"),
        ({"chunks_size": 0}, DEGREES, "'chunks_size': "),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    folder: Path, change: dict, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_data_set(folder / "data", EPISODES[:1], "v2.1", **change)
    assert run([*IMPORT, *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (folder / "s").exists()


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_damaged_files_are_named(folder: Path, version: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_data_set(folder / "whole", EPISODES[:1], version)
    broken = {
        "*.mp4": "this is no video",
        "data/*/*.parquet": "this cannot be read as Parquet",
        "meta/episodes*": "this describes no episode" if version == "v2.1" else None,
        "meta/episodes/*/*.parquet": None if version == "v2.1" else "this cannot be read as Parquet",
    }
    for pattern, message in broken.items():
        if message is None:
            continue
        shutil.copytree(folder / "whole", folder / "data")
        (path,) = (folder / "data").rglob(pattern)
        path.write_bytes(b"{}")
        assert run([*IMPORT, "--state", "degrees"]) == 2
        said = " ".join(capsys.readouterr().err.split())
        assert path.name in said
        assert message in said
        assert not (folder / "s").exists()
        shutil.rmtree(folder / "data")


def refused(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert run([*IMPORT, *options]) == 2
    assert not (Path("s")).exists()
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("text", ["", "1e999"])
def test_a_data_set_without_episodes_is_refused(folder: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_data_set(folder / "data", EPISODES[:1], "v2.1")
    episodes = folder / "data/meta/episodes.jsonl"
    episodes.write_text(text and episodes.read_text().replace(str(len(EPISODES[0])), text))
    said = refused(capsys, *DEGREES)
    assert ("episodes.jsonl:1: this describes no episode" if text else "episodes.jsonl: there is no episode") in said
    assert "Fetch the data set again" in said


@pytest.mark.parametrize("column", ["length", "data/file_index", f"videos/{KEY}/from_timestamp"])
def test_an_episode_without_its_numbers_is_refused(
    folder: Path, column: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_data_set(folder / "data", EPISODES, "v3.0")
    (path,) = (folder / "data/meta/episodes").rglob("*.parquet")
    table = pq.read_table(path).to_pydict()
    pq.write_table(pa.table({**table, column: [table[column][0], None]}), path)
    said = refused(capsys, *DEGREES)
    assert f"file-000.parquet: {column} is not a number for every episode. Fetch" in said


def test_states_that_are_no_numbers_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_data_set(folder / "data", EPISODES[:1], "v2.1")
    (path,) = (folder / "data/data").rglob("*.parquet")
    table = pq.read_table(path).to_pydict()
    pq.write_table(pa.table({**table, "observation.state": [None, *table["observation.state"][1:]]}), path)
    assert "observation.state of episode 0 is not 135 times 6 numbers. Fetch" in refused(capsys, *DEGREES)


@pytest.mark.parametrize("stills", [[], ["--stills"]])
def test_a_motor_at_the_end_of_its_range_throughout_is_named(
    folder: Path, stills: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    q = EPISODES[0].copy()
    q[2:, 2] = 2.5
    write_data_set(folder / "data", [q], "v2.1", "normalized")
    said = refused(capsys, "--state", "normalized", "--motors", "motors.json", *stills)
    assert "data: elbow_flex is at an end of its range, or beyond, in 133 of 135 frames" in said
    assert "too few are left. Record it with" in said


def test_too_few_frames_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_data_set(folder / "data", [EPISODES[0][:2]], "v2.1")
    assert "data: 2 frames are too few. Record" in refused(capsys, *DEGREES)
