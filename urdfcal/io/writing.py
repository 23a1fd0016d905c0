"""Writing a session folder: what is read back is what was written, to the last bit."""

from __future__ import annotations

import csv
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.estimation.measurements.points import SPREAD, CorrelatedPoints
from urdfcal.files import told
from urdfcal.names import check_names
from urdfcal.robot.gravity import STANDARD_GRAVITY
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.exclusion import restored
from urdfcal.session.model import Session, before
from urdfcal.session.trajectory import Trajectory
from urdfcal.temporaries import temporary

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.attachments import CameraMount
    from urdfcal.session.measurements import Measurements
    from urdfcal.session.model import Positions, Setup
    from urdfcal.session.target import Target

_SESSION = "session.yaml"
_CAMERAS, _JOINTS, _FRAMES = "cameras.yaml", "joints.csv", "frames.csv"


def write_session(folder: str | Path, session: Positions) -> None:
    """Write a session so that reading it gives the same one; all of it or nothing.

    One without measurements is for images to be put beside it. What was left out when it was read is written, too, and
    that it is excluded.

    A URDF named as ``package://`` stays in its package; any other is copied beside the tables.

    Args:
        folder: where to; made if it is not there, in a folder that is.
        session: what to write.

    Raises:
        OutputError: one of the files is already there, the folder cannot be written, or the session has no URDF, is
            several in one, or a camera's pose is known differently well in different directions.
    """
    folder = Path(folder)
    urdf = session.urdf
    if urdf is None:
        raise OutputError("the session has no URDF to write", where=str(folder), remedy="Build its chain from a URDF.")
    if len(session.parts) > 1:
        raise OutputError("it is several sessions in one", where=str(folder), remedy="Write each of them.")
    if (folder / _SESSION).exists():
        raise _already_there(folder / _SESSION)
    check_names("cameras", session.rig.names)
    if isinstance(session, Session):
        session = restored(session)
    with put_into(folder) as partial:
        _write_files(partial, session, urdf)


@contextmanager
def put_into(folder: Path) -> Iterator[Path]:
    """Yield an empty folder; when the block succeeds, put what is in it into ``folder``, session.yaml last.

    Args:
        folder: where to; made if it is not there, in a folder that is.

    Raises:
        OutputError: one of the files is already there, or the folder cannot be written.
    """
    remedy = "Name a folder that can be written."
    with told(folder, remedy), temporary(folder.absolute().parent, folder.name, Path.mkdir) as partial:
        yield partial
        _move(partial, folder)


def write_measurements(path: Path, positions: Positions, table: Measurements) -> None:
    """Write a table of measurements; sigmas only where they differ from the usual one, covariances where there are.

    Args:
        path: the file.
        positions: whose poses, cameras and LEDs the table refers to.
        table: what was measured.
    """
    labels = [positions.label(k) for k in range(len(positions.poses))]
    names = {"pose": labels, "camera": positions.rig.names, "led": positions.led_names, **table.names}
    names["target"] = [target.name for target in positions.targets]
    usual = positions.noise.spreads(type(table))
    own = {name: of.tolist() for name in usual if np.any((of := getattr(table, name)) != usual[name])}
    if isinstance(table, CorrelatedPoints):
        own = dict(zip(SPREAD, table.spread.T.tolist(), strict=True))
    columns = [[names[key][i] for i in index] for key, index in table.index.items()]
    header = [*table.keys, *table.columns, *own]
    numbers = table.values.T.tolist() if table.columns else []
    write_table(path, header, [*columns, *numbers, *own.values()])


def _already_there(path: Path) -> OutputError:
    return OutputError("it is already there", where=str(path), remedy="Name another folder, or remove it first.")


def _move(partial: Path, folder: Path) -> None:
    """Move the files from ``partial`` to ``folder``, session.yaml last."""
    if not folder.exists():
        partial.rename(folder)
        return
    names = sorted((path.name for path in partial.iterdir()), key=lambda name: name == _SESSION)
    for name in names:
        if (folder / name).exists():
            raise _already_there(folder / name)
    with ExitStack() as undo:
        for name in names:
            moved = (partial / name).rename(folder / name)
            undo.callback(moved.rename, partial / name)
        undo.pop_all()


def write_setup(folder: Path, setup: Setup, urdf: Urdf) -> dict[str, Any]:
    """Write the robot, unless it is in a package, and the cameras; return what session.yaml says of them."""
    from urdfcal.cameras.io.formats import write_kalibr

    reference, chain = setup.urdf_reference, setup.chain
    if not reference.startswith("package://"):
        reference = Path(reference).name or f"{chain.name}.urdf"
        (folder / reference).write_bytes(urdf.data)
    content: dict[str, Any] = {
        "robot": {"urdf": reference, "base_link": chain.base_link, "tip_link": chain.tip_link},
        "leds": {led.name: _said(link=led.link, position=led.position, sigma=led.sigma) for led in setup.leds},
        "targets": {target.name: _target_keys(target) for target in setup.targets},
        "led_distances": [vars(of) | {"leds": list(of.leds)} for of in setup.led_distances],
        "place_distances": [vars(of) | {"places": list(of.places)} for of in setup.place_distances],
    }
    if setup.rig.cameras:
        mounts = {mount.camera: _mount_keys(mount) for mount in setup.mounts}
        content["cameras"] = {"file": _CAMERAS, **mounts} if mounts else _CAMERAS
        write_kalibr(folder / _CAMERAS, setup.rig)
    return content


