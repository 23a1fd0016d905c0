"""The pictures of a bag, written one by one as they are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import CameraError
from urdfcal.session.bag_clock import timeline
from urdfcal.vision.encodings import decode_compressed, decode_raw
from urdfcal.vision.images import in_parallel, write_image

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from urdfcal.session.bag import Message
    from urdfcal.session.bag_clock import Timeline
    from urdfcal.vision.camera import Camera

# Nine hours at 30 Hz.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Frames:
    """The pictures of one camera.

    Attributes:
        times: when they were taken.
        labels: their files' names without suffix, in the same order.
    """

    times: Timeline
    labels: tuple[str, ...]


def write_pictures(
    folder: Path, messages: Iterable[Message], topics: Sequence[str], cameras: Sequence[Camera]
) -> tuple[Frames, ...]:
    """Write pictures as ``folder``/<camera>/<number of the message>.png, or .jpg where they were recorded as that.

    Args:
        folder: where to; it is made.
        messages: of the topics, in the order in which they were recorded.
        topics: of every camera, sensor_msgs/Image or CompressedImage.
        cameras: that took the pictures.

    Returns:
        Of every camera, which pictures there are.

    Raises:
        CameraError: a picture cannot be decoded, or is not of its camera's size.
        SessionError: a camera took none, or its clock was set back.
        OSError: they cannot be written.
    """
    stamps: list[list[int]] = [[] for _ in topics]
    received: list[list[int]] = [[] for _ in topics]
    written: list[list[Path]] = [[] for _ in topics]

    def numbered() -> Iterator[tuple[int, int, Message]]:
        for message in messages:
            camera = topics.index(message.topic)
            stamps[camera].append(message.stamp)
            received[camera].append(message.received)
            yield camera, len(stamps[camera]), message

    def write(task: tuple[int, int, Message]) -> tuple[int, Path]:
        camera, number, message = task
        path = folder / cameras[camera].name / f"{number:0{_DIGITS}d}"
        try:
            return camera, _write(path, message.content, cameras[camera])
        except CameraError as error:
            raise CameraError(error.what, where=f"{message.topic}, message {number}", remedy=error.remedy) from error

    for one in cameras:
        (folder / one.name).mkdir(parents=True)
    for camera, path in in_parallel(write, numbered()):
        written[camera].append(path)
    frames = []
    for topic, stamped, arrived, paths in zip(topics, stamps, received, written, strict=True):
        times = timeline(topic, stamped, arrived)
        for i in np.setdiff1d(np.arange(len(paths)), times.kept):
            paths[i].unlink()
        frames.append(Frames(times, tuple(paths[i].stem for i in times.kept)))
    return tuple(frames)


def _write(path: Path, content: Any, camera: Camera) -> Path:
    """Write the picture of one message, and say where it is."""
    if hasattr(content, "format"):
        data = content.data.tobytes()
        suffix, image, size = decode_compressed(content.format, data)
    else:
        size = int(content.width), int(content.height)
        suffix, data = ".png", b""
        image = decode_raw(content.encoding, size, content.step, content.data, big_endian=bool(content.is_bigendian))
    if size != camera.resolution:
        raise CameraError(
            f"it is {size[0]} x {size[1]} pixels, and the camera {camera.name!r} "
            f"{camera.resolution[0]} x {camera.resolution[1]}",
            remedy="Describe the camera as the pictures were taken, with --cameras FILE.",
        )
    path = path.with_suffix(suffix)
    if image is None:
        path.write_bytes(data)
    else:
        write_image(path, image)
    return path
