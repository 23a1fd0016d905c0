"""Sessions and rigs as folders: a YAML file, the cameras, and the tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from urdfcal.errors import SessionError
from urdfcal.robot.tree import read_mechanism
from urdfcal.robot.tree_dh import MOUNT
from urdfcal.robot.urdf import Urdf, find_urdf
from urdfcal.session import tables
from urdfcal.session.frames import WORLD
from urdfcal.session.model import Detections, Led, Points, Positions, RigDescription, Session, Stand
from urdfcal.session.names import suggest
from urdfcal.session.plausibility import Inputs, check, check_positions
from urdfcal.session.source import Source
from urdfcal.session.writing import write_session

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.schema import Document, SessionFile, SetupFile

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
    chain, rig, noise = setup["chain"], setup["rig"], setup["noise"]
    led_names = [led.name for led in setup["leds"]]

    joints = tables.read_joints(_file(document, "joints"), chain, setup["urdf"].joints)
    detections = points = None
    detected = _detections_file(document, keys)
    if detected is None and keys.points is None:
        raise SessionError(
            "neither detections nor points are named: there is nothing to calibrate from",
            where=document.place(),
            remedy="Run `urdfcal detect` on its images first." if _has_images(document) else "",
        )
    if detected is not None:
        detections = tables.read_detections(detected, joints.poses, rig.names, led_names, noise.pixel)
    if keys.points is not None:
        points = tables.read_points(_file(document, "points"), joints.poses, led_names, noise.point)

    warnings = check(Inputs(document, chain, setup["leds"], rig, noise, joints, detections, points))
    named = {keys.joints: joints, keys.detections or DETECTIONS: detections, keys.points: points}
    hashes = {name: table.table.source.sha256 for name, table in named.items() if name and table}
    return Session(
        **{**setup, "sha256": {**setup["sha256"], **hashes}},
        poses=joints.poses,
        q=chain.joint_values(joints.readings),
        time=joints.time,
        detections=_detections(detections) if detections else None,
        points=_points(points) if points else None,
        warnings=joints.warnings + warnings,
    )


def read_positions(path: str | Path) -> Positions:
    """Read a session without its sightings, as `urdfcal detect` needs it: they are still in its images.

    Args:
        path: the session's folder, or the YAML file in it.

    Raises:
        SessionError: a file is missing, malformed or implausible, with file, line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    document, keys = _read_document(Path(path))
    setup = _read_setup(document, keys)
    if setup["rig"] is None:
        raise SessionError("no cameras are named", where=document.place(), remedy="Images need a camera file.")
    chain = setup["chain"]
    joints = tables.read_joints(_file(document, "joints"), chain, setup["urdf"].joints)
    warnings = check_positions(Inputs(document, chain, setup["leds"], setup["rig"], setup["noise"], joints, None, None))
    return Positions(
        **setup,
        poses=joints.poses,
        q=chain.joint_values(joints.readings),
        time=joints.time,
        warnings=joints.warnings + warnings,
    )


def lacks_detections(path: str | Path) -> bool:
    """Whether a session has images, but nobody has looked for LEDs in them yet.

    Raises:
        SessionError: session.yaml is missing or malformed.
    """
    document, keys = _read_document(Path(path))
    return keys.points is None and _has_images(document) and _detections_file(document, keys) is None


def detections_path(path: str | Path) -> Path:
    """Where a session's detections are, or will be.

    Raises:
        SessionError: session.yaml is missing or malformed.
    """
    document, keys = _read_document(Path(path))
    return document.source.path.parent / (keys.detections or DETECTIONS)


def read_rig(path: str | Path) -> RigDescription:
    """Read a rig.

    Args:
        path: the rig's folder, or the YAML file in it.

    Raises:
        SessionError: rig.yaml is missing or malformed, with line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    from urdfcal.session.schema import Document, RigFile

    document = Document.read(_yaml_file(Path(path), _RIG))
    keys = document.validate(RigFile)
    stand = None if keys.stand is None else Stand(keys.stand.position, keys.stand.look_at)  # type: ignore[arg-type]
    setup = _read_setup(document, keys)
    riding = {mount.camera for mount in setup["mounts"]}
    if stand is None and not set(setup["rig"].names) <= riding:
        raise SessionError(
            "the key 'stand' is missing",
            where=document.place(),
            remedy="It says where the first camera stands that rides on no link.",
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
    table = tables.read_points(Path(path), session.poses, None, session.noise.point)
    return _points(table), tuple(Led(name) for name in table.names["led"])


def _read_document(path: Path) -> tuple[Document, SessionFile]:
    from urdfcal.session.schema import Document, SessionFile

    document = Document.read(_yaml_file(path, _SESSION))
    return document, document.validate(SessionFile)


def _detections_file(document: Document, keys: SessionFile) -> Path | None:
    """The table of detections: as named, or, of a session with images and nothing named, as detected in them."""
    if keys.detections is not None:
        return _file(document, "detections")
    default = document.source.path.parent / DETECTIONS
    images = keys.points is None and keys.cameras is not None and _has_images(document)
    return default if images and default.is_file() else None


def _has_images(document: Document) -> bool:
    return (document.source.path.parent / IMAGES).is_dir()


def _yaml_file(path: Path, name: str) -> Path:
    """The YAML file meant by ``path``, a folder or the file itself."""
    if not path.is_dir():
        if not path.exists():
            raise SessionError("there is no such folder", where=str(path), remedy=f"Name a folder with a {name}.")
        return path
    if (path / name).is_file():
        return path / name
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
    from urdfcal.vision.formats import read_kalibr

    folder = document.source.path.parent
    urdf = Urdf.read(find_urdf(keys.robot.urdf, folder))
    chain = _read_mechanism(document, keys, urdf)
    hashes = {document.source.path.name: document.source.sha256, keys.robot.urdf: Source(folder, urdf.data).sha256}
    rig = None
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
    for joint in keys.tolerances.joints:
        if joint.removesuffix(MOUNT) not in chain.names:
            raise SessionError(
                f"there is no joint {joint!r} between {chain.base_link!r} and {chain.tip_link!r}",
                where=document.place("tolerances", joint),
                remedy=suggest(joint, chain.names, "joints"),
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


def _detections(table: tables.SightingTable) -> Detections:
    return Detections(**table.index, uv=table.values, sigma=table.sigma)


def _points(table: tables.SightingTable) -> Points:
    return Points(**table.index, xyz=table.values, sigma=table.sigma)