def write_keys(folder: Path, content: Mapping[str, Any]) -> None:
    """Write session.yaml, without keys that say nothing."""
    import yaml

    said = {key: value for key, value in content.items() if value}
    text = yaml.safe_dump(said, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / _SESSION).write_text(text, encoding="utf-8")


def _write_files(folder: Path, session: Positions, urdf: Urdf) -> None:
    chain, motion = session.chain, session.motion
    content = write_setup(folder, session, urdf)
    content["joints"] = _JOINTS
    if isinstance(motion, Trajectory):
        readings = chain.readings(motion.log.values).T.tolist()
        write_table(folder / _JOINTS, ["time", *chain.actuated], [motion.log.time.tolist(), *readings])
        content["frames"] = _FRAMES
        labels = [motion.label(k) for k in range(len(motion.time))]
        columns = [[session.rig.names[c] for c in motion.camera], labels, motion.time.tolist()]
        write_table(folder / _FRAMES, ["camera", "frame", "time"], columns)
    else:
        time = {} if session.time is None else {"time": session.time.tolist()}
        columns = [session.poses, *session.readings.T.tolist(), *time.values()]
        write_table(folder / _JOINTS, ["pose", *chain.actuated, *time], columns)
        elsewhere = np.flatnonzero((session.came_from != before(session.q, session.time)).any(axis=1))
        all_poses = np.arange(len(session.poses))
        for name, values, of in (
            ("torques", session.torques, all_poses),
            ("previous", session.came_from if len(elsewhere) else None, elsewhere),
        ):
            if values is not None:
                content[name] = f"{name}.csv"
                columns = [[session.poses[k] for k in of], *chain.readings(values[of]).T.tolist()]
                write_table(folder / content[name], ["pose", *chain.actuated], columns)
    if isinstance(session, Session):
        for table in session.measurements:
            content[table.kind] = f"{table.kind}.csv"
            write_measurements(folder / f"{table.kind}.csv", session, table)
        content["exclude"] = session.excluded.named
    content["moved"] = {what: list(labels) for what, labels in session.moved.items()}
    estimate = _said(**{**vars(session.estimate), "gravity": None})
    gravity = [] if np.array_equal(session.gravity, STANDARD_GRAVITY) else session.gravity.tolist()
    content |= {
        "noise": _said(**{**vars(session.noise), "other": None}, **session.noise.other),
        "estimate": {key: value if isinstance(value, str) else dict(value) for key, value in estimate.items()},
        "tolerances": _said(**{**vars(session.tolerances), "joints": None}),
        "joint_models": {
            name: said if isinstance(said, bool | str) else dict(said) for name, said in session.joint_models.items()
        },
        "scale": _said(sigma=session.scale_sigma),
        "payload": {} if session.payload is None else _said(**vars(session.payload)),
        "gravity": _said(direction=session.estimate.gravity) or gravity,
        "gear_ratio": dict(session.gear_ratio),
        "scene": {box.name: _said(**{**vars(box), "name": None}) for box in session.scene},
        "about": dict(session.about),
    }
    content["tolerances"] |= {name: dict(values) for name, values in session.tolerances.joints.items()}
    write_keys(folder, content)


def _said(**keys: Any) -> dict[str, Any]:
    """What is not None, arrays as lists."""
    given = {key: value for key, value in keys.items() if value is not None}
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in given.items()}


def _mount_keys(mount: CameraMount) -> dict[str, Any]:
    return {"link": mount.link, **_place_keys(mount.T_link_camera, mount.sigma, f"camera {mount.camera!r}")}


def _target_keys(target: Target) -> dict[str, Any]:
    pattern = {entry.name: getattr(target.pattern, entry.name) for entry in fields(target.pattern)}  # type: ignore[arg-type]
    if "tags" in pattern:
        pattern["tags"] = {number: _said(**vars(place)) for number, place in pattern["tags"].items()}
    pattern = {key: list(value) if isinstance(value, tuple) else value for key, value in pattern.items()}
    scale = None if target.scale_sigma is None else {"sigma": target.scale_sigma}
    place = _place_keys(target.T_link_target, target.sigma, f"target {target.name!r}")
    return {
        **_said(kind=target.pattern.kind, **pattern, link=target.link, scale=scale, flatness=target.flatness),
        **place,
    }


def _place_keys(T: Floats | None, sigma: Floats | None, where: str) -> dict[str, Any]:
    if sigma is not None and not np.array_equal(sigma, np.repeat(sigma[::3], 3)):
        what = f"the standard deviations of its place differ by direction: {sigma.tolist()}"
        remedy = "session.yaml has one for its position and one for its turn: give three and three alike."
        raise OutputError(what, where=where, remedy=remedy)
    place = {} if T is None else {"position": T[:3, 3], "rpy": matrix_to_rpy(T[:3, :3])}
    return _said(**place, sigma=None if sigma is None else sigma[::3])


def write_table(path: Path, header: Sequence[str], columns: Iterable[Sequence[object]]) -> None:
    """Write a CSV file from the names and the cells of its columns."""
    # The csv module writes numbers in the shortest form that reads back as themselves.
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))
