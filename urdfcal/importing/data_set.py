"""A data set of LeRobot made into a session: of an arm that stopped to be seen, or of one that moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.images.files import write_image
from urdfcal.io.folder import IMAGES
from urdfcal.io.motors import RANGE, STEPS, read_motors
from urdfcal.io.writing import put_into, write_keys, write_session, write_setup, write_table
from urdfcal.names import check_known, listed, suggest
from urdfcal.rosbag.clock import Timeline
from urdfcal.rosbag.stills import find_stills
from urdfcal.session.knowledge import Noise
from urdfcal.session.model import MIN_POSES, Positions, Setup, before

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from urdfcal.arrays import Bools, Floats
    from urdfcal.importing.lerobot import DataSet
    from urdfcal.robot.urdf.urdf import Urdf

StateUnit = Literal["degrees", "normalized", "radians"]
"""What a data set's joint states are in; normalized: from -100 to 100 between the ends of a motor's range."""

# Between episodes nobody knows how the arm moved: longer than any gap in a log that is bridged. [s]
_BETWEEN = 10.0
_GRIPPER, _END = "gripper", 100.0


@dataclass(frozen=True, eq=False)
class DataSetReadings:
    """What the arm's joints read in K frames of a data set.

    Attributes:
        time: (K,) increasing, episodes some time apart. [s]
        values: (K, n). [rad]
        episode: (K,) which one.
        row: (K,) which of its frames.
        warnings: what was left out.
    """

    time: Floats
    values: Floats
    episode: list[int]
    row: list[int]
    warnings: tuple[str, ...]


def read_joints(
    of: DataSet, joints: tuple[str, ...], named: Mapping[str, str], state: StateUnit, motors: Path | None
) -> DataSetReadings:
    """Read what the joints of an arm were.

    Args:
        of: the data set.
        joints: of the robot.
        named: by joint the motor's name where that is another one.
        state: what the motors' numbers are.
        motors: LeRobot's calibration of them, for normalized ones.

    Raises:
        SessionError: a joint is none or has no motor, what the motors' numbers mean is not known, or too few frames are
            left.
    """
    for joint in named:
        check_known(joint, joints, "joints", "--column")
    columns = []
    for joint in joints:
        motor = named.get(joint, joint)
        if motor not in of.motors:
            remedy = f"{suggest(motor, of.motors, 'motors')} Say which it is: --column '{joint}=MOTOR'."
            raise SessionError(f"there is no motor {motor!r} for {joint}", where=str(of.path), remedy=remedy)
        columns.append(of.motors.index(motor))
    names = [of.motors[k] for k in columns]
    if _GRIPPER in names and state != "radians":
        what = "LeRobot reads the gripper as a share of its range, not as an angle"
        raise SessionError(what, where=str(of.path), remedy="Name a --tip before it.")
    scale, time, start = _radians(names, state, motors), [], 0.0
    for episode in of.episodes:
        time.append(start + episode.time - episode.time[0])
        start = float(time[-1][-1]) + _BETWEEN
    raw = np.concatenate([episode.state[:, columns] for episode in of.episodes])
    number = np.repeat(np.arange(len(of.episodes)), [len(episode.time) for episode in of.episodes])
    row = np.concatenate([np.arange(len(episode.time)) for episode in of.episodes])
    beyond = np.abs(raw) >= _END if state == "normalized" else np.zeros(raw.shape, bool)
    kept, warnings = np.flatnonzero(~beyond.any(axis=1)), []
    if len(kept) < len(raw):
        warnings.append(
            f"{len(raw) - len(kept)} of {len(raw)} frames are left out, in which a joint is at an end of its "
            "range, or beyond: LeRobot reads no farther"
        )
    if len(kept) < MIN_POSES:
        raise _too_few(str(of.path), names, beyond)
    times = np.concatenate(time)[kept]
    return DataSetReadings(times, raw[kept] * scale, number[kept].tolist(), row[kept].tolist(), tuple(warnings))


def import_data_set(
    of: DataSet,
    setup: Setup,
    urdf: Urdf,
    readings: DataSetReadings,
    folder: Path,
    progress: Callable[[int], object] | None = None,
    *,
    stills: bool = False,
) -> tuple[str, ...]:
    """Write a session of a data set; all of it or nothing.

    Args:
        of: the data set, with the videos of the setup's cameras.
        setup: the robot, its LEDs and targets, and the cameras.
        urdf: its description.
        readings: of its joints.
        folder: where to; made if need be, in a folder that exists.
        progress: called with the number of images written since the last call.
        stills: make a pose of each time that the arm stood still, and leave the rest out.

    Returns:
        What is to be said of it.

    Raises:
        SessionError: the arm stood still too seldom.
        CameraError: a video cannot be read, has another number of images, or another size than its camera.
        OutputError: the folder holds a session already, or cannot be written.
    """
    if stills:
        times = Timeline("observation.state", np.arange(len(readings.time)), np.rint(1e9 * readings.time), 0, ())
        still = find_stills(times, readings.values)
        labels = {row - 1: f"{k + 1:03d}" for k, row in still.nearest(times).items()}
    else:
        labels = {k: f"{k + 1:06d}" for k in range(len(readings.time))}
    with put_into(folder) as partial:
        for camera in setup.rig.cameras:
            (partial / IMAGES / camera.name).mkdir(parents=True)
        _write_images(of, setup, readings, labels, partial / IMAGES, progress)
        if not stills:
            _write_moving(setup, urdf, readings, labels, partial)
            said = "times of data sets are counted, not taken: where the arm stopped to be seen, --stills is better"
            return (*readings.warnings, said)
        q, time = setup.chain.joint_values(still.readings), readings.time[list(labels)]
        previous = before(q, time)
        # Where an episode begins nobody knows where the arm came from: hands have moved it in between.
        begins = np.diff(np.array(readings.episode)[list(labels)], prepend=-1) > 0
        previous[begins] = q[begins]
        positions = Positions(
            **setup.of_setup(noise=Noise(joint=still.sigma or None)),
            poses=tuple(labels.values()),
            q=q,
            time=time,
            previous=previous,
        )
        write_session(partial, positions)
    said = f"the joints were read to {still.sigma:.2g} rad where the arm stood still, {len(labels)} times"
    return (*readings.warnings, said)


def _radians(names: list[str], state: StateUnit, path: Path | None) -> Floats:
    """(n,) how many radians one of a motor's numbers is."""
    if state != "normalized":
        return np.full(len(names), 1.0 if state == "radians" else np.pi / 180.0)
    if path is None:
        what = "how far the motors go from -100 to 100 is not known"
        raise SessionError(what, where="--motors", remedy="Name LeRobot's calibration of the arm: --motors FILE.json.")
    motors, scale = read_motors(path), []
    for name in names:
        if name not in motors:
            raise SessionError(f"there is no motor {name!r}", where=str(path), remedy=f"They are {listed(motors)}.")
        low, high = (motors[name][key] for key in RANGE)
        # As MotorsBus._normalize has it: backwards where its drive mode is 1.
        sign = -1.0 if motors[name].get("drive_mode") else 1.0
        scale.append(sign * (high - low) / (2.0 * _END) * 2.0 * np.pi / STEPS)
    return np.array(scale)


