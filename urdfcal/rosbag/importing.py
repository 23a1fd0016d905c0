"""Import of a bag as a session of a moving arm: its cameras, joints.csv, frames.csv, and the images."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError, OutputError, SessionError
from urdfcal.io.folder import IMAGES
from urdfcal.io.writing import put_into, write_keys, write_session, write_setup, write_table
from urdfcal.names import listed
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rosbag.bag import TEXT, TRANSFORMS
from urdfcal.rosbag.cameras import TF_STATIC, BagCameras, read_bag_cameras
from urdfcal.rosbag.clock import align_clock, timeline
from urdfcal.rosbag.images import write_images
from urdfcal.rosbag.stills import find_stills
from urdfcal.session.attachments import WORLD
from urdfcal.session.knowledge import Noise
from urdfcal.session.model import Positions, Setup

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.cameras.camera import Camera
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.rosbag.bag import Bag, Message
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.stills import Stills
    from urdfcal.rosbag.topics import ChosenTopics
    from urdfcal.session.knowledge import Led
    from urdfcal.session.target import Target


@dataclass(frozen=True, eq=False)
class KnownRobot:
    """What a bag does not hold.

    Attributes:
        chain: the robot's.
        urdf: its description.
        urdf_reference: what session.yaml calls that: a file, which is copied, or ``package://...``.
        leds: its LEDs.
        targets: on it or in the world.
        rig: the cameras, if the bag does not describe them.
    """

    chain: Mechanism
    urdf: Urdf
    urdf_reference: str
    leds: tuple[Led, ...] = ()
    targets: tuple[Target, ...] = ()
    rig: Rig = field(default_factory=Rig)

    def carrying(self, links: Sequence[str]) -> KnownRobot:
        """Return the same with further links, those of cameras or targets, in its chain."""
        chain = self.chain
        carried = [link for link in dict.fromkeys(links) if link not in (WORLD, chain.base_link, chain.tip_link)]
        if not carried:
            return self
        return replace(self, chain=read_mechanism(self.urdf, (chain.tip_link, *carried), chain.base_link))


@dataclass(frozen=True, eq=False)
class ImportSummary:
    """What was imported from a bag.

    Attributes:
        origin: the time that is 0 in the session, on the robot's clock. [ns]
        joints: when the joint states were taken.
        cameras: when the images were taken, by camera.
        rig: the cameras.
        poses: number of poses in which the arm stood still; None of one that moved.
        notes: where the poses of the cameras come from that the bag describes, and how well joints were read.
        warnings: which messages were left out, and what was done to the times.
    """

    origin: int
    joints: Timeline
    cameras: Mapping[str, Timeline]
    rig: Rig
    poses: int | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def import_bag(
    bag: Bag,
    topics: ChosenTopics,
    known: KnownRobot,
    folder: str | Path,
    progress: Callable[[int], object] | None = None,
    *,
    stills: bool = False,
) -> ImportSummary:
    """Write a session from a bag; all of it or nothing.

    Of its images never more than a few are in memory.

    Args:
        bag: the recording.
        topics: of the joints and the cameras.
        known: what the bag does not hold.
        folder: where to; made if need be, in a folder that exists. It must be empty.
        progress: called with the number of messages read since the last call: those of ``topics`` and /tf_static.
        stills: make a pose of each time that the arm stood still, and leave the rest out.

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

    known = known.carrying([target.link for target in known.targets if target.link])
    joints = known.chain.actuated
    times, readings = read_joint_states(topics.joints, read(topics.joints), joints)
    seen = BagCameras(known.rig)
    if not known.rig.cameras:
        infos = [(name, info) for name, (_, info) in topics.cameras.items() if info is not None]
        static = [topic.name for topic in bag.topics if topic.name == TF_STATIC and topic.type == TRANSFORMS]
        seen = read_bag_cameras(infos, read(*(info for _, info in infos), *static))
    images = _image_topics(seen.rig, topics)
    mounts, notes = seen.mounts(known.urdf, known.chain.names)
    known = replace(known.carrying([mount.link for mount in mounts]), rig=seen.without_others(mounts))
    setup = Setup(**vars(known), mounts=mounts)
    with put_into(folder) as partial_:
        if stills:
            still = find_stills(times, readings)
            origin, taken, poses = _write_stills(partial_, setup, times, still, bag, images, read)
            notes += (f"the joints were read to {still.sigma:.2g} rad where the arm stood still",)
            warnings = poses
            count = len(still)
        else:
            frames = {
                name: written.in_order(times)
                for name, written in write_images(partial_ / IMAGES, read(*images), images).items()
            }
            content = write_setup(partial_, setup, known.urdf)
            write_keys(partial_, {**content, "joints": "joints.csv", "frames": "frames.csv"})
            origin = _write_tables(partial_, times, dict(zip(joints, readings.T.tolist(), strict=True)), frames)
            taken, warnings, count = {name: of for name, (of, _) in frames.items()}, (), None
    warnings = (*(warning for of in (times, *taken.values()) for warning in of.warnings), *warnings)
    return ImportSummary(origin, times, taken, setup.rig, count, (*seen.notes, *notes), warnings)


