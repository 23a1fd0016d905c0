"""Sessions and rigs as folders: a YAML file, the cameras, and the tables."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import MEASUREMENTS, Detections, Points
from urdfcal.files import Source
from urdfcal.io.checks.content import unseen
from urdfcal.io.checks.plausibility import Inputs, check, check_positions
from urdfcal.io.tables import read_by_pose, read_frames, read_joints, read_log, read_measurements
from urdfcal.names import check_known, suggest
from urdfcal.robot.chain import read_mechanism
from urdfcal.robot.urdf.urdf import Urdf, find_urdf
from urdfcal.session.attachments import WORLD
from urdfcal.session.combine import combine
from urdfcal.session.exclusion import labels, leave_out
from urdfcal.session.knowledge import Excluded, Led
from urdfcal.session.model import Positions, Session
from urdfcal.session.rig_description import RigDescription, Stand

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.io.csv_table import Table
    from urdfcal.io.schema import SessionFile, SetupFile
    from urdfcal.io.tables import JointTable
    from urdfcal.io.yaml_document import Document
    from urdfcal.robot.mechanism import Mechanism

# What `urdfcal detect` reads and writes.
IMAGES, DETECTIONS = "images", "detections.csv"
_SESSION, _RIG = "session.yaml", "rig.yaml"


def read_session(
    path: str | Path,
    look: Callable[[], object] | None = None,
    *,
    exclude_poses: Sequence[str] = (),
    ignore_limits: bool = False,
) -> Session:
    """Read a session and check that it can be trusted.

    Args:
        path: the session's folder, or the YAML file in it.
        look: called where a session has images but nobody has looked for LEDs in them yet; it writes the detections.
        exclude_poses: labels of poses that do not count, or ranges such as ``26-31``, besides those that the session
            excludes.
        ignore_limits: readings beyond a joint's limits are a warning, however far.

    Returns:
        The session; its ``warnings`` name what looks odd but may be right.

    Raises:
        SessionError: a file is missing, malformed or implausible, with file, line and column.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    document, keys = _read_document(Path(path))
    folder = document.source.path.parent
    files = {kind: _file(document, kind.kind) for kind in keys.tables}
    images = (folder / IMAGES).is_dir()
    # Of a session with images and nothing named, what was detected in them.
    default = folder / DETECTIONS
    if not files and images and look is not None and not (keys.cameras and default.is_file()):
        look()
    if not files and images and keys.cameras and default.is_file():
        files = {Detections: default}
    inputs = _read_positions(document, keys)
    if not files:
        raise SessionError(
            f"none of {', '.join(kind.kind for kind in MEASUREMENTS)} are named: there is nothing to calibrate from",
            where=document.place(),
            remedy="Run `urdfcal detect` on its images first." if images else "",
        )
    positions, hashes, tables = inputs.positions, dict(inputs.positions.sha256), {}
    known = {"pose": positions.poses, "camera": positions.rig.names, "led": positions.led_names}
    known["target"] = tuple(target.name for target in positions.targets)
    excluded = _excluded(document, positions, exclude_poses)
    for kind in (kind for kind in MEASUREMENTS if kind in files):
        tables[kind] = read_measurements(files[kind], kind, known, positions.noise.spreads(kind), inputs.frames)
        hashes[keys.tables.get(kind, DETECTIONS)] = tables[kind].table.source.sha256
    counting = {
        kind: table.only(kept)
        for kind, table in tables.items()
        if (kept := excluded.kept(positions, table.measurements)).any()
    }
    inputs = replace(inputs, tables=tables, excluded=excluded, ignore_limits=ignore_limits)
    right, odd = check(replace(inputs, tables=counting))
    warnings = (*positions.warnings, *odd, *unseen(inputs))
    for kind, table in right.items():
        wrong = np.setdiff1d(counting[kind].rows, table.rows)
        tables[kind] = tables[kind].only(~np.isin(tables[kind].rows, wrong))
    measurements = tuple(table.measurements for table in tables.values())
    with document.placing():
        session = positions.measured(measurements, sha256=hashes, warnings=warnings)
        session = _with_torques(_with_previous(session, document, keys), document, keys, inputs.joints)
        return leave_out(session, excluded) if excluded else session


