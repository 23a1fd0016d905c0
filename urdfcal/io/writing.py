"""Writing a session folder: what is read back is what was written, to the last bit."""

from __future__ import annotations

import csv
import secrets
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import OutputError
from urdfcal.names import check_names
from urdfcal.rotations import matrix_to_rpy
from urdfcal.session.model import Session
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.attachments import CameraMount
    from urdfcal.session.knowledge import Led
    from urdfcal.session.measurement import Measurements
    from urdfcal.session.model import Positions, Setup

_SESSION = "session.yaml"
_CAMERAS, _JOINTS, _FRAMES = "cameras.yaml", "joints.csv", "frames.csv"


def write_session(folder: str | Path, session: Positions) -> None:
    """Write a session so that reading it gives the same one; all of it or nothing.

    One without measurements is for images to be put beside it.

    A URDF named as ``package://`` stays in its package; any other is copied beside the tables.

    Args:
        folder: where to; made if it is not there, in a folder that is.
        session: what to write.

    Raises:
        OutputError: one of the files is already there, the folder cannot be written, or the session has no URDF, or
            a camera's pose is known differently well in different directions.
    """
    folder = Path(folder)
    urdf = session.urdf
    if urdf is None:
        raise OutputError("the session has no URDF to write", where=str(folder), remedy="Build its chain from a URDF.")
    if (folder / _SESSION).exists():
        raise _already_there(folder / _SESSION)
    check_names("cameras", session.rig.names)
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
    partial = folder.parent / f".{folder.name}.{secrets.token_hex(4)}.partial"
    try:
        partial.mkdir()
        try:
            yield partial
            _move(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise OutputError(
            f"cannot write here: {error.strerror}", where=str(folder), remedy="Name a folder that can be written."
        ) from error


def write_measurements(path: Path, positions: Positions, table: Measurements) -> None:
    """Write a table of measurements; a column of sigmas only where they differ from the usual one.

    Args:
        path: the file.
        positions: whose poses, cameras and LEDs the table refers to.
        table: what was measured.
    """
    labels = [positions.label(k) for k in range(len(positions.poses))]
    names = {"pose": labels, "camera": positions.rig.names, "led": positions.led_names, **table.names}
    own = [table.sigma.tolist()] if np.any(table.sigma != positions.noise.of(type(table))) else []
    columns = [[names[key][i] for i in index] for key, index in table.index.items()]
    header = [*table.keys, *table.columns, *(["sigma"] if own else [])]
    numbers = table.values.T.tolist() if table.columns else []
    write_table(path, header, [*columns, *numbers, *own])


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
    moved: list[Path] = []
    try:
        for name in names:
            moved.append((partial / name).rename(folder / name))
    except OSError:
        for path in moved:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        raise


def _write_files(folder: Path, session: Positions, urdf: Urdf) -> None:
    import yaml

    from urdfcal.cameras.io.formats import write_kalibr

    reference, chain = session.urdf_reference, session.chain
    if not reference.startswith("package://"):
        reference = Path(reference).name or f"{chain.name}.urdf"
        (folder / reference).write_bytes(urdf.data)
    content: dict[str, Any] = {
        "robot": {"urdf": reference, "base_link": chain.base_link, "tip_link": chain.tip_link},
        "leds": {led.name: _led_keys(led) for led in session.leds},
    }
    if session.led_distances:
        content["led_distances"] = [
            {"leds": list(d.leds), "distance": d.distance, "sigma": d.sigma} for d in session.led_distances
        ]
    if session.rig.cameras:
        mounts = {mount.camera: _mount_keys(mount) for mount in session.mounts}
        content["cameras"] = {"file": _CAMERAS, **mounts} if mounts else _CAMERAS
        write_kalibr(folder / _CAMERAS, session.rig)
    content["joints"] = _JOINTS
    if isinstance(session.motion, Trajectory):
        content["frames"] = _FRAMES
        _write_trajectory(folder, session, session.motion)
    else:
        time = [] if session.time is None else [session.time.tolist()]
        header = ["pose", *chain.actuated, *(["time"] if time else [])]
        write_table(folder / _JOINTS, header, [session.poses, *session.readings.T.tolist(), *time])
    for table in session.measurements if isinstance(session, Session) else ():
        content[table.kind] = f"{table.kind}.csv"
        write_measurements(folder / f"{table.kind}.csv", session, table)
    content.update(_expectations(session))
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / _SESSION).write_text(text, encoding="utf-8")


def _write_trajectory(folder: Path, session: Positions, trajectory: Trajectory) -> None:
    """Write joints.csv by time, and frames.csv: the frames that are used."""
    chain, log = session.chain, trajectory.log
    write_table(
        folder / _JOINTS, ["time", *chain.actuated], [log.time.tolist(), *chain.readings(log.values).T.tolist()]
    )
    names = session.rig.names
    labels = [trajectory.label(k) for k in range(len(trajectory.time))]
    columns = [[names[c] for c in trajectory.camera], labels, trajectory.time.tolist()]
    write_table(folder / _FRAMES, ["camera", "frame", "time"], columns)


def _led_keys(led: Led) -> dict[str, Any]:
    keys = {
        "link": led.link,
        "position": None if led.position is None else led.position.tolist(),
        "sigma": led.sigma,
    }
    return {key: value for key, value in keys.items() if value is not None}


def _mount_keys(mount: CameraMount) -> dict[str, Any]:
    keys: dict[str, Any] = {"link": mount.link}
    if mount.T_link_camera is not None:
        keys["position"] = mount.T_link_camera[:3, 3].tolist()
        keys["rpy"] = matrix_to_rpy(mount.T_link_camera[:3, :3]).tolist()
    if mount.sigma is not None:
        if not np.array_equal(mount.sigma, np.repeat(mount.sigma[::3], 3)):
            raise OutputError(
                f"the standard deviations of its place differ by direction: {mount.sigma.tolist()}",
                where=f"camera {mount.camera!r}",
                remedy="session.yaml has one for its position and one for its turn: give three and three alike.",
            )
        keys["sigma"] = mount.sigma[::3].tolist()
    return keys


def _expectations(setup: Setup) -> dict[str, Any]:
    """Noise, estimate and tolerances, as far as they say anything."""
    tolerances = setup.tolerances
    content: dict[str, Any] = {
        "noise": {name: getattr(setup.noise, name) for name in ("pixel", "point", "joint")} | dict(setup.noise.other),
        "estimate": {
            key: value if isinstance(value, str) else dict(value)
            for key, value in vars(setup.estimate).items()
            if value is not None
        },
        "tolerances": {key: getattr(tolerances, key) for key in ("length", "angle", "zero")},
    }
    content["joint_models"] = dict(setup.joint_models)
    content["tolerances"] |= {name: dict(values) for name, values in tolerances.joints.items()}
    return {key: value for key, value in content.items() if value}


def write_table(path: Path, header: Sequence[str], columns: Iterable[Sequence[object]]) -> None:
    """Write a CSV file from the names and the cells of its columns."""
    # The csv module writes numbers in the shortest form that reads back as themselves.
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))