def read_description(bag: Bag) -> Urdf:
    """Read the robot's URDF from its topic, robot_description in any namespace; of several messages the last.

    Raises:
        SessionError: there is none, or several topics have one.
        RobotError: it is no URDF.
    """
    topics = [topic.name for topic in bag.topics if topic.type == TEXT and topic.name.endswith("robot_description")]
    if len(topics) != 1:
        what = (
            f"{len(topics)} topics have a robot: {listed(topics)}"
            if topics
            else "no topic robot_description has a robot"
        )
        raise SessionError(what, where=str(bag.path), remedy="Name the robot with --urdf ROBOT.urdf.")
    texts = [message.content.data for message in bag.messages(topics)]
    if not texts:
        raise SessionError("the topic has no message", where=topics[0], remedy="Name the robot with --urdf ROBOT.urdf.")
    return Urdf.parse(texts[-1].encode(), Path(topics[0]))


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


def _write_stills(
    folder: Path,
    setup: Setup,
    robot: Timeline,
    still: Stills,
    bag: Bag,
    images: Mapping[str, Camera],
    read: Callable[..., Iterator[Message]],
) -> tuple[int, dict[str, Timeline], tuple[str, ...]]:
    """Write the session of an arm that stood still, one image a camera and pose.

    Returns:
        The time that is 0 in it [ns], when the images of each camera were taken, and which poses are without.
    """
    stamps: dict[str, tuple[list[int], list[int]]] = {topic: ([], []) for topic in images}
    for message in bag.messages(tuple(images)):
        stamp, received = stamps[message.topic]
        stamp.append(message.stamp)
        received.append(message.received)
    times = {topic: align_clock(robot, timeline(topic, *of)) for topic, of in stamps.items()}
    labels = [f"{k + 1:03d}" for k in range(len(still))]
    chosen = {topic: still.nearest(of) for topic, of in times.items()}
    names = {(topic, number): labels[k] for topic, of in chosen.items() for k, number in of.items()}
    written = write_images(folder / IMAGES, read(*images), images, lambda topic, number: names.get((topic, number)))
    seen = {path.stem for of in written.values() for *_, path in of.files}
    used = [k for k, label in enumerate(labels) if label in seen]
    blank = [label for label in labels if label not in seen]
    warnings = [warning for of in written.values() for warning in of.warnings]
    warnings += [f"no camera has an image of {len(blank)} poses, which are left out: {listed(blank)}"] if blank else []
    if still.creeping:
        warnings.append(f"{still.creeping} times the arm crept on where it seemed to stand still: these are left out")
    origin = int(still.start[0])
    positions = Positions(
        **setup.of_setup(noise=Noise(joint=still.sigma or None)),
        poses=tuple(labels[k] for k in used),
        q=setup.chain.joint_values(still.readings[used]),
        time=np.array([(still.start[k] - origin) / 1e9 for k in used]),
    )
    write_session(folder, positions)
    return origin, {images[topic].name: of for topic, of in times.items()}, tuple(warnings)


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
