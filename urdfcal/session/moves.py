"""What moved while a session was measured, and is another thing from then on: the base, LEDs and cameras."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.names import check_known
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import Estimate, Led
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Ints
    from urdfcal.session.model import Positions, Session, Setup

BASE_LINK = "base"
"""What ``moved`` calls the robot's base, or what all standing cameras are on: one moved against the other."""


def resolve_moves(session: Session) -> Session:
    """Return a session in which what moved is something else after each move, ``led`` and ``led@31``.

    After a move nothing is known of where an LED or a camera sits, or the base stands; a camera keeps its lens.

    Args:
        session: whose ``moved`` says what moved, and before which poses.
    """
    for what, labels in session.moved.items():
        firsts, moves = sorted({session.poses.index(label) for label in labels}), moves_before(session, what)
        names = [f"{what}@{session.poses[k]}" for k in firsts]
        if session.targets and what not in (BASE_LINK, *session.rig.names):
            remedy = "Leave the poses from there on out (exclude), or those before."
            raise SessionError(f"{what!r} cannot have moved in a session with targets", where="moved", remedy=remedy)
        if what == BASE_LINK:
            session = replace(session, parts=("", *names), part=moves)
        elif what in session.led_names:
            session = _with_leds(session, session.led_names.index(what), names, moves)
        else:
            session = _with_cameras(session, session.rig.index(what), names, moves)
    return replace(session, moved={}) if session.moved else session


def moves_before(positions: Positions, *things: str) -> Ints:
    """Return how often (N,) any of some things had moved before each pose was measured."""
    firsts = {positions.poses.index(label) for what in things for label in positions.moved.get(what, ())}
    return np.searchsorted(sorted(firsts), np.arange(len(positions.poses)), side="right")


def unmoved(session: Session) -> Positions:
    """Return the positions of a session in which LEDs and cameras go by their first names, as their images do."""
    cameras = np.flatnonzero(np.array(session.rig.lens) == np.arange(len(session.rig.lens)))
    leds = tuple(led for led in session.leds if led.name.rpartition("@")[0] not in session.led_names)
    mounts = tuple(mount for mount in session.mounts if session.rig.index(mount.camera) in cameras)
    rig = session.rig.at(cameras)
    return replace(session.unmeasured(), rig=rig, leds=leds, mounts=mounts, estimate=Estimate())


def lasting_leds(setup: Setup) -> tuple[int, ...]:
    """Return the LEDs that stayed where they were: of one that moved no name is free to say something of it now."""
    names = [led.name for led in setup.leds]
    before = [name.rpartition("@")[0] for name in names]
    return tuple(k for k, name in enumerate(names) if name not in before and before[k] not in names)


def session_name(part: str) -> str:
    """Return the name of the session that a part is of, among several; none of a session alone."""
    return re.sub(rf"(^|/){BASE_LINK}@.*", "", part)


def poses_of_camera(session: Session, camera: int) -> Ints:
    """Return the poses (K,) in which a camera saw something."""
    tables = (table for table in session.measurements if "camera" in table.keys)
    seen = (table.pose[table.index["camera"] == camera] for table in tables)
    return np.unique(np.concatenate([*seen, np.zeros(0, np.intp)]))


def check_moves(session: Positions) -> None:
    """Refuse moves of what there is not, or before a pose that there is not, and of all there is at once.

    Raises:
        SessionError: naming the first of them.
    """
    known = (BASE_LINK, *session.led_names, *session.rig.names)
    for what, labels in session.moved.items():
        check_known(what, known, "base, LED or cameras", "moved")
        for label in labels:
            check_known(label, session.poses, "poses", f"moved.{what}")
            if label == session.poses[0]:
                remedy = "Name the first pose that was measured after it moved."
                raise SessionError(f"{label!r} is the first pose of all", where=f"moved.{what}", remedy=remedy)
    on_links = {mount.camera for mount in session.mounts}
    standing = [session.moved.get(name, ()) for name in session.rig.names if name not in on_links]
    for label in session.moved.get(BASE_LINK, ()):
        if standing and all(label in labels for labels in standing):
            remedy = "Leave one camera out: it is the world that the base and the others moved in."
            raise SessionError(f"the base and all cameras moved before {label!r}", where="moved", remedy=remedy)


def moves_at(session: Session, poses: Ints) -> dict[str, tuple[str, ...]]:
    """Return what moved in between some of the poses (K,), in ascending order, and before which of these."""
    moved = {}
    for what, labels in session.moved.items():
        after = np.searchsorted(poses, [session.poses.index(label) for label in labels])
        firsts = dict.fromkeys(session.poses[poses[k]] for k in sorted(after) if 0 < k < len(poses))
        if firsts:
            moved[what] = tuple(firsts)
    return moved


def _with_leds(session: Session, k: int, names: Sequence[str], moves: Ints) -> Session:
    led, count = session.leds[k], len(session.leds)
    more = tuple(Led(name, link=led.link) for name in names)
    return replace(session, leds=session.leds + more, measurements=_renumbered(session, "led", k, count, moves))


def _with_cameras(session: Session, c: int, names: Sequence[str], moves: Ints) -> Session:
    rig, motion, estimate, more = session.rig, session.motion, session.estimate, len(names)
    here = next((mount for mount in session.mounts if mount.camera == rig.names[c]), None)
    count = len(rig.cameras)
    if isinstance(motion, Trajectory):
        camera = np.where((motion.camera == c) & (moves > 0), count - 1 + moves, motion.camera)
        motion = replace(motion, frames=motion.frames + (motion.frames[c],) * more, camera=camera)
    return replace(
        session,
        rig=replace(
            rig,
            cameras=rig.cameras + tuple(replace(rig.cameras[c], name=name) for name in names),
            T_cam_world=rig.T_cam_world + (None,) * more,
            sigmas=rig.sigmas + (None,) * more,
            group=rig.group + (rig.group[c],) * more,
            lens=rig.lens + (rig.lens[c],) * more,
        ),
        mounts=session.mounts + tuple(CameraMount(name, here.link) for name in names if here is not None),
        estimate=replace(estimate, **by_camera(estimate, {name: name for name in rig.names})),
        motion=motion,
        measurements=_renumbered(session, "camera", c, count, moves),
    )


def by_camera(estimate: Estimate, names: dict[str, str]) -> dict[str, Any]:
    """Return what is said of intrinsics and extrinsics as mappings over cameras, which are given new names."""
    said: dict[str, Any] = {}
    for what in ("intrinsics", "extrinsics"):
        words = {new: estimate.of(what, name) for name, new in names.items()}
        said[what] = {new: word for new, word in words.items() if word is not None} or None
    return said


def _renumbered(session: Session, key: str, index: int, count: int, moves: Ints) -> tuple[Any, ...]:
    """The tables, with one thing's rows of after its first move renumbered from ``count`` on."""

    def changed() -> Iterable[Any]:
        for table in session.measurements:
            if key in table.keys:
                column, times = table.index[key], moves[table.pose]
                moved: dict[str, Any] = {key: np.where((column == index) & (times > 0), count - 1 + times, column)}
                yield replace(table, **moved)
            else:
                yield table

    return tuple(changed())
