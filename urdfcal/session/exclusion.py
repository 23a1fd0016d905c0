"""What of a session does not count: poses, cameras and LEDs that its user leaves out."""

from __future__ import annotations

import json
import re
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.names import check_known
from urdfcal.session.knowledge import Excluded
from urdfcal.session.model import MIN_POSES
from urdfcal.session.moves import BASE_LINK
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from urdfcal.arrays import Ints
    from urdfcal.session.measurements import Measurements
    from urdfcal.session.model import Session

# What YAML reads as the text it is, in a list.
_PLAIN = re.compile(r"\w[\w./-]*")


def summary(named: Mapping[str, Sequence[str]]) -> str:
    """Say in a few words what is excluded; empty if nothing is.

    Args:
        named: the names by key, as :attr:`Excluded.named` has them.
    """
    poses = len(named.get("poses", ()))
    parts = [f"{poses} pose{'s' * (poses != 1)}"] if poses else []
    for key, kind in (("cameras", "camera"), ("leds", "LED")):
        parts += [f"{kind} {name!r}" for name in named.get(key, ())]
    return f"{', '.join(parts)} excluded" if parts else ""


def labels(said: str, known: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the labels that a label, or a range of them such as ``26-31``, stands for.

    Args:
        said: the label, or the first and the last one in the order of the session, joined by a hyphen.
        known: all labels, in order.
        where: it is said.

    Raises:
        SessionError: there is no such label, or the last one comes before the first.
    """
    if said in known:
        return (said,)
    for hyphen in re.finditer("-", said):
        ends = said[: hyphen.start()].strip(), said[hyphen.end() :].strip()
        if all(end in known for end in ends):
            first, last = (known.index(end) for end in ends)
            if last < first:
                remedy = f"Write {ends[1]}-{ends[0]}."
                raise SessionError(f"pose {ends[1]!r} comes before {ends[0]!r}", where=where, remedy=remedy)
            return tuple(known[first : last + 1])
    end = next((end.strip() for end in said.split("-") if end.strip() not in known), said)
    check_known(end if said.count("-") == 1 else said, known, "poses", where)
    return (said,)


def in_words(key: str, of: str, poses: Sequence[str]) -> str:
    """Write what a key of session.yaml says of consecutive poses, as in ``exclude: {poses: [26-31]}``."""
    ends = [poses[0]] if len(poses) == 1 else [poses[0], poses[-1]]
    text = "-".join(ends)
    name = of if _PLAIN.fullmatch(of) else json.dumps(of)
    return f"{key}: {{{name}: [{text if all(_PLAIN.fullmatch(end) for end in ends) else json.dumps(text)}]}}"


def leave_out(session: Session, excluded: Excluded) -> Session:
    """Return a session without what is named, and without what is of no use then.

    A pose without measurements goes; so does a camera or an LED, unless a measured distance ends at the LED, or other
    cameras' places are counted from the camera.

    Args:
        session: all that was measured.
        excluded: what is to be left out.

    Raises:
        SessionError: too little is left.
    """
    tables = [table.rows(kept) for table in session.measurements if (kept := excluded.kept(session, table)).any()]
    if not tables:
        raise SessionError("it leaves nothing that was measured", where="exclude")
    gone = {
        key: ({i for i, name in enumerate(names) if name in left_out} | _measured(session.measurements, key))
        - _measured(tables, key)
        for key, names, left_out in (
            ("pose", session.poses, excluded.poses),
            ("camera", session.rig.names, excluded.cameras),
            ("led", session.led_names, excluded.leds),
        )
    }
    at_a_distance = {name for distance in session.led_distances for name in distance.leds}
    gone["led"] -= {i for i, name in enumerate(session.led_names) if name in at_a_distance}
    if any(T is not None and c not in gone["camera"] for c, T in list(enumerate(session.rig.T_cam_world))[1:]):
        gone["camera"].discard(0)
    gone["led"] -= set(range(len(session.leds), len(session.led_names)))  # a target stays whole
    poses, cameras, leds = (
        np.array([i for i in range(len(names)) if i not in gone[key]], dtype=np.intp)
        for key, names in (("pose", session.poses), ("camera", session.rig.names), ("led", session.led_names))
    )
    if len(poses) < MIN_POSES:
        raise SessionError(f"it leaves {len(poses)} poses, which are too few", where="exclude")
    rest = replace(session, measurements=tuple(tables)).at(poses)
    return _of(rest, cameras, leds, Excluded(excluded.poses, excluded.cameras, excluded.leds, session))


def restored(session: Session) -> Session:
    """Return a session with what was left out of it, if nothing else has happened to its poses and measurements.

    Settings such as noise and tolerances are the session's own. Of one that was changed otherwise only what is left
    is known: nothing is left out of it any more.
    """
    excluded = session.excluded
    if excluded.whole is None:
        return session
    again = leave_out(excluded.whole, excluded)
    known = ("noise", "tolerances", "estimate", "joint_models", "led_distances", "place_distances", "scale_sigma")
    settings = (*known, "payload", "gravity", "gear_ratio", "folder", "sha256", "warnings")
    if not same(session, again, {*settings, "excluded"}):
        return replace(session, excluded=Excluded())
    own = {name: getattr(session, name) for name in settings if not same(getattr(session, name), getattr(again, name))}
    return replace(excluded.whole, **own, excluded=Excluded(excluded.poses, excluded.cameras, excluded.leds))


def _measured(tables: Iterable[Measurements], key: str) -> set[int]:
    """The indices of what tables with a key have measured."""
    return {i for table in tables if key in table.index for i in np.unique(table.index[key]).tolist()}


def _of(session: Session, cameras: Ints, leds: Ints, excluded: Excluded) -> Session:
    """The session of some cameras and LEDs, which are all that have measurements, and of all targets."""
    rig, motion = session.rig.at(cameras), session.motion
    if isinstance(motion, Trajectory):
        frames = tuple(motion.frames[c] for c in cameras)
        motion = replace(motion, frames=frames, camera=np.searchsorted(cameras, motion.camera))
    tables = []
    for table in session.measurements:
        renumbered: dict[str, Any] = {
            key: np.searchsorted(kept, table.index[key])
            for key, kept in (("camera", cameras), ("led", leds))
            if key in table.index
        }
        tables.append(replace(table, **renumbered))
    estimate, things = session.estimate, {BASE_LINK, *rig.names, *(session.led_names[i] for i in leds)}
    return replace(
        session,
        rig=rig,
        moved={what: labels for what, labels in session.moved.items() if what in things},
        mounts=tuple(mount for mount in session.mounts if mount.camera in rig.names),
        leds=tuple(session.leds[i] for i in leds if i < len(session.leds)),
        estimate=replace(
            estimate,
            intrinsics=_only(estimate.intrinsics, rig.names),
            extrinsics=_only(estimate.extrinsics, rig.names),
        ),
        motion=motion,
        measurements=tuple(tables),
        excluded=excluded,
    )


def _only(said: Any, names: Collection[str]) -> Any:
    """What is said of all cameras, or of some of them by name."""
    return said if said is None or isinstance(said, str) else {name: of for name, of in said.items() if name in names}


def same(a: Any, b: Any, but: Collection[str] = ()) -> bool:
    """Return whether two values say the same, to the last bit, but for some fields."""
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if is_dataclass(a):
        return all(same(getattr(a, of.name), getattr(b, of.name)) for of in fields(a) if of.name not in but)
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(*pair) for pair in zip(a, b, strict=True))
    return bool(a == b)
