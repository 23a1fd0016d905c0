"""Sessions that say what does not count, or that are told so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.io.broken import append, cells, put, swap
from tests.io.making import write_valid
from tests.io.test_frame_tables import write_moving
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from pathlib import Path

YAML, JOINTS, PIXELS = "session.yaml", "joints.csv", "detections.csv"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_valid(tmp_path / "session")


def excluding(folder: Path, what: str) -> Path:
    append(YAML, f"exclude: {what}\n")(folder)
    return folder


@pytest.mark.parametrize("said", ["{poses: [2, 5-6]}", "{poses: ['2', '5', 6]}", "\n  poses:\n  - 5-6\n  - 2"])
def test_poses_are_left_out(folder: Path, said: str) -> None:
    session = read_session(excluding(folder, said))
    assert session.poses == ("0", "1", "3", "4", "7")
    assert set(session.excluded.poses) == {"2", "5", "6"}
    assert session.warnings == ()


def test_a_single_name_needs_no_list(folder: Path) -> None:
    session = read_session(excluding(folder, "{poses: 5-7, cameras: right}"))
    assert session.excluded.named == {"poses": ["5", "6", "7"], "cameras": ["right"]}


def test_nothing_is_nothing(folder: Path) -> None:
    session = read_session(excluding(folder, "{poses: , cameras: []}"))
    assert session.excluded.named == {}
    assert session.excluded.whole is None
    assert len(session.poses) == 8


def test_labels_are_text_whatever_yaml_makes_of_them(folder: Path) -> None:
    """To YAML 010 is the number 8, and 5e1 is 50.0."""
    for table in (JOINTS, PIXELS):
        cells(
            table, lambda _, row: {**row, "pose": {"3": "010", "4": "5e1", "7": "yes"}.get(row["pose"], row["pose"])}
        )(folder)
    session = read_session(excluding(folder, "{poses: [010, 5e1, yes]}"))
    assert session.poses == ("0", "1", "2", "5", "6")


def test_cameras_and_leds_are_left_out(folder: Path) -> None:
    session = read_session(excluding(folder, "{cameras: [right], leds: [blue]}"))
    assert session.rig.names == ("left",)
    assert session.led_names == ("red",)
    assert len(session.find(Detections)) == 8
    assert session.warnings == ()


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("{poses: [1, 22]}", r"session.yaml:12:22, key 'exclude.poses.1': there is no pose '22'. .*are: 0, 1, 2"),
        ("{poses: [1-8]}", r"session.yaml:12:19, key 'exclude.poses.0': there is no pose '8'"),
        (
            "{cameras: [Left]}",
            r"session.yaml:12:21, key 'exclude.cameras.0': there is no camera 'Left'. Did you mean 'left'",
        ),
        ("{leds: [rde]}", r"session.yaml:12:18, key 'exclude.leds.0': there is no LED 'rde'. Did you mean 'red'"),
        ("{pose: [1]}", r"session.yaml:12:11, key 'exclude.pose': unknown key 'pose'. Did you mean 'poses'"),
        ("{poses: [[1]]}", "stands where text belongs"),
        ("{leds: [red, blue]}", r"session.yaml:12:1, key 'exclude': it leaves nothing that was measured"),
        ("{poses: [0-5]}", r"session.yaml:12:1, key 'exclude': it leaves 2 poses, which are too few"),
    ],
)
def test_what_makes_no_sense_is_refused_with_its_place(folder: Path, said: str, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        read_session(excluding(folder, said))


def test_poses_may_be_excluded_besides(folder: Path) -> None:
    session = read_session(excluding(folder, "{poses: [2]}"), exclude_poses=["5-6", "2"])
    assert session.excluded.poses == ("2", "5", "6")
    with pytest.raises(SessionError, match=r"--exclude-poses: there is no pose '9'"):
        read_session(folder, exclude_poses=["9"])


def test_what_does_not_count_is_not_judged(folder: Path) -> None:
    put(JOINTS, 2, shoulder="1.85")(folder)
    put(JOINTS, 7, waist="2", shoulder="0.3", slide="0.1", roll="1")(folder)
    put(JOINTS, 6, waist="2", shoulder="0.3", slide="0.1", roll="1")(folder)
    put(PIXELS, 13, u="1300.5")(folder)
    session = read_session(excluding(folder, "{poses: [2, 3, 7]}"))
    assert session.poses == ("0", "1", "4", "5", "6")
    assert session.warnings == ()
    put(JOINTS, 4, shoulder="1.85")(folder)
    with pytest.raises(SessionError, match=r"joints.csv:6:\d+: shoulder = 1.85 rad is outside"):
        read_session(folder)


def test_a_joint_that_only_moved_in_poses_left_out_is_still(folder: Path) -> None:
    cells(JOINTS, lambda i, row: {**row, "waist": "0.5" if i == 3 else "0.2"})(folder)
    assert read_session(folder).warnings == ()
    (warning,) = read_session(excluding(folder, "{poses: [3]}")).warnings
    assert "joint 'waist' never moves" in warning


def test_what_was_never_seen_is_still_named_unless_it_is_left_out(folder: Path) -> None:
    cells(PIXELS, lambda _, row: row if row["pose"] not in "356" and row["led"] == "red" else None)(folder)
    poses, leds = read_session(folder, exclude_poses=["3"]).warnings
    assert "2 of 8 poses have no measurement: 5, 6" in poses
    assert "never seen: blue" in leds
    (poses,) = read_session(excluding(folder, "{poses: [3], leds: [blue]}")).warnings
    assert poses.endswith(": 5, 6")


def test_it_is_written_back(folder: Path, tmp_path: Path) -> None:
    session = read_session(excluding(folder, "{poses: [2, 5-6], cameras: [right], leds: [blue]}"))
    write_session(tmp_path / "written", session)
    again = read_session(tmp_path / "written")
    assert again.excluded.named == session.excluded.named
    assert again.poses == session.poses
    assert again.find(Detections).uv.tolist() == session.find(Detections).uv.tolist()
    swap(YAML, "cameras: [right]", "cameras: []")(tmp_path / "written")
    assert read_session(tmp_path / "written").rig.names == ("left", "right")


def test_frames_and_cameras_of_a_moving_arm(tmp_path: Path) -> None:
    folder = write_moving(tmp_path / "moving")
    whole = read_session(folder)
    first, last = whole.poses[3], whole.poses[5]
    append(YAML, f"exclude: {{poses: [{first}-{last}], cameras: [right]}}\n")(folder)
    session = read_session(folder)
    assert isinstance(session.motion, Trajectory)
    assert session.rig.names == ("left",)
    assert len(session.motion.frames) == 1
    kept = [label for k, label in enumerate(whole.poses) if label.startswith("left/") and not 3 <= k <= 5]
    assert list(session.poses) == kept
    assert set(session.motion.camera) == {0}
    write_session(tmp_path / "written", session)
    assert read_session(tmp_path / "written").poses == session.poses
