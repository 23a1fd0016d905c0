"""Import of a bag as a session of a moving arm: its cameras, joints.csv, frames.csv, and the images."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import CameraError, OutputError, SessionError
from urdfcal.images.encodings import DamagedPictureError, decode_compressed, decode_raw
from urdfcal.images.files import in_parallel, write_image
from urdfcal.io.folder import IMAGES
from urdfcal.io.writing import put_into, write_table
from urdfcal.names import listed
from urdfcal.rosbag.bag import TRANSFORMS
from urdfcal.rosbag.cameras import TF_STATIC, read_bag_cameras
from urdfcal.rosbag.clock import align_clock, timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.cameras.rig import Rig
    from urdfcal.rosbag.bag import Bag, Message
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.topics import ChosenTopics
    from urdfcal.session.model import Setup


# Nine hours of images at 30 Hz.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class ImportSummary:
    """What was imported from a bag.

    Attributes:
        origin: the time that is 0 in the session, on the robot's clock. [ns]
        joints: when the joint states were taken.
        cameras: when the images were taken, by camera.
        rig: the cameras.
        notes: where the poses of the cameras come from that the bag describes.
        warnings: which messages were left out, and what was done to the times.
    """

    origin: int
    joints: Timeline
    cameras: Mapping[str, Timeline]
    rig: Rig
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def import_bag(
    bag: Bag,
    topics: ChosenTopics,
    setup: Setup,
    folder: str | Path,
    progress: Callable[[int], object] | None = None,
) -> ImportSummary:
    """Write a session from a bag; all of it or nothing.

    Of its images never more than a few are in memory.

    Args:
        bag: the recording.
        topics: of the joints and the cameras.
        setup: what the bag does not hold: the robot and its LEDs, and the cameras unless the bag describes them.
        folder: where to; made if need be, in a folder that exists. It must be empty.
        progress: called with the number of messages read since the last call: those of ``topics`` and /tf_static.

    Raises:
        SessionError: the bag is damaged, or its joint states or times cannot be used.
        CameraError: a camera or an image cannot be used.
        OutputError: the folder is not empty, or cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise OutputError(
            "there is something already", where=str(folder), remedy="Name another folder, or empty it first."
        )

    def read(*names: str) -> Iterator[Message]:
        for message in bag.messages(names):
            if progress:
                progress(1)
            yield message

    joints = setup.chain.actuated
    times, readings = read_joint_states(topics.joints, read(topics.joints), joints)
    rig, notes = setup.rig, tuple[str, ...]()
    if not rig.cameras:
        infos = [(name, info) for name, (_, info) in topics.cameras.items() if info is not None]
        static = [topic.name for topic in bag.topics if topic.name == TF_STATIC and topic.type == TRANSFORMS]
        rig, notes = read_bag_cameras(infos, read(*(info for _, info in infos), *static))
    images = _image_topics(rig, topics)
    with put_into(folder) as partial:
        _write_setup(partial, setup, rig)
        frames = _write_images(partial / IMAGES, read(*images), images, times)
        origin = _write_tables(partial, times, dict(zip(joints, readings.T.tolist(), strict=True)), frames)
    cameras = {name: taken for name, (taken, _) in frames.items()}
    warnings = tuple(warning for of in (times, *cameras.values()) for warning in of.warnings)
    return ImportSummary(origin, times, cameras, rig, notes, warnings)


