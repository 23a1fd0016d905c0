"""From a bag to a session's files: every number and every pixel."""

from __future__ import annotations

import csv
import shutil
import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import yaml

from tests.io.making import ACTUATED, URDF
from tests.rosbag.bags import BASELINE, KINDS, START, Recording, pixels, recording
from urdfcal.cameras.io.formats import read_kalibr, write_kalibr
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError, OutputError, SessionError, UrdfcalError
from urdfcal.images.files import read_image, workers
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rosbag import images
from urdfcal.rosbag.bag import open_bag
from urdfcal.rosbag.importing import ImportSummary, KnownRobot, import_bag
from urdfcal.rosbag.topics import choose_topics
from urdfcal.session.knowledge import Led

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def known(tmp_path: Path) -> KnownRobot:
    (tmp_path / "arm.urdf").write_text(URDF)
    urdf = Urdf.read(tmp_path / "arm.urdf")
    led = Led("led", np.array([0.1, 0, 0]))
    return KnownRobot(
        chain=Chain.from_urdf(urdf, "tip"), leds=(led,), urdf=urdf, urdf_reference=str(tmp_path / "arm.urdf")
    )


def bring(bag: Recording, folder: Path, known: KnownRobot, infos: bool = True, progress: Any = None) -> ImportSummary:
    """Write the bag beside the session's folder, and import it."""
    path = bag.write(folder.parent / f"bag-{bag.kind}")
    with open_bag(path) as opened:
        return import_bag(opened, choose_topics(opened.topics, infos=infos), known, folder, progress)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def nanoseconds(seconds: str) -> int:
    return round(float(seconds) * 1e9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_has_every_number_and_every_pixel(tmp_path: Path, known: KnownRobot, kind: str) -> None:
    counts: list[int] = []
    bag = recording(kind)
    bag.joints(START + 2_000, [0.02], ["grip"])
    imported = bring(bag, tmp_path / "s", known, progress=counts.append)
    assert sum(counts) == len(bag.messages)
    assert imported.origin == START
    assert imported.warnings == ()

    joints = table(tmp_path / "s" / "joints.csv")
    assert list(joints[0]) == ["time", *ACTUATED]
    assert [nanoseconds(row["time"]) for row in joints] == [8_000_000 * i + i % 7 for i in range(125)]
    values = [[float(row[name]) for name in ACTUATED] for row in joints]
    np.testing.assert_array_equal(values, [0.3 * np.sin(0.01 * i + np.arange(4)) for i in range(125)])

    frames = table(tmp_path / "s" / "frames.csv")
    assert list(frames[0]) == ["camera", "frame", "time"]
    for camera, name in enumerate(("left", "right")):
        mine = [row for row in frames if row["camera"] == name]
        assert [nanoseconds(row["time"]) for row in mine] == [
            33_333_333 * i + 1_234_567 * (camera + 1) for i in range(30)
        ]
        for i, row in enumerate(mine):
            image = read_image(tmp_path / "s" / "images" / name / f"{row['frame']}.png")
            np.testing.assert_array_equal(image, pixels(2 * i + camera))
        assert len(list((tmp_path / "s" / "images" / name).iterdir())) == len({row["frame"] for row in mine}) == 30

    rig = read_kalibr(tmp_path / "s" / "cameras.yaml")
    assert rig.names == ("left", "right")
    np.testing.assert_allclose(rig.T_cam_world[1][:3, 3], [-BASELINE, 0.0, 0.0], atol=1e-15)
    assert (tmp_path / "s" / "arm.urdf").read_text() == URDF
    assert yaml.safe_load((tmp_path / "s" / "session.yaml").read_text()) == {
        "robot": {"urdf": "arm.urdf", "base_link": "base", "tip_link": "tip"},
        "leds": {"led": {"position": [0.1, 0.0, 0.0]}},
        "cameras": "cameras.yaml",
        "joints": "joints.csv",
        "frames": "frames.csv",
    }


def test_images_that_repeat_a_stamp_leave_no_file_and_late_ones_are_in_order(tmp_path: Path, known: KnownRobot) -> None:
    bag = recording("mcap", 0.2)
    bag.drop("/right/image_raw")
    for i, number in enumerate((0, 2, 1, 2, 3)):
        bag.image("/right/image_raw", START + 30_000_000 * number, pixels(100 + i), received=START + i)
    imported = bring(bag, tmp_path / "s", known)
    rows = [row for row in table(tmp_path / "s" / "frames.csv") if row["camera"] == "right"]
    assert [nanoseconds(row["time"]) for row in rows] == [0, 30_000_000, 60_000_000, 90_000_000]
    assert [row["frame"] for row in rows] == ["000001", "000003", "000002", "000005"]
    files = sorted((tmp_path / "s" / "images" / "right").iterdir())
    assert [path.stem for path in files] == ["000001", "000002", "000003", "000005"]
    np.testing.assert_array_equal(read_image(files[2]), pixels(102))
    assert len(imported.warnings) == 2


def test_compressed_images_are_kept_to_the_last_byte(tmp_path: Path, known: KnownRobot) -> None:
    bag = recording("ros1", 0.2)
    bag.drop("/left/image_raw")
    files = {}
    for i, (suffix, format_) in enumerate([(".jpg", "jpeg"), (".png", "mono8; png compressed "), (".jpg", "jpeg")]):
        data = cv2.imencode(suffix, pixels(i))[1].tobytes()
        bag.compressed("/left/image_raw/compressed", START + 30_000_000 * i, data, format_)
        files[f"{i + 1:06d}{suffix}"] = data
    bring(bag, tmp_path / "s", known)
    assert {path.name: path.read_bytes() for path in (tmp_path / "s" / "images" / "left").iterdir()} == files


def test_a_damaged_image_among_others_is_left_out(tmp_path: Path, known: KnownRobot) -> None:
    bag = recording("mcap", 0.2)
    bag.drop("/left/image_raw")
    data = cv2.imencode(".jpg", pixels(0))[1].tobytes()
    for i in range(4):
        bag.compressed("/left/image_raw/compressed", START + 30_000_000 * i, data[:-30] if i == 2 else data)
    imported = bring(bag, tmp_path / "s", known)
    assert [row["frame"] for row in table(tmp_path / "s" / "frames.csv")][:3] == ["000001", "000002", "000004"]
    assert sorted(path.stem for path in (tmp_path / "s" / "images" / "left").iterdir()) == [
        "000001",
        "000002",
        "000004",
    ]
    (warning,) = imported.warnings
    assert warning.startswith("1 images are damaged and left out; the first: /left/image_raw/compressed, message 3: ")


def test_colours_and_depths_reach_the_file(tmp_path: Path, known: KnownRobot) -> None:
    bag = recording("sqlite3", 0.2)
    bag.drop("/left/image_raw")
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 256, (48, 64, 4), np.uint8)
    deep = rng.integers(0, 2**16, (48, 64), np.uint16)
    bag.image("/left/image_raw", START + 1, colours, "bgra8")
    bag.image("/left/image_raw", START + 2, deep, "mono16")
    bring(bag, tmp_path / "s", known)
    images = tmp_path / "s" / "images" / "left"
    np.testing.assert_array_equal(read_image(images / "000001.png"), colours[..., [2, 1, 0]])
    np.testing.assert_array_equal(read_image(images / "000002.png"), deep)


