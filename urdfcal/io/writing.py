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

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.attachments import CameraMount
    from urdfcal.session.model import Detections, Led, Positions, Setup
    from urdfcal.session.trajectory import Trajectory

_SESSION = "session.yaml"
_CAMERAS, _JOINTS, _DETECTIONS, _POINTS = "cameras.yaml", "joints.csv", "detections.csv", "points.csv"
_FRAMES = "frames.csv"


def write_session(folder: str | Path, session: Positions) -> None:
    """Write a session so that reading it gives the same one; all of it or nothing.

    One without sightings is for images to be put beside it.

    A URDF named as ``package://`` stays in its package; any other is copied beside the tables.

    Args:
        folder: where to; made if it is not there, in a folder that is.
        session: what to write.

    Raises:
        OutputError: one of the files is already there, the folder cannot be written, or the session has no URDF, or
            a camera's place is known differently well in different directions.
    """
    folder = Path(folder)
    urdf = session.urdf
    if urdf is None:
        raise OutputError("the session has no URDF to write", where=str(folder), remedy="Build its chain from a URDF.")
    if (folder / _SESSION).exists():
        raise _already_there(folder / _SESSION)
    check_names("cameras", session.rig.names if session.rig else ())
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


def write_detections(path: Path, positions: Positions, seen: Detections) -> None:
    """Write detections.csv.

    Args:
        path: the file.
        positions: whose poses, cameras and LEDs were seen.
        seen: where.
    """
    cameras = positions.rig.names if positions.rig is not None else ()
    labels = [positions.label(k) for k in range(len(positions.poses))]
    keys = {"pose": (labels, seen.pose), "camera": (cameras, seen.camera)}
    keys["led"] = (positions.led_names, seen.led)
    _write_sightings(path, keys, "uv", seen.uv, seen.sigma, positions.noise.pixel)


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
    if session.rig is not None:
        mounts = {mount.camera: _mount_keys(mount) for mount in session.mounts}
        content["cameras"] = {"file": _CAMERAS, **mounts} if mounts else _CAMERAS
        write_kalibr(folder / _CAMERAS, session.rig)
    content["joints"] = _JOINTS
    if session.trajectory is not None:
        content["frames"] = _FRAMES
        _write_trajectory(folder, session, session.trajectory)
    else:
        time = [] if session.time is None else [session.time.tolist()]
        header = ["pose", *chain.actuated, *(["time"] if time else [])]
        write_table(folder / _JOINTS, header, [session.poses, *session.readings.T.tolist(), *time])
    if isinstance(session, Session) and session.detections is not None:
        content["detections"] = _DETECTIONS
        write_detections(folder / _DETECTIONS, session, session.detections)
    if isinstance(session, Session) and session.points is not None:
        content["points"] = _POINTS
        measured = session.points
        keys = {"pose": (session.poses, measured.pose), "led": (session.led_names, measured.led)}
        _write_sightings(folder / _POINTS, keys, "xyz", measured.xyz, measured.sigma, session.noise.point)
    content.update(_expectations(session))
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    (folder / _SESSION).write_text(text, encoding="utf-8")


def _write_trajectory(folder: Path, session: Positions, trajectory: Trajectory) -> None:
    """Write joints.csv by time, and frames.csv: the frames that are used."""
    chain, log = session.chain, trajectory.log
    write_table(
        folder / _JOINTS, ["time", *chain.actuated], [log.time.tolist(), *chain.readings(log.values).T.tolist()]
    )
    names = session.rig.names if session.rig is not None else ()
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
        "noise": dict(vars(setup.noise)),
        "estimate": {
            key: value if isinstance(value, str) else dict(value)
            for key, value in vars(setup.estimate).items()
            if value is not None
        },
        "tolerances": {key: getattr(tolerances, key) for key in ("length", "angle", "zero")},
    }
    content["tolerances"] |= {name: dict(values) for name, values in tolerances.joints.items()}
    return {key: value for key, value in content.items() if value}


def _write_sightings(
    path: Path,
    keys: Mapping[str, tuple[Sequence[str], Ints]],
    names: str,
    values: Floats,
    sigma: Floats,
    usual: float,
) -> None:
    """Write a table of sightings; a column of sigmas only where they differ from the usual one."""
    own = [sigma.tolist()] if np.any(sigma != usual) else []
    columns = [[labels[i] for i in index] for labels, index in keys.values()]
    header = [*keys, *names, *(["sigma"] if own else [])]
    write_table(path, header, [*columns, *values.T.tolist(), *own])


def write_table(path: Path, header: Sequence[str], columns: Iterable[Sequence[object]]) -> None:
    """Write a CSV file from the names and the cells of its columns."""
    # The csv module writes numbers in the shortest form that reads back as themselves.
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*columns, strict=True))
