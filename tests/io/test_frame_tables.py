"""The tables of a moving arm: read back as written, and refused with file and line."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io.making import ACTUATED, POSES, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_positions, read_session
from urdfcal.io.writing import write_session
from urdfcal.session.trajectory import AT_REST

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FRAMES, READINGS = 20, 400


def write_moving(folder: Path) -> Path:
    """The valid session, its arm swinging, filmed by its two cameras at 10 and 8 Hz for 2.5 s."""
    write_valid(folder)
    session = folder / "session.yaml"
    session.write_text(session.read_text().replace("joints.csv", "joints.csv\nframes: frames.csv"))
    time = 100.0 + 0.01 * np.arange(READINGS)
    swing = [0.3 * np.sin(time + k) + (0.31 if name == "slide" else 0.0) for k, name in enumerate(ACTUATED)]
    swing[2] = 0.15 + 0.1 * np.sin(time)
    swing[3] = (2.0 * time + np.pi) % (2.0 * np.pi) - np.pi  # continuous: it jumps by a turn
    write(folder / "joints.csv", ["time", *ACTUATED], zip(time.tolist(), *(s.tolist() for s in swing), strict=True))
    frames = [("left", f"f{k}", 100.5 + 0.1 * k) for k in range(FRAMES)]
    frames += [("right", f"f{k}", 100.53 + 0.125 * k) for k in range(FRAMES)]
    write(folder / "frames.csv", ["camera", "frame", "time"], frames)
    rng = np.random.default_rng(0)
    seen = [(frame, camera, led, *rng.uniform(100, 900, 2)) for camera, frame, _ in frames for led in ("red", "blue")]
    write(folder / "detections.csv", ["pose", "camera", "led", "u", "v"], seen)
    return folder


def write(path: Path, header: list[str], rows: object) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    return write_moving(tmp_path / "moving")


def scale(path: Path, column: str, factor: float, offset: float = 0.0) -> None:
    rows = list(csv.DictReader(path.open()))
    for row in rows:
        row[column] = repr(float(row[column]) * factor + offset)
    write(path, list(rows[0]), [row.values() for row in rows])


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def test_each_frame_is_a_pose_of_one_camera(moving: Path) -> None:
    session = read_session(moving)
    assert len(session.poses) == 2 * FRAMES
    assert session.poses[0] == "left/f0"
    assert session.label(FRAMES) == "f0"
    d = session.find(Detections)
    assert np.array_equal(session.motion.camera[d.pose], d.camera)
    time = session.motion.time
    waist = session.q[:, session.chain.names.index("waist")]
    np.testing.assert_allclose(waist, 0.3 * np.sin(time), atol=1e-8)
    elbow, shoulder = (session.q[:, session.chain.names.index(name)] for name in ("elbow", "shoulder"))
    np.testing.assert_allclose(elbow, 0.1 - 1.5 * shoulder, atol=1e-12)


def test_a_continuous_joint_turns_on_where_its_reading_jumps(moving: Path) -> None:
    session = read_session(moving)
    roll = session.chain.names.index("roll")
    turned = 2.0 * session.motion.time - session.q[:, roll]
    np.testing.assert_allclose(turned, turned[0], atol=1e-8)
    assert turned[0] / (2.0 * np.pi) == pytest.approx(round(turned[0] / (2.0 * np.pi)), abs=1e-8)
    np.testing.assert_allclose(session.motion.velocities(np.zeros(2))[0][:, roll], 2.0, atol=1e-6)


def test_what_is_written_is_read_back(moving: Path, tmp_path: Path) -> None:
    session = read_session(moving)
    write_session(tmp_path / "copy", session)
    again = read_session(tmp_path / "copy")
    assert again.poses == session.poses
    assert np.array_equal(again.q, session.q)
    for name in ("pose", "camera", "led", "uv"):
        assert np.array_equal(getattr(again.find(Detections), name), getattr(session.find(Detections), name))
    assert again.motion.frames == session.motion.frames


def test_frames_without_readings_are_left_out_and_counted(moving: Path) -> None:
    scale(moving / "frames.csv", "time", 1.0, -0.55)
    session = read_session(moving)
    assert len(session.poses) == 2 * FRAMES - 3
    assert any("3 of 40 frames (left, right) lie outside" in text for text in session.warnings)
    assert session.label(0) == "f2"
    assert session.motion.row[0] == 2


def test_frames_in_a_gap_are_left_out_and_counted_with_its_line(moving: Path) -> None:
    rows = list(csv.reader((moving / "joints.csv").open()))
    write(moving / "joints.csv", rows[0], rows[1:101] + rows[131:])
    session = read_session(moving)
    (text,) = [text for text in session.warnings if "gap" in text]
    assert "joints.csv:102" in text
    assert "1 gaps of up to 0.31 s" in text
    gone = 2 * FRAMES - len(session.poses)
    assert f"{gone} frames" in text
    assert 4 <= gone <= 10


def test_positions_are_read_without_detections(moving: Path) -> None:
    (moving / "detections.csv").unlink()
    assert len(read_positions(moving).poses) == 2 * FRAMES


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            edit("joints.csv", "\n100.02,", "\n100.01,"),
            r"joints.csv:4:1: time: that of the joints is the same as in line 3",
        ),
        (edit("joints.csv", "\n100.02,", "\n100.0,"), r"joints.csv:4:1: time: that of the joints is 0.01 s before"),
        (edit("joints.csv", "time,", "pose,"), "unknown column 'pose'"),
        (edit("joints.csv", "\n100.02,", "\nnan,"), r"joints.csv:4:1: time: nan is not a finite number"),
        (lambda folder: scale(folder / "joints.csv", "time", 1e3), r"joints.csv:3:1: .* looks like milliseconds"),
        (lambda folder: scale(folder / "joints.csv", "time", 1e9), r"joints.csv:3:1: .* looks like nanoseconds"),
        (lambda folder: scale(folder / "joints.csv", "time", 50.0), "too seldom to interpolate"),
        (lambda folder: scale(folder / "frames.csv", "time", 1e3), r"frames.csv:2:9: .* looks like milliseconds"),
        (lambda folder: scale(folder / "frames.csv", "time", 1e9), r"frames.csv:2:9: .* looks like nanoseconds"),
        (lambda folder: scale(folder / "frames.csv", "time", 1.0, -100.0), "readings from 100 to 103.99"),
        (edit("frames.csv", "left,f1,100.6", "left,f1,100.5"), r"frames.csv:3:9: .* 'left' is the same as in line 2"),
        (
            edit("frames.csv", "left,f1,", "left,f0,"),
            r"frames.csv:3:6: frame 'f0' of camera 'left' is already in line 2",
        ),
        (edit("frames.csv", "left,f0", "lft,f0"), "Did you mean 'left'"),
        (edit("frames.csv", "camera,frame", "camera,pose"), "unknown column 'pose'"),
        (edit("detections.csv", "f0,left", "f77,left"), r"detections.csv:2:1: camera 'left' has no frame 'f77'"),
        (edit("detections.csv", "f1,left", "f0,left"), "is already in line 2"),
        (edit("session.yaml", "cameras: cameras.yaml\n", ""), "no cameras"),
        (edit("session.yaml", "detections: ", "points: "), "points"),
        (edit("session.yaml", "frames.csv", "frames.csv\nestimate: {time_offset: maybe}"), "'maybe' is not"),
        (edit("session.yaml", "frames: frames.csv", "estimate: {time_offset: fixed}"), "but no frames"),
    ],
)
def test_tables_that_cannot_be_right_are_refused(moving: Path, change: Callable[[Path], None], message: str) -> None:
    change(moving)
    with pytest.raises(SessionError, match=message):
        read_session(moving)


def test_the_still_session_it_was_made_of_is_still_one(tmp_path: Path) -> None:
    session = read_session(write_valid(tmp_path))
    assert session.motion is AT_REST
    assert [session.label(k) for k in range(POSES)] == list(session.poses)
