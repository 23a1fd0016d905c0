"""Several sessions of one arm as one: each has its own base pose, cameras and LEDs, the arm is the same."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.names import listed
from urdfcal.robot.chain import read_mechanism
from urdfcal.session.exclusion import same
from urdfcal.session.knowledge import Estimate, Excluded, Noise
from urdfcal.session.model import Session
from urdfcal.session.moves import by_camera, resolve_moves
from urdfcal.session.trajectory import AT_REST, JointLog, Motion, Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.cameras.rig import CameraSigma
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.measurements import Measurements

# Between the logs of two sessions, in one time: far more than what a curve joins. [s]
_APART = 10.0


def combine(sessions: Mapping[str, Session]) -> Session:
    """Return one session of all poses of several: one arm, of which everything else may have changed in between.

    Names of poses, LEDs and cameras are prefixed by that of their session, as in ``monday/led``. Each session has a
    base pose of its own. Cameras of one calibration (names, lenses and places the same to the last digit) are the same
    cameras: they keep their names, and what that calibration is wrong by, they are wrong by in all sessions. Where they
    stand on their own, or on a link, only their lenses are the same.

    Args:
        sessions: by name, in order.

    Raises:
        SessionError: they are not of one arm, are the same measurements, or contradict each other.
    """
    if len(sessions) == 1:
        return next(iter(sessions.values()))
    parts = {name: resolve_moves(session) for name, session in sessions.items()}
    every, first = list(parts.values()), next(iter(parts.values()))
    for a, b in _alike(parts):
        what = f"{b!r} is {a!r} once more"
        raise SessionError(what, where=listed(parts), remedy="Name each session once: measurements count once.")
    cameras = _JoinedCameras.of(parts)
    excluded: dict[str, Any] = {
        what: tuple(f"{name}/{left_out}" for name, of in parts.items() for left_out in getattr(of.excluded, what))
        for what in ("poses", "cameras", "leds")
    }
    carried = tuple(of.payload for of in every for _ in of.parts)
    carried = () if all(same(of, first.payload) for of in carried) else carried
    own: dict[str, Any] = {
        "chain": _arm(parts),
        "leds": tuple(replace(led, name=f"{name}/{led.name}") for name, of in parts.items() for led in of.leds),
        "targets": tuple(replace(of, name=f"{name}/{of.name}") for name, part in parts.items() for of in part.targets),
        "place_distances": tuple(
            replace(known, places=(f"{name}/{known.places[0]}", f"{name}/{known.places[1]}"))
            for name, of in parts.items()
            for known in of.place_distances
        ),
        "led_distances": tuple(
            replace(distance, leds=(f"{name}/{distance.leds[0]}", f"{name}/{distance.leds[1]}"))
            for name, of in parts.items()
            for distance in of.led_distances
        ),
        "rig": cameras.rig,
        "mounts": tuple(
            replace(mount, camera=names[of.rig.index(mount.camera)])
            for of, names in zip(every, cameras.names, strict=True)
            for mount in of.mounts
        ),
        "urdf": first.urdf,
        "urdf_reference": first.urdf_reference,
        "payload": None if carried else first.payload,
        "payloads": carried,
        "noise": _noise(parts),
        "estimate": _estimate(parts, cameras),
        "about": _about(parts),
        "sha256": {f"{name}/{file}": sha256 for name, of in parts.items() for file, sha256 in of.sha256.items()},
        "folder": None,
        "parts": tuple(f"{name}/{part}" if part else name for name, of in parts.items() for part in of.parts),
        "poses": tuple(f"{name}/{label}" for name, of in parts.items() for label in of.poses),
        "q": np.concatenate([of.q for of in every]),
        "time": None,
        "torques": _torques(parts),
        "previous": np.concatenate([of.came_from for of in every]),
        "motion": _motion(parts, cameras.index),
        "part": _numbered([of.part for of in every], [len(of.parts) for of in every]),
        "warnings": tuple(f"{name}: {warning}" for name, of in parts.items() for warning in of.warnings),
        "measurements": _tables(parts, cameras.index),
        "excluded": Excluded(**excluded, whole=_whole(sessions)),
    }
    # What is not told apart is of the arm, or of the world, and must be the same.
    return Session(**own, **{of.name: _agreed(parts, of.name) for of in fields(Session) if of.name not in own})


def _whole(sessions: Mapping[str, Session]) -> Session | None:
    """Combine sessions with what was left out of them; None where nothing was, something moved, or two are one."""
    whole = {name: of.excluded.whole or of for name, of in sessions.items()}
    left_out = any(of.excluded.whole is not None for of in sessions.values())
    moved = any(of.moved for of in whole.values())
    return combine(whole) if left_out and not moved and not _alike(whole) else None


def _alike(sessions: Mapping[str, Session]) -> list[tuple[str, str]]:
    """List the sessions that are the same measurements."""
    return [
        (a, b)
        for (a, of_a), (b, of_b) in combinations(sessions.items(), 2)
        if np.array_equal(of_a.q, of_b.q) and same(of_a.measurements, of_b.measurements)
    ]


def _about(parts: Mapping[str, Session]) -> dict[str, str]:
    """What is said of all sessions alike, and of the others by their names."""
    common = dict(set.intersection(*(set(of.about.items()) for of in parts.values())))
    own = {f"{name}/{key}": text for name, of in parts.items() for key, text in of.about.items() if key not in common}
    return dict(sorted(common.items())) | own


def _torques(parts: Mapping[str, Session]) -> Floats | None:
    """What was measured of the joints' torques, in all sessions or in none."""
    measured = {name: of.torques for name, of in parts.items()}
    without = [name for name, torques in measured.items() if torques is None]
    if without and len(without) < len(parts):
        remedy = "Leave the key out of the others, or measure them in all: gravity's and measured torques do not mix."
        raise SessionError("there are no torques, as there are in the others", where=listed(without), remedy=remedy)
    return None if without else np.concatenate([torques for torques in measured.values() if torques is not None])


