"""Sessions and rigs as folders: a YAML file, the cameras, and the tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import MEASUREMENTS, Detections, Points
from urdfcal.io import frame_tables, tables
from urdfcal.io.checks.plausibility import Inputs, Taken, check, check_positions
from urdfcal.io.writing import write_session
from urdfcal.names import suggest
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Urdf, find_urdf
from urdfcal.session.attachments import WORLD
from urdfcal.session.knowledge import Led
from urdfcal.session.model import Positions, RigDescription, Session, Stand
from urdfcal.source import Source

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.schema import SessionFile, SetupFile
    from urdfcal.io.yaml_document import Document
    from urdfcal.robot.mechanism import Mechanism

__all__ = [
    "detections_path",
    "lacks_detections",
    "read_points",
    "read_positions",
    "read_rig",
    "read_session",
    "write_session",
]

# What `urdfcal detect` reads and writes.
IMAGES, DETECTIONS = "images", "detections.csv"
_SESSION, _RIG = "session.yaml", "rig.yaml"


def read_session(path: str | Path) -> Session:
    """Read a session and check that it can be trusted.

    Args:
        path: the session's folder, or the YAML file in it.

    Returns:
        The session; its ``warnings`` name what looks odd but may be right.

    Raises:
        SessionError: a file is missing, malformed or implausible, with file, line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    document, keys = _read_document(Path(path))
    setup = _read_setup(document, keys)
    placed = _read_poses(document, keys, setup)
    files = {kind: _file(document, kind.kind) for kind in keys.tables}
    detected = _detections_file(document, keys)
    if detected is not None:
        files = {Detections: detected, **files}
    if not files:
        raise SessionError(
            f"none of {', '.join(kind.kind for kind in MEASUREMENTS)} are named: there is nothing to calibrate from",
            where=document.place(),
            remedy="Run `urdfcal detect` on its images first." if _has_images(document) else "",
        )
    tables = tuple(placed.read(files[kind], kind, setup["noise"].of(kind)) for kind in MEASUREMENTS if kind in files)
    warnings = check(_inputs(document, setup, placed, tables))
    named = {kind: keys.tables.get(kind, DETECTIONS) for kind in files}
    hashes = {named[table.kind]: table.table.source.sha256 for table in tables}
    return Session(
        **{**setup, "sha256": {**setup["sha256"], **placed.sha256, **hashes}},
        **placed.poses,
        measurements=tuple(table.measurements for table in tables),
        warnings=placed.warnings + warnings,
    )


def read_positions(path: str | Path) -> Positions:
    """Read a session without its measurements, as `urdfcal detect` needs it: they are still in its images.

    Args:
        path: the session's folder, or the YAML file in it.

    Raises:
        SessionError: a file is missing, malformed or implausible, with file, line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    document, keys = _read_document(Path(path))
    setup = _read_setup(document, keys)
    if not setup["rig"].cameras:
        raise SessionError("no cameras are named", where=document.place(), remedy="Images need a camera file.")
    placed = _read_poses(document, keys, setup)
    warnings = check_positions(_inputs(document, setup, placed, ()))
    return Positions(**setup, **placed.poses, warnings=placed.warnings + warnings)


def lacks_detections(path: str | Path) -> bool:
    """Whether a session has images, but nobody has looked for LEDs in them yet.

    Raises:
        SessionError: session.yaml is missing or malformed.
    """
    document, keys = _read_document(Path(path))
    return not keys.tables and _has_images(document) and _detections_file(document, keys) is None


def detections_path(path: str | Path) -> Path:
    """Where a session's detections are, or will be.

    Raises:
        SessionError: session.yaml is missing or malformed.
    """
    document, keys = _read_document(Path(path))
    return document.source.path.parent / keys.tables.get(Detections, DETECTIONS)


def read_rig(path: str | Path) -> RigDescription:
    """Read a rig.

    Args:
        path: the rig's folder, or the YAML file in it.

    Raises:
        SessionError: rig.yaml is missing or malformed, with line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    from urdfcal.io.schema import RigFile
    from urdfcal.io.yaml_document import Document

    document = Document.read(_yaml_file(Path(path), _RIG))
    keys = document.validate(RigFile)
    stand = None if keys.stand is None else Stand(keys.stand.position, keys.stand.look_at)  # type: ignore[arg-type]
    setup = _read_setup(document, keys)
    on_links = {mount.camera for mount in setup["mounts"]}
    if stand is None and not set(setup["rig"].names) <= on_links:
        raise SessionError(
            "the key 'stand' is missing",
            where=document.place(),
            remedy="It says where the first camera stands that is on no link.",
        )
    return RigDescription(**setup, stand=stand)


