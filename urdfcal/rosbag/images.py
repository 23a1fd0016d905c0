"""The images of a bag, written one by one as they are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import CameraError
from urdfcal.images.encodings import DamagedPictureError, decode_compressed, decode_raw
from urdfcal.images.files import in_parallel, write_image
from urdfcal.rosbag.clock import timeline

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from urdfcal.cameras.camera import Camera
    from urdfcal.rosbag.bag import Message
    from urdfcal.rosbag.clock import Timeline

# Nine hours at 30 Hz.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class WrittenImages:
    """The images of one camera.

    Attributes:
        times: when they were taken.
        labels: their files' names without suffix, in the same order.
        warnings: which were damaged.
    """

    times: Timeline
    labels: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _WrittenImage:
    """One image that is written: its stamp and when it was received, in ns, and its file."""

    stamp: int
    received: int
    path: Path


def write_images(
    folder: Path, messages: Iterable[Message], topics: Sequence[str], cameras: Sequence[Camera]
) -> tuple[WrittenImages, ...]:
    """Write images as ``folder``/<camera>/<number of the message>.png, or .jpg where they were recorded as that.

    Images that were not recorded whole are left out.

    Args:
        folder: where to; it is made.
        messages: of the topics, in the order in which they were recorded.
        topics: of every camera, sensor_msgs/Image or CompressedImage.
        cameras: that took the images.

    Returns:
        Of every camera, which images there are.

    Raises:
        CameraError: an image is of another kind or size than its camera takes, or none was recorded whole.
        SessionError: a camera took none, or its clock was set back.
        OSError: they cannot be written.
    """
    written: list[list[_WrittenImage]] = [[] for _ in topics]
    damaged: list[list[CameraError]] = [[] for _ in topics]

    def numbered() -> Iterator[tuple[int, int, Message]]:
        counts = [0] * len(topics)
        for message in messages:
            camera = topics.index(message.topic)
            counts[camera] += 1
            yield camera, counts[camera], message

    def write(task: tuple[int, int, Message]) -> tuple[int, _WrittenImage | CameraError]:
        camera, number, message = task
        path = folder / cameras[camera].name / f"{number:0{_DIGITS}d}"
        where = f"{message.topic}, message {number}"
        try:
            path = _write(path, message.content, cameras[camera])
        except DamagedPictureError as error:
            return camera, CameraError(error.what, where=where)
        except CameraError as error:
            raise CameraError(error.what, where=where, remedy=error.remedy) from error
        return camera, _WrittenImage(message.stamp, message.received, path)

    for one in cameras:
        (folder / one.name).mkdir(parents=True)
    for camera, result in in_parallel(write, numbered()):
        if isinstance(result, CameraError):
            damaged[camera].append(result)
        else:
            written[camera].append(result)
    return tuple(_in_order(*of) for of in zip(topics, written, damaged, strict=True))


def _in_order(topic: str, written: Sequence[_WrittenImage], damaged: Sequence[CameraError]) -> WrittenImages:
    """Return the images that have a time of their own; remove the files of others."""
    if damaged and not written:
        raise damaged[0]
    times = timeline(topic, [one.stamp for one in written], [one.received for one in written])
    for i in np.setdiff1d(np.arange(len(written)), times.kept):
        written[i].path.unlink()
    warnings = [f"{len(damaged)} images are damaged and left out; the first: {damaged[0]}"] if damaged else []
    return WrittenImages(times, tuple(written[i].path.stem for i in times.kept), tuple(warnings))


def _write(path: Path, content: Any, camera: Camera) -> Path:
    """Write the image of one message, and return its file."""
    if hasattr(content, "format"):
        data = content.data.tobytes()
        suffix, image, size = decode_compressed(content.format, data)
    else:
        suffix, data, size = ".png", b"", (int(content.width), int(content.height))
        image = decode_raw(content.encoding, size, content.step, content.data, big_endian=bool(content.is_bigendian))
    if size != camera.resolution:
        raise CameraError(
            f"it is {size[0]} x {size[1]} pixels, and the camera {camera.name!r} "
            f"{camera.resolution[0]} x {camera.resolution[1]}",
            remedy="Describe the camera as the images were taken, with --cameras FILE.",
        )
    path = path.with_suffix(suffix)
    if image is None:
        path.write_bytes(data)
    else:
        write_image(path, image)
    return path
