"""From a bag to a session of a moving arm: its cameras, joints.csv, frames.csv, and the pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from urdfcal.errors import CameraError, OutputError
from urdfcal.io.folder import IMAGES
from urdfcal.io.writing import put_into, write_table
from urdfcal.names import listed
from urdfcal.rosbag.bag import TRANSFORMS
from urdfcal.rosbag.cameras import read_rig
from urdfcal.rosbag.clock import on_clock_of
from urdfcal.rosbag.images import write_pictures
from urdfcal.rosbag.joints import read_joint_states
from urdfcal.rosbag.static_transforms import TF_STATIC

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.bag import Bag, Message
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.images import Frames
    from urdfcal.rosbag.joints import JointStates
    from urdfcal.rosbag.topics import Chosen
    from urdfcal.session.knowledge import Led


@dataclass(frozen=True, eq=False)
class Known:
    """What a bag does not tell.

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
class Imported:
    """What became of a bag.

    Attributes:
        origin: the time that is 0 in the session, on the robot's clock. [ns]
        joints: when the joint states were taken.
        cameras: when the pictures were taken, by camera.
        rig: the cameras.
        notes: how it is known where the cameras stand that the bag describes.
        warnings: what was left out, or done to the times.
    """

    origin: int
    joints: Timeline
    cameras: Mapping[str, Timeline]
    rig: Rig
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def import_bag(
    bag: Bag, chosen: Chosen, known: Known, folder: str | Path, progress: Callable[[int], object] | None = None
) -> Imported:
    """Write a session from a bag; all of it or nothing. Of its pictures never more than a few are in memory.

    Args:
        bag: the recording.
        chosen: its topics.
        known: what it does not tell.
        folder: where to; made if need be, in a folder that exists. It must be empty.
        progress: called with the number of messages read since the last call: those of ``chosen`` and /tf_static.

    Raises:
        SessionError: the bag is damaged, or its joint states or times cannot be used.
        CameraError: a camera or a picture cannot be used.
        OutputError: the folder is not empty, or cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise OutputError(
            "there is something already", where=str(folder), remedy="Name another folder, or empty it first."
        )

    def counted(messages: Iterator[Message]) -> Iterator[Message]:
        for message in messages:
            if progress:
                progress(1)
            yield message

    states = read_joint_states(chosen.joints, counted(bag.messages([chosen.joints])), known.chain.actuated)
    rig, notes = known.rig, tuple[str, ...]()
    if rig is None:
        infos = [(camera.name, camera.info) for camera in chosen.cameras if camera.info is not None]
        static = [topic.name for topic in bag.topics if topic.name == TF_STATIC and topic.type == TRANSFORMS]
        rig, notes = read_rig(infos, counted(bag.messages([*(info for _, info in infos), *static])))
    images = _in_order_of(rig, chosen)
    with put_into(folder) as partial:
        _write_setup(partial, known, rig)
        taken = write_pictures(partial / IMAGES, counted(bag.messages(images)), images, rig.cameras)
        frames = {
            name: replace(of, times=on_clock_of(states.times, of.times))
            for name, of in zip(rig.names, taken, strict=True)
        }
        origin = _write_tables(partial, states, known.chain.actuated, frames)
    warnings = (warning for of in frames.values() for warning in (*of.warnings, *of.times.warnings))
    cameras = {name: of.times for name, of in frames.items()}
    return Imported(origin, states.times, cameras, rig, notes, (*states.warnings, *warnings))


def _in_order_of(rig: Rig, chosen: Chosen) -> tuple[str, ...]:
    """The topics of the pictures, in the order of the cameras."""
    images = {camera.name: camera.image for camera in chosen.cameras}
    if set(images) != set(rig.names):
        raise CameraError(
            f"the cameras described are {listed(rig.names)}, those in the bag are called {listed(images)}",
            remedy=f"Say which is which: --camera {rig.names[0]}={next(iter(images.values()))} and so on.",
        )
    return tuple(images[name] for name in rig.names)


def _write_setup(folder: Path, known: Known, rig: Rig) -> None:
    """Write session.yaml, the cameras, and the robot unless it is in a package."""
    import yaml

    from urdfcal.cameras.io.formats import write_kalibr

    reference, chain = known.urdf_reference, known.chain
    if not reference.startswith("package://"):
        reference = Path(reference).name
        (folder / reference).write_bytes(known.urdf.data)
    led = {} if known.led.position is None else {"position": known.led.position.tolist()}
    content = {
        "robot": {"urdf": reference, "base_link": chain.base_link, "tip_link": chain.tip_link},
        "leds": {known.led.name: led},
        "cameras": "cameras.yaml",
        "joints": "joints.csv",
        "frames": "frames.csv",
    }
    write_kalibr(folder / "cameras.yaml", rig)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / "session.yaml").write_text(text, encoding="utf-8")


def _write_tables(folder: Path, states: JointStates, joints: Sequence[str], frames: Mapping[str, Frames]) -> int:
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