def _numbered(indices: Sequence[Ints], counts: Sequence[int]) -> Ints:
    """Indices of several lists of things, one after the other, as indices of all of them."""
    starts = np.cumsum([0, *counts])
    return np.concatenate([index + start for index, start in zip(indices, starts[:-1], strict=True)])


def _estimate(parts: Mapping[str, Session], cameras: _JoinedCameras) -> Estimate:
    """What is to be estimated: of the arm as all say that say something, of cameras as each says of its own."""
    said: dict[str, Any] = {"intrinsics": {}, "extrinsics": {}}
    for of, names in zip(parts.values(), cameras.names, strict=True):
        for what, words in by_camera(of.estimate, dict(zip(of.rig.names, names, strict=True))).items():
            said[what] |= words or {}
    said = {what: words or None for what, words in said.items()}
    said |= {what: _said(parts, f"estimate.{what}") for what in ("geometry", "time_offset", "gravity")}
    return Estimate(**said)


def _arm(parts: Mapping[str, Session]) -> Mechanism:
    """The joints of all sessions, to every link that carries something in one of them."""
    (a, of_a), *others = parts.items()
    one = of_a.chain
    remedy = "Calibrate sessions of one arm together, read from the same URDF between the same links."
    for b, of_b in others:
        two, where = of_b.chain, f"{b!r} and {a!r}"
        for what in ("base_link", "tip_link"):
            if getattr(one, what) != getattr(two, what):
                ends = f"{getattr(two, what)!r} and {getattr(one, what)!r}"
                raise SessionError(
                    f"the robots have different {what.replace('_', ' ')}s, {ends}", where=where, remedy=remedy
                )
        if one.names != two.names:
            joints = f"{listed(two.names)} and {listed(one.names)}"
            raise SessionError(f"the robots have different joints: {joints}", where=where, remedy=remedy)
        for k, name in enumerate(one.names):
            if not same(one.joints[k], two.joints[k]) or not np.array_equal(one.placements[k], two.placements[k]):
                raise SessionError(f"joint {name!r} differs: these are two robots", where=where, remedy=remedy)
    links = dict.fromkeys(tip.link for of in parts.values() for tip in of.chain.tips)
    if len(links) == len(one.tips):
        return one
    if of_a.urdf is None:
        raise SessionError(
            "LEDs and cameras are on different links, and there is no URDF", where=listed(parts), remedy=remedy
        )
    chain = read_mechanism(of_a.urdf, list(links), one.base_link)
    if chain.names != one.names:
        what = f"what is on {listed(links)} needs joints that were not read: {listed(chain.names)}"
        raise SessionError(what, where=listed(parts), remedy=remedy)
    return chain