def read_sessions(
    paths: Sequence[str | Path],
    look: Callable[[Path], object] | None = None,
    *,
    exclude_poses: Sequence[str] = (),
    ignore_limits: bool = False,
) -> Session:
    """Read a session, or several of one arm as one (:func:`~urdfcal.session.combine.combine`).

    Several go by the names of their folders, with as many of the folders above as tell them apart.

    Args:
        paths: the sessions' folders, or the YAML files in them.
        look: called with the path where a session has images but nobody has looked for LEDs in them yet; it writes the
            detections.
        exclude_poses: labels of poses that do not count, or ranges; of several sessions ``monday/26-31``.
        ignore_limits: readings beyond a joint's limits are a warning, however far.

    Raises:
        SessionError: as for :func:`read_session`; they are not of one arm, or contradict each other.
        RobotError: the URDF is not one, or has no such chain.
        CameraError: the camera file is not one.
    """
    folders = [path if path.is_dir() else path.parent for path in (Path(path).resolve() for path in paths)]
    names = [folder.name for folder in folders]
    for depth in range(1, max(len(folder.parts) for folder in folders)):
        names = ["/".join(folder.parts[-depth:]) for folder in folders]
        if len(set(names)) == len(names):
            break
    else:
        twice = next(path for path, name in zip(paths, names, strict=True) if names.count(name) > 1)
        raise SessionError("this session is named twice", where=str(twice), remedy="Measurements count once.")
    excluded = _by_session(exclude_poses, dict(zip(names, paths, strict=True)))
    sessions = {}
    for path, name in zip(map(Path, paths), names, strict=True):
        each = None if look is None else partial(look, path)
        sessions[name] = read_session(path, each, exclude_poses=excluded[name], ignore_limits=ignore_limits)
    return combine(sessions)


def _by_session(excluded: Sequence[str], paths: Mapping[str, str | Path]) -> dict[str, list[str]]:
    """Tell of which session, by name, each label or range of poses is: by its name before it, or as no other has it."""
    found: dict[str, list[str]] = {name: [] for name in paths}
    for label in excluded:
        whose = [name for name in paths if label.startswith(f"{name}/")] if len(paths) > 1 else list(paths)
        if not whose:
            whose = [name for name, path in paths.items() if _has(read_positions(path).poses, label)]
            if len(whose) != 1:
                which = f"is in each of {', '.join(whose)}" if whose else "is in none of the sessions"
                remedy = f"Write {' or '.join(f'{name}/{label}' for name in whose or [next(iter(paths))])}."
                raise SessionError(f"{label!r} {which}", where="--exclude-poses", remedy=remedy)
        found[whose[0]].append(label if len(paths) == 1 else label.removeprefix(f"{whose[0]}/"))
    return found


def _has(poses: Sequence[str], label: str) -> bool:
    """Return whether a session has a pose, or both ends of a range."""
    try:
        return bool(labels(label, poses, "--exclude-poses"))
    except SessionError:
        return False


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
    if keys.cameras is None:
        raise SessionError("no cameras are named", where=document.place(), remedy="Images need a camera file.")
    inputs = _read_positions(document, keys)
    positions = inputs.positions
    # Where LEDs are in images does not depend on limits, and calibration may be told to ignore them.
    inputs = replace(inputs, excluded=_excluded(document, positions, ()), ignore_limits=True)
    return replace(positions, warnings=positions.warnings + check_positions(inputs))


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

    document = _read_yaml(Path(path), _RIG)
    keys = document.validate(RigFile)
    stand = None if keys.stand is None else Stand(keys.stand.position, keys.stand.look_at)  # type: ignore[arg-type]
    setup = _read_setup(document, keys)
    if stand is None and len(setup["rig"].names) > len(setup["mounts"]):
        remedy = "It says where the first camera stands that is on no link."
        raise SessionError("the key 'stand' is missing", where=document.place(), remedy=remedy)
    with document.placing():
        places = {name: np.array(place) for name, place in keys.places.items()}
        return RigDescription(**setup, stand=stand, places=places, errors=keys.errors)


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
    table = read_measurements(Path(path), Points, {"pose": session.poses}, session.noise.of(Points))
    return table.measurements, tuple(Led(name) for name in table.names["led"])  # type: ignore[return-value]


def _with_previous(session: Session, document: Document, keys: SessionFile) -> Session:
    """Return a session with where the arm came from to some of the poses, as far as a file says it."""
    if keys.previous is None:
        return session
    table, rows, readings = _read_by_pose(session, document, "previous")
    previous = np.array(session.came_from)
    previous[rows] = session.chain.joint_values(readings)
    return replace(session, previous=previous, sha256={**session.sha256, keys.previous: table.source.sha256})


def _with_torques(session: Session, document: Document, keys: SessionFile, joints: JointTable) -> Session:
    """Return a session with torques, if a file has them; poses without are none of it, only where the arm came from.

    Raises:
        SessionError: something was measured in one of them.
    """
    if keys.torques is None:
        return session
    table, rows, torques = _read_by_pose(session, document, "torques")
    measured = np.unique(np.concatenate([of.pose for of in session.measurements]))
    for pose in np.setdiff1d(measured, rows)[:1].tolist():
        what = f"pose {session.poses[pose]!r} has no torques, and something was measured in it"
        remedy = f"Add its row to {table.path}, or take out what was measured in it."
        raise joints.table.wrong(what, pose, "pose", remedy)
    order, hashes = np.argsort(rows), {**session.sha256, keys.torques: table.source.sha256}
    return replace(session.at(rows[order]), torques=session.chain.torques(torques[order]), sha256=hashes)


def _read_by_pose(session: Session, document: Document, key: str) -> tuple[Table, Ints, Floats]:
    robot_joints = () if session.urdf is None else session.urdf.joints
    return read_by_pose(_file(document, key), session.chain, robot_joints, session.poses)