def test_cameras_may_come_from_a_file(tmp_path: Path, known: KnownRobot) -> None:
    bring(recording("mcap", 0.2), tmp_path / "first", known)
    first = read_kalibr(tmp_path / "first" / "cameras.yaml")
    T = np.eye(4)
    T[:3, 3] = 0.4, 0.01, 0.0
    # The other way round: the file's order is the session's.
    rig = Rig(first.cameras[::-1], (np.eye(4), T))
    bag = recording("sqlite3", 0.2)
    bag.drop("/left/camera_info")
    bag.drop("/right/camera_info")
    bring(bag, tmp_path / "s", replace(known, rig=rig), infos=False)
    read = read_kalibr(tmp_path / "s" / "cameras.yaml")
    assert read.names == ("right", "left")
    np.testing.assert_array_equal(read.T_cam_world[1], T)
    rows = table(tmp_path / "s" / "frames.csv")
    image = read_image(tmp_path / "s" / "images" / "right" / f"{rows[0]['frame']}.png")
    assert rows[0]["camera"] == "right"
    np.testing.assert_array_equal(image, pixels(1))
    write_kalibr(tmp_path / "again.yaml", rig)
    assert (tmp_path / "again.yaml").read_bytes() == (tmp_path / "s" / "cameras.yaml").read_bytes()


def test_a_robot_of_a_package_stays_there(tmp_path: Path) -> None:
    reference = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"
    urdf = Urdf.read(reference)
    chain = Chain.from_urdf(urdf, "tool0", "base_link")
    bag = recording("mcap", 0.2)
    bag.drop("/joint_states")
    for i in range(5):
        bag.joints(START + 8_000_000 * i, np.arange(6), chain.actuated)
    bring(bag, tmp_path / "s", KnownRobot(chain=chain, leds=(Led("led"),), urdf=urdf, urdf_reference=reference))
    assert not list((tmp_path / "s").glob("*.urdf"))
    assert yaml.safe_load((tmp_path / "s" / "session.yaml").read_text())["robot"]["urdf"] == reference


