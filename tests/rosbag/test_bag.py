"""Bags of all formats, as rosbags writes them, and damaged ones."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rosbags import rosbag2

from tests.io.making import ACTUATED
from tests.rosbag.bags import KINDS, START, Recording, pixels, recording
from urdfcal.errors import SessionError
from urdfcal.rosbag.bag import Topic, open_bag

if TYPE_CHECKING:
    from pathlib import Path

JOINTS = "sensor_msgs/msg/JointState"


def storage(bag: Path) -> Path:
    """The file that holds the messages."""
    return bag if bag.is_file() else next(path for path in bag.iterdir() if path.name != "metadata.yaml")


@pytest.mark.parametrize("kind", KINDS)
def test_topics_and_messages_come_back(tmp_path: Path, kind: str) -> None:
    written = recording(kind)
    path = written.write(tmp_path / "bag")
    with open_bag(path) as bag:
        assert bag.topics == (
            Topic("/joint_states", JOINTS, 125),
            Topic("/left/camera_info", "sensor_msgs/msg/CameraInfo", 30),
            Topic("/left/image_raw", "sensor_msgs/msg/Image", 30),
            Topic("/right/camera_info", "sensor_msgs/msg/CameraInfo", 30),
            Topic("/right/image_raw", "sensor_msgs/msg/Image", 30),
        )
        assert bag.duration == pytest.approx(0.992, abs=1e-3)
        joints = list(bag.messages(["/joint_states"]))
        images = list(bag.messages(["/left/image_raw", "/right/image_raw"]))
        assert list(bag.messages(["/nothing"])) == []
    assert [message.stamp for message in joints] == [START + 8_000_000 * i + i % 7 for i in range(125)]
    assert [message.received - message.stamp for message in joints] == [1_000_000] * 125
    assert joints[7].content.name == list(ACTUATED)
    np.testing.assert_array_equal(joints[7].content.position, 0.3 * np.sin(0.07 + np.arange(4)))
    assert [message.topic for message in images] == ["/left/image_raw", "/right/image_raw"] * 30
    np.testing.assert_array_equal(images[9].content.data, pixels(9).ravel())


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_file_of_ros_2_is_a_bag_of_its_own(tmp_path: Path, kind: str) -> None:
    folder = recording(kind).write(tmp_path / "bag")
    with open_bag(storage(folder)) as bag:
        assert sum(1 for _ in bag.messages(["/joint_states"])) == 125
    (folder / "metadata.yaml").unlink()
    with (
        pytest.raises(SessionError, match=rf"no metadata.yaml.*Name one file: {storage(folder).name}"),
        open_bag(folder),
    ):
        pass


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing.bag", "there is no such bag"),
        ("b" * 300 + ".bag", "there is no such bag"),
        ("bag.txt", r"bags do not end in '\.txt'. Those of ROS 1 end in \.bag, files of ROS 2 in \.db3 or \.mcap"),
        ("bag", "bags have a suffix"),
        ("empty.bag", "seems to be empty"),
        ("empty.mcap", "seems to be empty"),
        ("empty.db3", "cannot be read"),
        ("folder", "Name the folder that `ros2 bag record` made"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path: Path, name: str, message: str) -> None:
    for other in ("bag.txt", "bag", "empty.bag", "empty.mcap", "empty.db3"):
        (tmp_path / other).touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(SessionError, match=message), open_bag(tmp_path / name):
        pass


def test_a_folder_is_of_ros_2_whatever_its_name(tmp_path: Path) -> None:
    folder = recording("mcap", 0.1).write(tmp_path / "bag").rename(tmp_path / "day.bag")
    with open_bag(folder) as bag:
        assert sum(1 for _ in bag.messages(["/joint_states"])) == 12


def test_an_error_that_does_not_explain_itself_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty.mcap").touch()
    with (
        pytest.raises(SessionError, match=r"the bag cannot be read: [^:]*seems to be empty") as error,
        open_bag(tmp_path / "empty.mcap"),
    ):
        pass
    assert "Error" not in error.value.what

    def damaged(*_: object) -> None:
        raise KeyError("offset")

    monkeypatch.setattr(rosbag2.Reader, "messages", damaged)
    with (
        open_bag(recording("mcap", 0.1).write(tmp_path / "bag")) as bag,
        pytest.raises(SessionError, match="the bag cannot be read: KeyError 'offset'"),
    ):
        list(bag.messages(["/joint_states"]))


def test_another_message_of_the_same_name_is_refused(tmp_path: Path) -> None:
    path = recording("ros1", 0.1).write(tmp_path / "bag")
    # The hash of its definition, in the bag's index and its chunks.
    data = path.read_bytes().replace(b"3066dcd76a6cfaef579bd0f34173e9fd", b"0" * 32)
    path.write_bytes(data)
    with (
        open_bag(path) as bag,
        pytest.raises(SessionError, match=f"/joint_states is not what ROS calls {JOINTS}"),
    ):
        list(bag.messages(["/joint_states"]))


def test_damaged_definitions_of_topics_that_are_not_read_do_not_matter(tmp_path: Path) -> None:
    path = recording("ros1", 0.1).write(tmp_path / "bag")
    # Of sensor_msgs/CameraInfo; rosbags' AnyReader refuses such a bag.
    path.write_bytes(path.read_bytes().replace(b"uint32 binning_x", b"uint32 /inning_x"))
    with open_bag(path) as read:
        assert sum(1 for _ in read.messages(["/joint_states"])) == 12


def test_a_topic_of_two_types_has_both(tmp_path: Path) -> None:
    bag = recording("mcap", 0.1)
    bag.compressed("/left/image_raw", START, b"")
    with open_bag(bag.write(tmp_path / "bag")) as read:
        assert Topic("/left/image_raw", "sensor_msgs/msg/CompressedImage or sensor_msgs/msg/Image", 4) in read.topics


def test_an_empty_bag_has_no_duration(tmp_path: Path) -> None:
    with open_bag(Recording("mcap").write(tmp_path / "bag")) as read:
        assert (read.topics, read.duration) == ((), 0.0)


def test_messages_that_nobody_knows_do_not_matter(tmp_path: Path) -> None:
    bag = recording("ros1", 0.1)
    path = bag.write(tmp_path / "bag")
    path.write_bytes(path.read_bytes().replace(b"type=sensor_msgs/CameraInfo", b"type=my_package/CameraInfo1"))
    with open_bag(path) as read:
        assert sum(1 for _ in read.messages(["/joint_states"])) == 12
        assert "my_package/msg/CameraInfo1" in {topic.type for topic in read.topics}


@pytest.mark.no_cover
@pytest.mark.parametrize("kind", KINDS)
def test_damage_raises_our_error_and_no_other(tmp_path: Path, kind: str) -> None:
    path = recording(kind, 0.1).write(tmp_path / "bag")
    data = storage(path).read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    for attempt in range(150):
        broken = bytearray(data[: rng.integers(len(data))] if attempt % 3 == 0 else data)
        # Headers stand at the beginning, the index at the end.
        for place in (rng.integers(len(data), size=20), rng.integers(5000, size=3), -rng.integers(1, 5000, size=3)):
            for i in place:
                if attempt % 3 and -len(broken) <= i < len(broken):
                    broken[i] = rng.integers(256)
        storage(path).write_bytes(broken)
        try:
            with open_bag(path) as bag:
                list(bag.messages([topic.name for topic in bag.topics]))
        except SessionError as error:
            messages.append(str(error))
    assert len(messages) > 75
    assert all(str(path) in text for text in messages)


def test_nothing_stays_open(tmp_path: Path) -> None:
    path = Recording("sqlite3")
    path.joints(START, [0.0] * 4)
    folder = path.write(tmp_path / "bag")
    with pytest.raises(ZeroDivisionError), open_bag(folder):
        raise ZeroDivisionError
    shutil.rmtree(folder)


def test_a_time_beyond_64_bits_is_damage(tmp_path: Path) -> None:
    bag = Recording("mcap")
    bag.joints(START, [0.0] * 4, received=2**63)
    path = bag.write(tmp_path / "bag")
    with open_bag(path) as opened, pytest.raises(SessionError, match="/joint_states: the time of a message is damaged"):
        list(opened.messages(["/joint_states"]))


def test_what_is_wrong_with_a_bag_is_placed_in_it(tmp_path: Path) -> None:
    folder = recording("mcap", 0.1).write(tmp_path / "bag")
    with pytest.raises(SessionError) as caught, open_bag(folder):
        raise SessionError("a topic is missing")
    assert caught.value.where == str(folder)
