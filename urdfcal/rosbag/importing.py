"""Import of a bag as a session of a moving arm: its cameras, joints.csv, frames.csv, and the images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from urdfcal.errors import CameraError, OutputError
from urdfcal.io.folder import IMAGES
from urdfcal.io.writing import put_into, write_table
from urdfcal.names import listed
from urdfcal.rosbag.bag import TRANSFORMS
from urdfcal.rosbag.cameras import TF_STATIC, read_bag_cameras
from urdfcal.rosbag.clock import align_clock
from urdfcal.rosbag.images import write_images
from urdfcal.rosbag.joints import read_joint_states

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.bag import Bag, Message
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.images import WrittenImages
    from urdfcal.rosbag.joints import JointStates
    from urdfcal.rosbag.topics import ChosenTopics
    from urdfcal.session.knowledge import Led


@dataclass(frozen=True, eq=False)
class ImportSetup:
    """What a session needs and a bag does not hold.

    Attributes:
        urdf: the robot description.
        urdf_reference: how the session names it if it is in a package.
        chain: the joints that are calibrated.
        led: on the tip link.
        rig: the cameras; None: as the bag describes them.
    """

    urdf: Urdf
    urdf_reference: str
    chain: Chain
    led: Led
    rig: Rig | None


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
    setup: ImportSetup,
    folder: str | Path,
    progress: Callable[[int], object] | None = None,
) -> ImportSummary:
    """Write a session from a bag; all of it or nothing.

    Of its images never more than a few are in memory.

    Args:
        bag: the recording.
        topics: of the joints and the cameras.
        setup: what the bag does not hold.
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
    states = read_joint_states(topics.joints, read(topics.joints), joints)
    rig, notes = setup.rig, tuple[str, ...]()
    if rig is None:
        infos = [(camera.name, camera.info) for camera in topics.cameras if camera.info is not None]
        static = [topic.name for topic in bag.topics if topic.name == TF_STATIC and topic.type == TRANSFORMS]
        rig, notes = read_bag_cameras(infos, read(*(info for _, info in infos), *static))
    images = _image_topics(rig, topics)
    with put_into(folder) as partial:
        _write_setup(partial, setup, rig)
        written = write_images(partial / IMAGES, read(*images), images, rig.cameras)
        frames = {
            name: replace(of, times=align_clock(states.times, of.times))
            for name, of in zip(rig.names, written, strict=True)
        }
        origin = _write_tables(partial, states, joints, frames)
    warnings = (warning for of in frames.values() for warning in (*of.warnings, *of.times.warnings))
    cameras = {name: of.times for name, of in frames.items()}
    return ImportSummary(origin, states.times, cameras, rig, notes, (*states.warnings, *warnings))


def _image_topics(rig: Rig, topics: ChosenTopics) -> tuple[str, ...]:
    """Return the topics of the images, in the order of the cameras."""
    images = {camera.name: camera.image for camera in topics.cameras}
    if set(images) != set(rig.names):
        raise CameraError(
            f"the cameras described are {listed(rig.names)}, those in the bag are called {listed(images)}",
            remedy=f"Say which is which: --camera {rig.names[0]}={next(iter(images.values()))} and so on.",
        )
    return tuple(images[name] for name in rig.names)


def _write_setup(folder: Path, setup: ImportSetup, rig: Rig) -> None:
    """Write session.yaml, the cameras, and the robot unless it is in a package."""
    import yaml

    from urdfcal.cameras.io.formats import write_kalibr

    reference, chain, led = setup.urdf_reference, setup.chain, setup.led
    if not reference.startswith("package://"):
        reference = Path(reference).name
        (folder / reference).write_bytes(setup.urdf.data)
    content = {
        "robot": {"urdf": reference, "base_link": chain.base_link, "tip_link": chain.tip_link},
        "leds": {led.name: {} if led.position is None else {"position": led.position.tolist()}},
        "cameras": "cameras.yaml",
        "joints": "joints.csv",
        "frames": "frames.csv",
    }
    write_kalibr(folder / "cameras.yaml", rig)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / "session.yaml").write_text(text, encoding="utf-8")


def _write_tables(folder: Path, states: JointStates, joints: Sequence[str], frames: Mapping[str, WrittenImages]) -> int:
    """Write joints.csv and frames.csv, and return the time that is 0 in them. [ns]."""
    origin = int(min(times.time[0] for times in (states.times, *(of.times for of in frames.values()))))

    def seconds(times: Timeline) -> list[float]:
        # From there on a double holds 104 days to the nanosecond.
        return [ns / 1e9 for ns in (times.time - origin).tolist()]

    write_table(folder / "joints.csv", ["time", *joints], [seconds(states.times), *states.readings.T.tolist()])
    columns: list[list[Any]] = [[], [], []]
    for name, of in frames.items():
        columns[0] += [name] * len(of.labels)
        columns[1] += of.labels
        columns[2] += seconds(of.times)
    write_table(folder / "frames.csv", ["camera", "frame", "time"], columns)
    return origin