def _excluded(document: Document, positions: Positions, poses: Sequence[str]) -> Excluded:
    """What session.yaml excludes, and some more poses."""

    def said(key: str) -> list[tuple[str, str]]:
        return [(text, document.place("exclude", key, i)) for i, text in enumerate(document.texts("exclude", key))]

    by_label = [labels(text, positions.poses, where) for text, where in said("poses")]
    by_label += [labels(text, positions.poses, "--exclude-poses") for text in poses]
    for key, known, kind in (("cameras", positions.rig.names, "cameras"), ("leds", positions.led_names, "LEDs")):
        for name, where in said(key):
            check_known(name, known, kind, where)
    by_name = [dict.fromkeys(name for name, _ in said(key)) for key in ("cameras", "leds")]
    by_pose = dict.fromkeys(label for some in by_label for label in some)
    return Excluded(tuple(by_pose), tuple(by_name[0]), tuple(by_name[1]))


def _read_document(path: Path) -> tuple[Document, SessionFile]:
    from urdfcal.io.schema import SessionFile

    document = _read_yaml(path, _SESSION)
    return document, document.validate(SessionFile)


def _read_positions(document: Document, keys: SessionFile) -> Inputs:
    """Where the arm was: read from joints.csv, and of an arm that moved from frames.csv as well."""
    setup, path = _read_setup(document, keys), _file(document, "joints")
    chain, robot_joints, cameras = setup["chain"], setup["urdf"].joints, setup["rig"].names
    poses: dict[str, Any]
    if keys.frames is None:
        joints, frames = read_joints(path, chain, robot_joints), None
        poses = {"poses": joints.poses, "q": chain.joint_values(joints.readings), "time": joints.time}
    else:
        joints, log = read_log(path, chain, robot_joints)
        frames = read_frames(_file(document, "frames"), cameras, joints, log)
        motion = frames.trajectory
        labels = tuple(f"{cameras[c]}/{motion.label(k)}" for k, c in enumerate(motion.camera.tolist()))
        poses = {"poses": labels, "q": motion.values(np.zeros(len(cameras))), "time": motion.time, "motion": motion}
        setup["sha256"][keys.frames] = frames.table.source.sha256
    setup["sha256"][keys.joints] = joints.table.source.sha256
    with document.placing():
        warnings = joints.warnings + (frames.warnings if frames else ())
        moved = {what: tuple(document.texts("moved", what)) for what in keys.moved}
        positions = Positions(**setup, **poses, moved=moved, warnings=warnings)
    return Inputs(document, positions, joints, frames)


def _read_yaml(path: Path, name: str) -> Document:
    """Read the YAML file meant by ``path``, a folder or the file itself."""
    from urdfcal.io.yaml_document import Document

    remedy = f"Name a folder with a {name}."
    try:
        if not path.exists():
            raise SessionError("there is no such folder", where=str(path), remedy=remedy)
        file = path / name if path.is_dir() else path
        if not path.is_dir() or file.is_file():
            return Document.read(file)
    except OSError as error:
        raise SessionError(f"cannot be read: {error.strerror}", where=str(path)) from error
    if name == _SESSION and (path / _RIG).is_file():
        remedy = "It is a rig: `urdfcal simulate` makes a session of it."
    elif name == _RIG and (path / _SESSION).is_file():
        remedy = "It is a session, not a rig."
    raise SessionError(f"there is no {name} in this folder", where=str(path), remedy=remedy)


def _read_mechanism(document: Document, keys: SetupFile, urdf: Urdf) -> Mechanism:
    """The joints to the tip link and to every other link that carries an LED, a target or a camera."""
    links = {keys.robot.tip_link: ("robot", "tip_link")}
    for key, named in (("leds", keys.leds), ("targets", keys.targets)):
        for name, keys_of in named.items():
            links.setdefault(keys_of.link or WORLD, (key, name))
    for mount in keys.cameras.mounts if keys.cameras is not None else ():
        links.setdefault(mount.link, ("cameras", mount.camera))
    base = keys.robot.base_link or urdf.root
    wanted = [link for link in links if link not in (WORLD, base) or link == keys.robot.tip_link]
    for link in wanted[1:]:
        check_known(link, tuple(urdf.links), "links", document.place(*links[link]))
    return read_mechanism(urdf, wanted, keys.robot.base_link)


def _file(document: Document, key: str, name: str | None = None) -> Path:
    """The file that ``key`` names, relative to the YAML file."""
    name, folder = name or document.data[key], document.source.path.parent
    path: Path = folder / name
    if os.path.isfile(path):  # noqa: PTH113  # pathlib's raises at overlong names
        return path
    remedy = suggest(name, sorted(entry.name for entry in folder.iterdir() if entry.is_file()), "files here")
    raise SessionError(f"there is no file {name!r}", where=document.place(key), remedy=remedy)


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
    with document.placing():
        own = keys.setup()
    return {
        **own,
        "chain": chain,
        "urdf": urdf,
        "urdf_reference": keys.robot.urdf,
        "rig": rig,
        "sha256": hashes,
        "folder": folder,
    }