@dataclass(frozen=True, eq=False)
class _JoinedCameras:
    """The cameras of all sessions.

    Attributes:
        rig: all of them.
        index: for each session (C,) which of these its own are.
        names: for each session their names in there.
    """

    rig: Rig
    index: tuple[Ints, ...]

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(self.rig.names[c] for c in index) for index in self.index)

    @classmethod
    def of(cls, parts: Mapping[str, Session]) -> _JoinedCameras:
        cameras: list[Camera] = []
        places: list[Any] = []
        sigmas: list[CameraSigma | None] = []
        group: list[int] = []
        lens: list[int] = []
        indices: list[Ints] = []
        rigs = {name: of.rig for name, of in parts.items()}
        for k, (name, of) in enumerate(parts.items()):
            frames, rig = of.attachments, of.rig
            mine: list[int] = []
            twin = next((j for j, before in enumerate(list(rigs.values())[:k]) if same(before, rig)), None)
            shared_by_all = all(same(rig, other) for other in rigs.values())
            known = sum(len(sigma.values) for sigma in sigmas if sigma is not None)
            for c, camera in enumerate(rig.cameras):
                placed = frames.camera[c] == 0 and (c in frames.worlds or frames.T_cam_reference[c] is not None)
                if twin is not None and placed:
                    mine.append(int(indices[twin][c]))
                    continue
                mine.append(len(cameras))
                plain = shared_by_all and placed
                cameras.append(camera if plain else replace(camera, name=f"{name}/{camera.name}"))
                places.append(frames.T_cam_reference[c])
                group.append(mine[int(frames.reference[c])])
                lens.append(mine[rig.lens[c]] if twin is None else int(lens[indices[twin][c]]))
                sigma = rig.sigmas[c] if twin is None else None
                if sigma is not None and sigma.correlations is not None:
                    rows = sigma.correlations
                    sigma = replace(sigma, correlations=np.hstack([np.zeros((len(rows), known)), rows]))
                sigmas.append(sigma)
            indices.append(np.array(mine, dtype=np.intp))
        return cls(Rig(tuple(cameras), tuple(places), tuple(sigmas), None, tuple(group), tuple(lens)), tuple(indices))


def _tables(parts: Mapping[str, Session], cameras: Sequence[Ints]) -> tuple[Measurements, ...]:
    """All measurements of each kind in one table, things numbered anew."""
    found: dict[type[Measurements], list[Measurements]] = {}
    every = list(parts.values())
    poses, targets = (np.cumsum([0, *map(len, of)]) for of in ([s.poses for s in every], [s.targets for s in every]))
    # The tables count the LEDs of all sessions first, then the points of all targets.
    own_leds = [np.arange(len(of.led_names)) < len(of.leds) for of in every]
    order = np.argsort(~np.concatenate(own_leds), kind="stable")
    leds = np.split(np.argsort(order), np.cumsum([len(of) for of in own_leds])[:-1])
    named: dict[tuple[type[Measurements], str], list[str]] = {}
    for k, (name, of) in enumerate(parts.items()):
        for table in of.measurements:
            columns: dict[str, Any] = {"pose": table.pose + poses[k]}
            for key in table.keys[1:]:
                column = table.index[key]
                if key == "led":
                    columns[key] = leds[k][column]
                elif key == "target":
                    columns[key] = column + targets[k]
                elif key == "camera":
                    columns[key] = cameras[k][column]
                else:
                    names = named.setdefault((type(table), key), [])
                    columns[key] = column + len(names)
                    names += [f"{name}/{thing}" for thing in table.names[key]]
            found.setdefault(type(table), []).append(replace(table, **columns))
    return tuple(
        replace(
            tables[0],
            **{field: np.concatenate([getattr(table, field) for table in tables]) for field in tables[0].arrays},
            names={key: tuple(names) for (of_kind, key), names in named.items() if of_kind is kind},
        )
        for kind, tables in found.items()
    )