def read_points(path: str | Path, session: Session) -> tuple[Points, tuple[Led, ...]]:
    """Read a table of measured points that is not the session's own, as for a check by a second instrument.

    Args:
        path: the file, as points.csv.
        session: whose poses the labels refer to, and whose noise holds where the table has no sigma.

    Returns:
        The points, and the LEDs that the file names: their places are not known.

    Raises:
        SessionError: the file cannot be read, or names other poses, with line and column.
    """
    table = tables.read_measurements(Path(path), Points, {"pose": session.poses}, session.noise.point)
    points = Points(table.index["pose"], table.index["led"], table.values, table.sigma)
    return points, tuple(Led(name) for name in table.names["led"])


def _read_document(path: Path) -> tuple[Document, SessionFile]:
    from urdfcal.io.schema import SessionFile
    from urdfcal.io.yaml_document import Document

    document = Document.read(_yaml_file(path, _SESSION))
    return document, document.validate(SessionFile)


@dataclass(frozen=True, eq=False)
class _Placed:
    """Where the arm was: read from joints.csv, and of an arm that moved from frames.csv as well.

    Attributes:
        poses: arguments of :class:`Positions`.
        joints: the table of readings.
        taken: what was measured at.
        sha256: of the tables that were read, the hash by the name in the session.
        read: reads a table of measurements (path, kind, usual sigma in the kind's unit).
        warnings: what was ignored or left out.
    """

    poses: Mapping[str, Any]
    joints: tables.JointTable | frame_tables.LogTable
    taken: Taken
    sha256: Mapping[str, str]
    read: Callable[[Path, type[Measurement], float], tables.MeasurementTable]
    warnings: tuple[str, ...]


def _inputs(
    document: Document, setup: Mapping[str, Any], placed: _Placed, tables: tuple[tables.MeasurementTable, ...]
) -> Inputs:
    declared = setup["chain"], setup["leds"], setup["rig"], setup["noise"]
    return Inputs(document, *declared, placed.joints, placed.taken, tables)


def _read_poses(document: Document, keys: SessionFile, setup: Mapping[str, Any]) -> _Placed:
    return _read_still(document, keys, setup) if keys.frames is None else _read_moving(document, keys, setup)


def _read_still(document: Document, keys: SessionFile, setup: Mapping[str, Any]) -> _Placed:
    chain = setup["chain"]
    joints = tables.read_joints(_file(document, "joints"), chain, setup["urdf"].joints)
    names = {"pose": joints.poses, "camera": setup["rig"].names, "led": [led.name for led in setup["leds"]]}
    return _Placed(
        poses={"poses": joints.poses, "q": chain.joint_values(joints.readings), "time": joints.time},
        joints=joints,
        taken=Taken(joints.table.path, joints.poses, joints.readings, still=0.0),
        sha256={keys.joints: joints.table.source.sha256},
        read=lambda path, kind, sigma: tables.read_measurements(path, kind, names, sigma),
        warnings=joints.warnings,
    )


def _read_moving(document: Document, keys: SessionFile, setup: Mapping[str, Any]) -> _Placed:
    chain = setup["chain"]
    joints = frame_tables.read_log(_file(document, "joints"), chain, setup["urdf"].joints)
    taken = frame_tables.read_frames(_file(document, "frames"), setup["rig"].names)
    trajectory, pose, warnings = frame_tables.combine(joints, taken, chain)
    labels = tuple(f"{taken.cameras[c]}/{trajectory.label(k)}" for k, c in enumerate(trajectory.camera.tolist()))
    q = trajectory.values(np.zeros(len(taken.cameras)))
    leds = [led.name for led in setup["leds"]]
    return _Placed(
        poses={"poses": labels, "q": q, "time": trajectory.time, "motion": trajectory},
        joints=joints,
        taken=Taken(taken.table.path, labels, chain.readings(q), still=frame_tables.STILL),
        sha256={keys.joints: joints.table.source.sha256, str(keys.frames): taken.table.source.sha256},
        read=lambda path, _, sigma: frame_tables.read_frame_detections(path, taken, pose, leds, sigma),
        warnings=(*joints.warnings, *warnings),
    )


