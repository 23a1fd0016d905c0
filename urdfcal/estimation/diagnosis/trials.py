"""Wrong inputs by trial: change one thing about a session at a time, and see which change makes it fit (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, evenly, inverse
from urdfcal.errors import CalibrationError, UrdfcalError
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.diagnosis.family import family
from urdfcal.estimation.measurements import Detections, Poses
from urdfcal.estimation.model_spec import nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import sketch
from urdfcal.estimation.start import first_state
from urdfcal.robot.chain import Chain
from urdfcal.robot.tree_dh import rows_of
from urdfcal.rotations import quaternion_to_matrix
from urdfcal.session.model import MIN_POSES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.estimation.solver import Progress
    from urdfcal.session.measurements import Measurements
    from urdfcal.session.model import Session

# Poses that decide: a wrong sign misses by hundreds of pixels in all of them.
_POSES = 30
# A change explains the session if the nominal arm then misses by this many times less ...
_BETTER = 4.0
# ... and the best of all changes by so many times less than the next: several equally good ones explain nothing.
_CLEAR = 1.5
# What fits does so within ten steps; what does not may creep for a hundred.
_STEPS = 15
# Orientations count as what they move at this distance. [m]
_LEVER = 0.1
# Rows of one table may be shifted against the other's by so many poses.
_SHIFTS = (1, -1, 2, -2)


@dataclass(frozen=True, eq=False)
class Mending:
    """One change that may set a session right.

    Attributes:
        what: what is wrong if it does, as the subject of a sentence.
        changed: returns the session without the mistake; it may be one that no session can have.
    """

    what: str
    changed: Callable[[], Session]


@dataclass(frozen=True)
class Suspicion:
    """The change that makes a session fit.

    Attributes:
        what: what is wrong.
        before: median residual under the nominal arm as the session is; infinite where there is no start. [unit]
        after: the same with the change. [unit]
        unit: px or mm.
    """

    what: str
    before: float
    after: float
    unit: str

    def __str__(self) -> str:
        before = f"instead of {self.before:.3g} {self.unit}" if np.isfinite(self.before) else "instead of no fit at all"
        return f"{self.what}: with that mended the nominal arm is {self.after:.3g} {self.unit} off {before}"


def suspect(session: Session, progress: Progress | None = None) -> Suspicion | None:
    """Look for one change of a session that makes it fit; None where none does, or several do.

    Args:
        session: that does not fit.
        progress: called after every solver step.
    """
    poses = evenly(np.unique(np.concatenate([table.pose for table in session.measurements])), _POSES)
    if len(poses) < MIN_POSES:
        return None
    unit, factor = session.measurements[0].report
    before = _miss(session.at(poses), progress)
    trials = list(_trials(session))
    scores = []
    for trial in trials:
        try:
            scores.append(_miss(trial.changed().at(poses), progress))
        except (UrdfcalError, np.linalg.LinAlgError):  # such a session cannot be
            scores.append(np.inf)
    if not scores:
        return None
    order = np.argsort(scores, kind="stable")
    best = scores[order[0]]
    second = scores[order[1]] if len(order) > 1 else np.inf
    if not np.isfinite(best) or _BETTER * best > before or _CLEAR * best > second:
        return None
    return Suspicion(trials[order[0]].what, factor * before, factor * best, unit)


def _miss(session: Session, progress: Progress | None) -> float:
    """Median residual of the first kind of measurement under the nominal arm; infinite where there is no start."""
    arm = rows_of(session.chain)
    try:
        start = first_state(session, arm, no_offsets(arm))
        problem = Problem.of(session, arm)
        parameters = choose_parameters(session, problem, start, nominal(session, start))
        state = sketch(problem, start, parameters, _STEPS, progress)
    except UrdfcalError:
        return np.inf
    observed = problem.observations[0]
    residual = problem.residual(observed, state)
    for of in observed.table.spread_of().values():
        if of.unit == "rad":
            residual[..., of.numbers] *= _LEVER
    return float(np.median(np.linalg.norm(residual, axis=-1)[observed.valid]))


def _trials(session: Session) -> Iterator[Mending]:
    yield from _joint_trials(session)
    yield from _camera_trials(session)
    yield from _pose_trials(session)
    yield from _family(session)
    carriers = {led.link or session.chain.tip_link for led in session.leds}
    for link in _links(session) if len(carriers) == 1 else ():
        if link not in carriers:
            yield Mending(f"the LEDs are on {link}, not on {min(carriers)}", partial(_on, session, link))


def _family(session: Session) -> Iterator[Mending]:
    for path, other in family(session):
        yield Mending(f"the robot is {path.stem}, not {session.chain.name}", partial(replace, session, chain=other))


def _joint_trials(session: Session) -> Iterator[Mending]:
    chain = session.chain

    def read(change: Callable[[Floats], Floats]) -> Session:
        def values(q: Floats) -> Floats:
            return chain.joint_values(change(chain.readings(q)))

        return replace(
            session, q=values(session.q), torques=None, previous=None, motion=session.motion.read_otherwise(values)
        )

    each = np.arange(len(chain.actuated))
    for j, name in enumerate(chain.actuated):
        yield Mending(f"{name}'s sign", partial(read, partial(np.multiply, np.where(each == j, -1.0, 1.0))))
    for a, b in combinations(range(len(each)), 2):
        order = each.copy()
        order[[a, b]] = b, a
        what = f"the columns of {chain.actuated[a]} and {chain.actuated[b]} are exchanged"
        yield Mending(what, partial(read, partial(np.take, indices=order, axis=1)))
    for by in _SHIFTS:  # what comes round from the other end is a row or two: the median does not mind
        what = f"joint readings are shifted by {abs(by)} row{'s' * (abs(by) > 1)} against what was measured"
        yield Mending(what, partial(read, partial(np.roll, shift=by, axis=0)))


def _camera_trials(session: Session) -> Iterator[Mending]:
    rig = session.rig
    whose: dict[str, list[int]] = {"the cameras": list(range(len(rig.names)))} if rig.names else {}
    whose |= {name: [c] for c, name in enumerate(rig.names)} if len(rig.names) > 1 else {}
    for name, cameras in whose.items():
        for what, change in _IMAGES.items():
            yield Mending(f"the images of {name} {what}", partial(_seen, session, cameras, change))
    for c, T in enumerate(rig.T_cam_world):
        if c and T is not None:
            places = tuple(inverse(T) if k == c else of for k, of in enumerate(rig.T_cam_world))
            inverted = partial(replace, session, rig=replace(rig, T_cam_world=places))
            yield Mending(f"T_cn_cnm1 of {rig.names[c]} is inverted", inverted)


_IMAGES: dict[str, Callable[[Floats, Floats], Floats]] = {
    "are mirrored": lambda uv, size: np.stack([size[:, 0] - 1.0 - uv[:, 0], uv[:, 1]], axis=1),
    "are upside down": lambda uv, size: size - 1.0 - uv,
    "have half the resolution that the camera file says": lambda uv, _: 2.0 * uv + 0.5,
    "have twice the resolution that the camera file says": lambda uv, _: 0.5 * (uv - 0.5),
}
"""What may have been done to images, and how detections (S, 2) in images of a size (S, 2) are set right. [px]"""


def _seen(session: Session, cameras: Sequence[int], change: Callable[[Floats, Floats], Floats]) -> Session:
    detections = session.find(Detections)
    if detections is None:
        raise CalibrationError("no camera detected anything")
    uv, size = np.array(detections.uv), np.array([camera.resolution for camera in session.rig.cameras], dtype=float)
    mine = np.isin(detections.camera, cameras)
    uv[mine] = change(uv[mine], size[detections.camera[mine]])
    return _with_table(session, detections, replace(detections, uv=uv))


def _with_table(session: Session, old: Measurements, new: Measurements) -> Session:
    """Return a session with a table instead of one of its own, as the first of them."""
    others = (table for table in session.measurements if table is not old)
    return replace(session, measurements=(new, *others))


def _pose_trials(session: Session) -> Iterator[Mending]:
    table = session.find(Poses)
    if table is None:
        return
    for what, change in _POSES_ARE.items():
        yield Mending(what, partial(_with_table, session, table, replace(table, place=change(table.place))))


def _turned_back(place: Floats) -> Floats:
    """Poses (S, 7) with each orientation's inverse."""
    back: Floats = place * np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    return back