def _motion(parts: Mapping[str, Session], cameras: Sequence[Ints]) -> Motion:
    """The motions one after the other, in one time."""
    motions = [of.motion for of in parts.values()]
    moving = [motion for motion in motions if isinstance(motion, Trajectory)]
    if not moving:
        return AT_REST
    if len(moving) < len(motions):
        remedy = "Calibrate each alone; `urdfcal compare` tells whether the two agree."
        raise SessionError("the arm moved in some and rested in others", where=listed(parts), remedy=remedy)
    times, values, shifts = [], [], []
    end = 0.0
    for motion in moving:
        shifts.append(end - motion.log.time[0])
        times.append(motion.log.time + shifts[-1])
        values.append(motion.log.values)
        end = times[-1][-1] + _APART
    frames: dict[int, tuple[str, ...]] = {}
    for motion, index in zip(moving, cameras, strict=True):
        for c, labels in zip(index.tolist(), motion.frames, strict=True):
            frames[c] = frames.get(c, ()) + labels
    rows, so_far = [], dict.fromkeys(frames, 0)
    for motion, index in zip(moving, cameras, strict=True):
        starts = np.array([so_far[c] for c in index.tolist()])
        rows.append(motion.row + starts[motion.camera])
        for c, labels in zip(index.tolist(), motion.frames, strict=True):
            so_far[c] += len(labels)
    return Trajectory(
        log=JointLog(np.concatenate(times), np.concatenate(values)),
        frames=tuple(frames[c] for c in sorted(frames)),
        camera=np.concatenate([index[motion.camera] for motion, index in zip(moving, cameras, strict=True)]),
        row=np.concatenate(rows),
        time=np.concatenate([motion.time + shift for motion, shift in zip(moving, shifts, strict=True)]),
    )


def _noise(parts: Mapping[str, Session]) -> Noise:
    """What all say of noise; each table has its own standard deviations, joint readings one for all."""
    every = [of.noise for of in parts.values()]
    said: dict[str, Any] = {field.name: getattr(every[0], field.name) for field in fields(Noise)}
    kinds = {type(table) for of in parts.values() for table in of.measurements}
    for name in {kind.noise for kind in kinds}:
        holders = [n for n, of in parts.items() if any(table.noise == name for table in of.measurements)]
        words = {n: parts[n].noise.said(name) for n in holders}
        if len({word is None for word in words.values()}) > 1:
            silent = next(n for n, word in words.items() if word is None)
            remedy = "Say it in all of them, or in none: then it is estimated."
            raise SessionError(
                f"noise: {name} is said in others, not in {silent!r}", where=listed(parts), remedy=remedy
            )
        value = next(iter(words.values()))
        if name in said:
            said[name] = value
        elif value is not None:
            said["other"] = {**said["other"], name: value}
    return Noise(**{**said, "joint": _agreed(parts, "noise.joint")})


def _said(parts: Mapping[str, Session], what: str) -> Any:
    """What some sessions say, and none otherwise; None where nothing is said."""
    words = {name: _field(of, what) for name, of in parts.items()}
    return _agreed({name: parts[name] for name, word in words.items() if word is not None} or parts, what)


def _agreed(parts: Mapping[str, Session], what: str) -> Any:
    """What all sessions say, at a path of fields."""
    (a, said), *others = ((name, _field(of, what)) for name, of in parts.items())
    for b, other in others:
        if not same(said, other):
            key = {"scale_sigma": "scale: sigma"}.get(what, what.replace(".", ": "))
            remedy = "Say the same in all session.yaml: it is one arm, with one unit of length."
            raise SessionError(f"{key} is {_shown(other)}, in {a!r} {_shown(said)}", where=b, remedy=remedy)
    return said


def _field(session: Session, path: str) -> Any:
    value: Any = session
    for name in path.split("."):
        value = getattr(value, name)
    return value


def _shown(value: Any) -> str:
    return "not said" if value is None else f"{dict(value)}" if hasattr(value, "items") else f"{value}"