def _detections_file(document: Document, keys: SessionFile) -> Path | None:
    """The table of detections: as named, or, of a session with images and nothing named, as detected in them."""
    if Detections in keys.tables:
        return _file(document, "detections")
    default = document.source.path.parent / DETECTIONS
    images = not keys.tables and keys.cameras is not None and _has_images(document)
    return default if images and default.is_file() else None


def _has_images(document: Document) -> bool:
    return (document.source.path.parent / IMAGES).is_dir()


def _yaml_file(path: Path, name: str) -> Path:
    """The YAML file meant by ``path``, a folder or the file itself."""
    try:
        if not path.is_dir():
            if not path.exists():
                raise SessionError("there is no such folder", where=str(path), remedy=f"Name a folder with a {name}.")
            return path
        if (path / name).is_file():
            return path / name
    except PermissionError as error:
        raise SessionError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if name == _SESSION and (path / _RIG).is_file():
        remedy = "It is a rig: `urdfcal simulate` makes a session of it."
    elif name == _RIG and (path / _SESSION).is_file():
        remedy = "It is a session, not a rig."
    else:
        remedy = f"Name a folder with a {name}."
    raise SessionError(f"there is no {name} in this folder", where=str(path), remedy=remedy)


def _read_mechanism(document: Document, keys: SetupFile, urdf: Urdf) -> Mechanism:
    """The joints to the tip link and to every other link that carries an LED or a camera."""
    links = {keys.robot.tip_link: ("robot", "tip_link")}
    for name, led in keys.leds.items():
        links.setdefault(led.link or WORLD, ("leds", name))
    for mount in keys.cameras.mounts if keys.cameras is not None else ():
        links.setdefault(mount.link, ("cameras", mount.camera))
    base = keys.robot.base_link or urdf.root
    wanted = [link for link in links if link not in (WORLD, base) or link == keys.robot.tip_link]
    for link in wanted[1:]:
        if link not in urdf.links:
            raise SessionError(
                f"there is no link {link!r}",
                where=document.place(*links[link]),
                remedy=suggest(link, tuple(urdf.links), "links"),
            )
    return read_mechanism(urdf, wanted, keys.robot.base_link)


def _file(document: Document, key: str, name: str | None = None) -> Path:
    """The file that ``key`` names, relative to the YAML file."""
    name, folder = name or document.data[key], document.source.path.parent
    path: Path = folder / name
    if path.is_file():
        return path
    there = sorted(entry.name for entry in folder.iterdir() if entry.is_file())
    raise SessionError(
        f"there is no file {name!r}", where=document.place(key), remedy=suggest(name, there, "files here")
    )


def _read_setup(document: Document, keys: SetupFile) -> dict[str, Any]:
    """What a rig and a session share, as arguments of :class:`Setup`."""
    from urdfcal.cameras.io.formats import read_kalibr

    folder = document.source.path.parent
    urdf = Urdf.read(find_urdf(keys.robot.urdf, folder))
    chain = _read_mechanism(document, keys, urdf)
    hashes = {document.source.path.name: document.source.sha256, keys.robot.urdf: Source(folder, urdf.data).sha256}
    rig = Rig()
    if keys.cameras is not None:
        path = _file(document, "cameras", keys.cameras.file)
        rig = read_kalibr(path)
        hashes[keys.cameras.file] = Source.read(path).sha256
        for mount in keys.cameras.mounts:
            if mount.camera not in rig.names:
                raise SessionError(
                    f"there is no camera {mount.camera!r}",
                    where=document.place("cameras", mount.camera),
                    remedy=suggest(mount.camera, rig.names, "cameras"),
                )
    rows = rows_of(chain).labels if keys.tolerances.joints else ()
    for joint in keys.tolerances.joints:
        if joint not in rows:
            raise SessionError(
                f"there is no joint {joint!r} between {chain.base_link!r} and {chain.tip_link!r}",
                where=document.place("tolerances", joint),
                remedy=suggest(joint, rows, "joints"),
            )
    return {
        **keys.setup(),
        "chain": chain,
        "urdf": urdf,
        "urdf_reference": keys.robot.urdf,
        "rig": rig,
        "sha256": hashes,
        "folder": folder,
    }