def test_a_clock_since_power_up_is_put_beside_the_robots(tmp_path: Path, known: KnownRobot) -> None:
    bag = recording("mcap", 0.5)
    bag.drop("/left/image_raw")
    for i in range(10):
        bag.image("/left/image_raw", 5 * 10**9 + 30_000_000 * i, pixels(i), received=START + 9_000_000 + 30_000_000 * i)
    imported = bring(bag, tmp_path / "s", known)
    rows = [row for row in table(tmp_path / "s" / "frames.csv") if row["camera"] == "left"]
    # Joint states take 1 ms to the recorder, and so are these images taken to.
    assert [nanoseconds(row["time"]) for row in rows] == [8_000_000 + 30_000_000 * i for i in range(10)]
    assert "/left/image_raw: its clock differs" in imported.warnings[0]


def too_large() -> Recording:
    bag = recording("ros1", 0.2)
    bag.image("/left/image_raw", START + 1, pixels(0, (65, 48)))
    return bag


def all_damaged() -> Recording:
    bag = recording("mcap", 0.2)
    bag.drop("/left/image_raw")
    bag.compressed("/left/image_raw/compressed", START, b"\xff\xd8\xff")
    return bag


def of_unknown_encoding() -> Recording:
    bag = recording("mcap", 0.2)
    bag.image("/right/image_raw", START + 10**8, pixels(0), "yuv422")
    return bag


def of_another_day() -> Recording:
    bag = recording("sqlite3", 0.2)
    bag.drop("/joint_states")
    for i in range(5):
        bag.joints(START - 10**13 + i, [0.0] * 4)
    return bag


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (too_large, CameraError, r"/left/image_raw, message 1: it is 65 x 48 pixels, and the camera 'left' 64 x 48"),
        (all_damaged, CameraError, "/left/image_raw/compressed, message 1: 3 bytes of the format 'jpeg' are no whole"),
        (of_unknown_encoding, CameraError, "/right/image_raw, message 4: images encoded as 'yuv422' are not supported"),
        (of_another_day, SessionError, "/left/image_raw: its images were not recorded at the same time"),
    ],
)
def test_a_bag_that_cannot_be_used_leaves_nothing(
    tmp_path: Path, known: KnownRobot, make: Callable[[], Recording], error: type[UrdfcalError], message: str
) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(error, match=message):
        bring(make(), tmp_path / "out" / "s", known)
    assert {path.name for path in (tmp_path / "out").iterdir()} <= {"bag-mcap", "bag-sqlite3", "bag-ros1.bag"}


def test_cameras_of_other_names_are_refused_before_anything_is_written(tmp_path: Path, known: KnownRobot) -> None:
    bring(recording("mcap", 0.2), tmp_path / "first", known)
    rig = read_kalibr(tmp_path / "first" / "cameras.yaml")
    renamed = Rig((rig.cameras[0], replace(rig.cameras[1], name="cam1")), rig.T_cam_world)
    message = r"described are left, cam1, those in the bag are called left, right\. .* --camera left=/left/image_raw"
    with pytest.raises(CameraError, match=message):
        bring(recording("sqlite3", 0.2), tmp_path / "second" / "s", replace(known, rig=renamed), infos=False)
    assert not (tmp_path / "second" / "s").exists()


def test_a_folder_with_anything_in_it_is_left_alone(tmp_path: Path, known: KnownRobot) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="there is something already"):
        bring(recording("mcap", 0.2), tmp_path / "s", known)
    assert [path.name for path in (tmp_path / "s").iterdir()] == ["notes.txt"]
    with pytest.raises(OutputError, match="there is something already"):
        bring(recording("ros1", 0.2), tmp_path / "s" / "notes.txt", known)
    assert (tmp_path / "s" / "notes.txt").read_text() == "mine"
    shutil.rmtree(tmp_path / "s")
    (tmp_path / "s").mkdir()
    bring(recording("sqlite3", 0.2), tmp_path / "s", known)
    assert {path.name for path in (tmp_path / "s").iterdir()} == {
        "session.yaml", "cameras.yaml", "joints.csv", "frames.csv", "images", "arm.urdf",
    }  # fmt: skip


def test_a_full_disk_leaves_nothing(tmp_path: Path, known: KnownRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, image: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(images, "write_image", full)
    with pytest.raises(OutputError, match="s: cannot write here: No space left on device"):
        bring(recording("mcap", 0.2), tmp_path / "s", known)
    assert not [path for path in tmp_path.iterdir() if path.name not in ("arm.urdf", "bag-mcap")]


def test_only_a_few_images_are_in_memory(tmp_path: Path, known: KnownRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = recording("mcap", 3.0)
    others = sum(1 for _, topic, _ in bag.messages if "image" not in topic)
    lock, read, written, ahead = threading.Lock(), [0], [0], [0]
    write = images.write_image

    def write_and_count(path: Path, image: Any) -> None:
        write(path, image)
        with lock:
            written[0] += 1

    def progress(count: int) -> None:
        with lock:
            read[0] += count
            ahead.append(read[0] - others - written[0])

    monkeypatch.setattr(images, "write_image", write_and_count)
    bring(bag, tmp_path / "s", known, progress=progress)
    assert written[0] == 180
    assert max(ahead) <= 2 * workers() + 1