def _too_few(where: str, names: list[str], beyond: Bools) -> SessionError:
    """Say why hardly a frame is left of (K, n), in which motors are at an end of their ranges."""
    if not beyond.any():
        return SessionError(f"{len(beyond)} frames are too few", where=where, remedy="Record the arm for longer.")
    worst = int(beyond.sum(axis=0).argmax())
    what = f"{names[worst]} is at an end of its range, or beyond, in {beyond[:, worst].sum()} of {len(beyond)} frames"
    remedy = "Record it with its motors within their ranges, or in degrees: use_degrees of LeRobot's robot."
    return SessionError(f"{what}, where LeRobot reads no farther: too few are left", where=where, remedy=remedy)


def _write_images(
    of: DataSet,
    setup: Setup,
    readings: DataSetReadings,
    labels: Mapping[int, str],
    folder: Path,
    progress: Callable[[int], object] | None,
) -> None:
    for e, episode in enumerate(of.episodes):
        wanted = {readings.row[k]: label for k, label in labels.items() if readings.episode[k] == e}
        for camera in setup.rig.cameras if wanted else ():
            video, rows = episode.videos[camera.name], sorted(wanted)
            for row, frame in zip(rows, replace(video, rows=tuple(video.rows[k] for k in rows)), strict=True):
                write_image(folder / camera.name / f"{wanted[row]}.png", frame.lit(camera.resolution))
                if progress:
                    progress(1)


def _write_moving(setup: Setup, urdf: Urdf, readings: DataSetReadings, labels: Mapping[int, str], folder: Path) -> None:
    content = write_setup(folder, setup, urdf)
    time = readings.time.tolist()
    write_table(folder / "joints.csv", ["time", *setup.chain.actuated], [time, *readings.values.T.tolist()])
    rows = [(name, label, time[k]) for name in setup.rig.names for k, label in labels.items()]
    write_table(folder / "frames.csv", ["camera", "frame", "time"], zip(*rows, strict=True))
    write_keys(folder, {**content, "joints": "joints.csv", "frames": "frames.csv"})
