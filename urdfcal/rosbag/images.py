"""Images of a bag as files, each as it was recorded or as PNG; never more than a few are in memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import CameraError
from urdfcal.images.encodings import DamagedPictureError, decode_compressed, decode_raw
from urdfcal.images.files import in_parallel, write_image
from urdfcal.rosbag.clock import align_clock, timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from urdfcal.cameras.camera import Camera
    from urdfcal.rosbag.bag import Message
    from urdfcal.rosbag.clock import Timeline

# Nine hours of images at 30 Hz.
_DIGITS = 6


@dataclass(frozen=True)
class WrittenImages:
    """The images of one topic.

    Attributes:
        topic: its name.
        files: of each image its stamp, when it was received [ns], and its file, in the order of recording.
        warnings: which are damaged, and left out.
    """

    topic: str
    files: tuple[tuple[int, int, Path], ...]
    warnings: tuple[str, ...]

    def in_order(self, robot: Timeline) -> tuple[Timeline, list[str]]:
        """Return times and names of the images that have a time of their own; remove the files of others.

        Args:
            robot: the times of the joint states, on whose clock the images' times are to be.

        Raises:
            SessionError: there is none, its clock was set back, or it was recorded at another time.
        """
        stamps, received = [stamp for stamp, *_ in self.files], [received for _, received, _ in self.files]
        times = timeline(self.topic, stamps, received, self.warnings)
        paths = [path for *_, path in self.files]
        for i in np.setdiff1d(np.arange(len(paths)), times.kept):
            paths[i].unlink()
        return align_clock(robot, times), [paths[i].stem for i in times.kept]


def numbered(topic: str, number: int) -> str:
    """Return the name of an image: the number of its message among those of its topic, from 1."""
    del topic
    return f"{number:0{_DIGITS}d}"


def write_images(
    folder: Path,
    messages: Iterable[Message],
    cameras: Mapping[str, Camera],
    name: Callable[[str, int], str | None] = numbered,
) -> dict[str, WrittenImages]:
    """Write images as ``folder``/<camera>/<name>.png, or .jpg where they were recorded as that.

    Args:
        folder: where to; it is made.
        messages: of the topics, in the order in which they were recorded.
        cameras: that took the images, by their topics, sensor_msgs/Image or CompressedImage.
        name: of the image's file, by its topic and number, without suffix; None for one that is not wanted.

    Returns:
        Of every camera the images that were recorded whole.

    Raises:
        CameraError: an image is of another kind or size than its camera takes, or none was recorded whole.
        OSError: they cannot be written.
    """
    written: dict[str, list[tuple[int, int, Path]]] = {topic: [] for topic in cameras}
    damaged: dict[str, list[CameraError]] = {topic: [] for topic in cameras}

    def wanted() -> Iterator[tuple[int, str, Message]]:
        counts = Counter[str]()
        for message in messages:
            counts[message.topic] += 1
            number = counts[message.topic]
            if (named := name(message.topic, number)) is not None:
                yield number, named, message

    def write(task: tuple[int, str, Message]) -> tuple[str, tuple[int, int, Path] | CameraError]:
        number, named, message = task
        camera, where = cameras[message.topic], f"{message.topic}, message {number}"
        try:
            path = _write_one(folder / camera.name / named, message.content, camera)
        except DamagedPictureError as error:
            return message.topic, CameraError(error.what, where=where)
        except CameraError as error:
            raise CameraError(error.what, where=where, remedy=error.remedy) from error
        return message.topic, (message.stamp, message.received, path)

    for camera in cameras.values():
        (folder / camera.name).mkdir(parents=True)
    for topic, result in in_parallel(write, wanted()):
        if isinstance(result, CameraError):
            damaged[topic].append(result)
        else:
            written[topic].append(result)
    for topic, errors in damaged.items():
        if errors and not written[topic]:
            raise errors[0]
    return {
        camera.name: WrittenImages(topic, tuple(written[topic]), _left_out(damaged[topic]))
        for topic, camera in cameras.items()
    }


def _left_out(damaged: list[CameraError]) -> tuple[str, ...]:
    if not damaged:
        return ()
    return (f"{len(damaged)} images are damaged and left out; the first: {damaged[0]}",)


def _write_one(path: Path, content: Any, camera: Camera) -> Path:
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