def read_joint_states(topic: str, messages: Iterable[Message], joints: Sequence[str]) -> tuple[Timeline, Floats]:
    """Read the positions of some joints.

    Messages with none of them are another device's, and those without positions are of no use: they are left out.

    Args:
        topic: its name.
        messages: of the topic, in the order in which they were recorded.
        joints: names of those that every reading has.

    Returns:
        When each reading was taken, and which messages were left out; and the readings (K, k) of these joints, in their
        order. [rad or m]

    Raises:
        SessionError: no message has all joints, or one contradicts itself.
    """
    needed = set(joints)
    stamps, received, rows = [], [], []
    # Messages that cannot be used: by the joints that they have, and by the joint that is not a number.
    parts: Counter[frozenset[str]] = Counter()
    undefined: Counter[str] = Counter()
    seen: dict[str, None] = {}
    empty = 0
    for number, message in enumerate(messages, 1):
        names, positions = message.content.name, message.content.position
        seen |= dict.fromkeys(names)
        if not needed.intersection(names):
            continue
        if not len(positions):
            empty += 1
            continue
        if len(positions) != len(names):
            raise SessionError(f"message {number} has {len(names)} names and {len(positions)} positions", where=topic)
        if len(set(names)) < len(names):
            raise SessionError(f"message {number} names a joint twice: {listed(names)}", where=topic)
        value = dict(zip(names, positions.tolist(), strict=True))
        if not needed <= value.keys():
            parts[frozenset(needed & value.keys())] += 1
            continue
        row = [value[name] for name in joints]
        bad = [name for name, x in zip(joints, row, strict=True) if not np.isfinite(x)]
        if bad:
            undefined.update(bad[:1])
            continue
        stamps.append(message.stamp)
        received.append(message.received)
        rows.append(row)
    warnings = [f"{topic}: {empty} messages have no positions and are left out"] if empty else []
    if undefined:
        warnings.append(
            f"{topic}: {undefined.total()} messages are left out, in which the position of {listed(undefined)} "
            "is no finite number"
        )
    if not rows:
        raise _unusable(topic, joints, list(seen), parts, warnings)
    if parts:
        warnings.append(f"{topic}: {parts.total()} messages have only some of the joints and are left out")
    times = timeline(topic, stamps, received, warnings)
    return times, np.array(rows)[times.kept]


def _unusable(
    topic: str, joints: Sequence[str], seen: Sequence[str], parts: Counter[frozenset[str]], warnings: Sequence[str]
) -> SessionError:
    """Say why no message can be used."""
    missing = [name for name in joints if name not in seen]
    if missing:
        return SessionError(
            f"no joint state has {listed(missing)}",
            where=topic,
            remedy=f"The joints in it are: {listed(seen)}. Other names? Another URDF, --base or --tip, or --joints.",
        )
    if parts:
        sets = "; ".join(f"{listed(sorted(names))} ({count} messages)" for names, count in parts.most_common(4))
        return SessionError(
            f"no message has all joints of the arm: {sets}",
            where=topic,
            remedy="Record a topic on which one node publishes them together.",
        )
    return SessionError(
        "no message can be used", where=topic, remedy=" ".join(f"{w.removeprefix(f'{topic}: ')}." for w in warnings)
    )


def _image_topics(rig: Rig, topics: ChosenTopics) -> dict[str, Camera]:
    """Return the cameras by the topics of their images."""
    images = {name: image for name, (image, _) in topics.cameras.items()}
    if set(images) != set(rig.names):
        raise CameraError(
            f"the cameras described are {listed(rig.names)}, those in the bag are called {listed(images)}",
            remedy=f"Say which is which: --camera {rig.names[0]}={next(iter(images.values()))} and so on.",
        )
    return {images[camera.name]: camera for camera in rig.cameras}


def _write_setup(folder: Path, setup: Setup, rig: Rig) -> None:
    """Write session.yaml, the cameras, and the robot unless it is in a package."""
    import yaml

    from urdfcal.cameras.io.formats import write_kalibr

    reference, chain = setup.urdf_reference, setup.chain
    if setup.urdf and not reference.startswith("package://"):
        reference = Path(reference).name
        (folder / reference).write_bytes(setup.urdf.data)
    content = {
        "robot": {"urdf": reference, "base_link": chain.base_link, "tip_link": chain.tip_link},
        "leds": {led.name: {} if led.position is None else {"position": led.position.tolist()} for led in setup.leds},
        "cameras": "cameras.yaml",
        "joints": "joints.csv",
        "frames": "frames.csv",
    }
    write_kalibr(folder / "cameras.yaml", rig)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / "session.yaml").write_text(text, encoding="utf-8")


