"""Recordings of ROS 1 (.bag) and ROS 2 (sqlite3 or MCAP), read without ROS: topics, and their messages one by one.

rosbags' own AnyReader is not used: it compiles the definitions of all topics of a bag, and gives up at the first one
that it cannot parse or whose hash differs, though nobody needs that topic.
"""

from __future__ import annotations

import os
import struct
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from urdfcal.errors import SessionError, placed
from urdfcal.names import listed

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TEXT = "std_msgs/msg/String"

_SUFFIXES = (".bag", ".db3", ".mcap")
_NANO = 1_000_000_000
# What 64 bits hold with a sign; MCAP's have none. [ns]
_LATEST = 2**63 - 1
# The only type here that rosbags does not know of ROS 1.
_TRANSFORMS_1 = "geometry_msgs/TransformStamped[] transforms\n"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: the topic's.
        type: of its messages, as ROS 2 writes it; several are joined by "or".
        count: of its messages.
    """

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Message:
    """One recorded message.

    Attributes:
        topic: its name.
        received: when the recorder got it. [ns]
        content: its fields, named as in ROS; arrays are NumPy's.
    """

    topic: str
    received: int
    content: Any

    @property
    def stamp(self) -> int:
        """When the sender measured it, by the message's header. [ns]."""
        stamp = self.content.header.stamp
        return int(stamp.sec) * _NANO + int(stamp.nanosec)


@dataclass(frozen=True, eq=False)
class Bag:
    """An open recording.

    Attributes:
        path: its file, or the folder of ROS 2.
        topics: in alphabetical order.
        duration: from its first to its last message. [s]
    """

    path: Path
    topics: tuple[Topic, ...]
    duration: float
    _reader: Reader1 | Reader2
    _types: Typestore

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Read messages, in the order in which they were recorded.

        Args:
            topics: names of those to read; all of a type that this module names.

        Raises:
            SessionError: the bag is damaged, or its messages are not what ROS calls by that name.
        """
        types, ros1 = self._types, _is_ros1(self.path)
        decode = types.deserialize_ros1 if ros1 else types.deserialize_cdr
        with _errors_explained(self.path):
            connections = [one for one in self._reader.connections if one.topic in topics]
            for one in connections:
                known = types.generate_msgdef(one.msgtype)[1] if ros1 else types.hash_rihs01(one.msgtype)
                # Older bags of ROS 2 have no hashes.
                if one.digest and one.digest != known:
                    raise SessionError(f"{one.topic} is not what ROS calls {one.msgtype}", where=str(self.path))
            # Of no connections rosbags reads all.
            for connection, received, data in self._reader.messages(connections) if connections else ():
                if received > _LATEST:
                    raise SessionError("the time of a message is damaged", where=f"{self.path}: {connection.topic}")
                yield Message(connection.topic, received, decode(data, connection.msgtype))


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a recording.

    Args:
        path: a .bag file of ROS 1; a folder of ROS 2, or a .db3 or .mcap file of one.

    Raises:
        SessionError: there is none, or it is damaged.
    """
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not os.path.exists(path):  # noqa: PTH110  # pathlib's raises at overlong names
        raise SessionError("there is no such bag", where=str(path))
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        there = [entry.name for entry in sorted(path.iterdir()) if entry.suffix in _SUFFIXES]
        raise SessionError(
            "the folder has no metadata.yaml, as bags of ROS 2 have",
            where=str(path),
            remedy=f"Name one file: {listed(there)}." if there else "Name the folder that `ros2 bag record` made.",
        )
    if not path.is_dir() and path.suffix not in _SUFFIXES:
        raise SessionError(
            f"bags do not end in {path.suffix!r}" if path.suffix else "bags have a suffix",
            where=str(path),
            remedy=f"Those of ROS 1 end in {_SUFFIXES[0]}, files of ROS 2 in {' or '.join(_SUFFIXES[1:])}.",
        )
    # A bag's own definitions are not needed: JointState, Image, CompressedImage, CameraInfo and TFMessage have been the
    # same in all distributions of ROS 2, and in ROS 1 (compared: their hashes in rosbags, Dashing to Lyrical).
    types = get_typestore(Stores.ROS1_NOETIC if _is_ros1(path) else Stores.ROS2_HUMBLE)
    if _is_ros1(path):
        types.register(get_types_from_msg(_TRANSFORMS_1, TRANSFORMS))
    with _errors_explained(path):
        reader = Reader1(path) if _is_ros1(path) else Reader2(path)
        reader.open()
    try:
        with _errors_explained(path):
            topics = tuple(
                Topic(name, " or ".join(sorted({one.msgtype for one in of.connections})), of.msgcount)
                for name, of in sorted(reader.topics.items())
            )
            duration = reader.duration / _NANO
        with placed(path):
            yield Bag(path, topics, duration, reader, types)
    finally:
        with suppress(AttributeError):  # of what a damaged metadata.yaml made of it
            reader.close()


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag" and not path.is_dir()


@contextmanager
def _errors_explained(path: Path) -> Iterator[None]:
    """Say which bag cannot be read, and why."""
    import apsw
    from rosbags import rosbag1, rosbag2
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    if sys.version_info >= (3, 14):
        from compression.zstd import ZstdError
    else:
        from backports.zstd import ZstdError

    # Rosbags trusts the numbers in a file: what a damaged one makes it raise is as varied (tests/rosbag/test_bag.py
    # cuts and changes bags). Only its code and that of its libraries runs below.
    explained = (rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, TypesysError, OSError)
    damage = (
        *explained, apsw.Error, ZstdError, EOFError, RuntimeError, ValueError, TypeError, LookupError, AssertionError,
        struct.error, OverflowError, MemoryError,
    )  # fmt: skip
    try:
        yield
    except damage as error:
        reason = str(error) if isinstance(error, explained) else f"{type(error).__name__} {error}".strip()
        raise SessionError(
            f"the bag cannot be read: {reason}",
            where=str(path),
            remedy="If it is damaged or was not closed: `rosbag reindex`, `ros2 bag reindex` or `mcap recover`.",
        ) from error