def _inverted(place: Floats) -> Floats:
    """The inverses of poses (S, 7)."""
    back = _turned_back(place)
    R = np.array([quaternion_to_matrix(q) for q in back[:, 3:]])
    back[:, :3] = -np.einsum("sij,sj->si", R, place[:, :3])
    return back


_POSES_ARE: dict[str, Callable[[Floats], Floats]] = {
    "the quaternions of poses.csv are in the order qw, qx, qy, qz": lambda p: p[:, [0, 1, 2, 4, 5, 6, 3]],
    "the orientations of poses.csv are those of the world in the target": _turned_back,
    "the poses of poses.csv are those of the world in the target (of hand-eye samples: the other --eye)": _inverted,
}
"""What poses (S, 7) may be instead of x, y, z, qx, qy, qz, qw in the world, and how they are set right."""


def _links(session: Session) -> list[str]:
    """Links of the URDF that move with the robot."""
    if session.urdf is None:
        return []
    chain = {joint.child for joint in session.urdf.joints.values() if joint.name in session.chain.names}
    found = set(chain)
    for _ in session.urdf.links:
        found |= {joint.child for joint in session.urdf.joints.values() if joint.parent in found}
    return [link for link in session.urdf.links if link in found]


def _on(session: Session, link: str) -> Session:
    frames = session.attachments.frames
    if session.urdf is None or set(frames) != {frames[0], session.chain.tip_link}:
        raise CalibrationError("the robot is a tree")
    chain = Chain.from_urdf(session.urdf, link, session.chain.base_link)
    if not set(chain.names) <= set(session.chain.names):
        raise CalibrationError("a joint of it has no reading")
    own = partial(np.take, indices=[session.chain.names.index(name) for name in chain.names], axis=1)
    return replace(
        session,
        chain=chain,
        q=own(session.q),
        torques=None,
        previous=None,
        joint_models={},
        gear_ratio={},
        motion=session.motion.read_otherwise(own),
    )