def _write_images(
    folder: Path, messages: Iterable[Message], cameras: Mapping[str, Camera], robot: Timeline
) -> dict[str, tuple[Timeline, list[str]]]:
    """Write images as ``folder``/<camera>/<number of the message>.png, or .jpg where they were recorded as that.

    Args:
        folder: where to; it is made.
        messages: of the topics, in the order in which they were recorded.
        cameras: that took the images, by their topics, sensor_msgs/Image or CompressedImage.
        robot: the times of the joint states, on whose clock the images' times are to be.

    Returns:
        Of every camera, when the images that were recorded whole were taken, and their files' names without suffix.

    Raises:
        CameraError: an image is of another kind or size than its camera takes, or none was recorded whole.
        SessionError: a camera took none, its clock was set back, or it was recorded at another time.
        OSError: they cannot be written.
    """
    written: dict[str, list[tuple[int, int, Path]]] = {topic: [] for topic in cameras}
    damaged: dict[str, list[CameraError]] = {topic: [] for topic in cameras}

    def numbered() -> Iterator[tuple[int, Message]]:
        counts = Counter[str]()
        for message in messages:
            counts[message.topic] += 1
            yield counts[message.topic], message

    def write(task: tuple[int, Message]) -> tuple[str, tuple[int, int, Path] | CameraError]:
        number, message = task
        camera, where = cameras[message.topic], f"{message.topic}, message {number}"
        try:
            path = _write_one(folder / camera.name / f"{number:0{_DIGITS}d}", message.content, camera)
        except DamagedPictureError as error:
            return message.topic, CameraError(error.what, where=where)
        except CameraError as error:
            raise CameraError(error.what, where=where, remedy=error.remedy) from error
        return message.topic, (message.stamp, message.received, path)

    for camera in cameras.values():
        (folder / camera.name).mkdir(parents=True)
    for topic, result in in_parallel(write, numbered()):
        if isinstance(result, CameraError):
            damaged[topic].append(result)
        else:
            written[topic].append(result)
    return {camera.name: _in_order(topic, written[topic], damaged[topic], robot) for topic, camera in cameras.items()}


def _in_order(
    topic: str, written: Sequence[tuple[int, int, Path]], damaged: Sequence[CameraError], robot: Timeline
) -> tuple[Timeline, list[str]]:
    """Return times and names of the images that have a time of their own; remove the files of others."""
    if damaged and not written:
        raise damaged[0]
    warnings = [f"{len(damaged)} images are damaged and left out; the first: {damaged[0]}"] if damaged else []
    times = timeline(topic, [stamp for stamp, *_ in written], [received for _, received, _ in written], warnings)
    paths = [path for *_, path in written]
    for i in np.setdiff1d(np.arange(len(paths)), times.kept):
        paths[i].unlink()
    return align_clock(robot, times), [paths[i].stem for i in times.kept]


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


def _write_tables(
    folder: Path, robot: Timeline, joints: Mapping[str, list[float]], frames: Mapping[str, tuple[Timeline, list[str]]]
) -> int:
    """Write joints.csv and frames.csv, and return the time that is 0 in them. [ns]."""
    origin = int(min(times.time[0] for times in (robot, *(times for times, _ in frames.values()))))

    def seconds(times: Timeline) -> list[float]:
        # From there on a double holds 104 days to the nanosecond.
        return [ns / 1e9 for ns in (times.time - origin).tolist()]

    write_table(folder / "joints.csv", ["time", *joints], [seconds(robot), *joints.values()])
    rows = [
        (name, *row) for name, (times, labels) in frames.items() for row in zip(labels, seconds(times), strict=True)
    ]
    write_table(folder / "frames.csv", ["camera", "frame", "time"], zip(*rows, strict=True))
    return origin
