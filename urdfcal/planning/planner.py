"""Plan the next poses of a calibration, in which the arm collides with nothing and every camera sees every LED."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import frozen, one_blas_thread
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.pipeline import calibrate
from urdfcal.planning.belief import Belief, check_plannable
from urdfcal.planning.prospect import Prospect, unfree
from urdfcal.planning.recalibration import scene_of
from urdfcal.planning.route import NOWHERE, route
from urdfcal.planning.workspace import workspace_values
from urdfcal.result.calibration import Calibration
from urdfcal.session.model import Session
from urdfcal.session.rig_description import RigDescription
from urdfcal.simulation.planning import MARGIN, in_view
from urdfcal.simulation.simulate import nominal_scene

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.planning.prospect import Choice
    from urdfcal.planning.route import Route
    from urdfcal.planning.workspace import WorkspaceOfInterest
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.session.model import Setup
    from urdfcal.session.obstacle import Obstacle
    from urdfcal.simulation.scene import Scene

# Before anything is measured, the base's place as a user gives it. [m, rad]
_BASE_OFF = (0.03, 0.02)
# ... but the middle of the image is kept.
_MOST_MARGIN = 0.3
# Poses from which the closed forms find a rig's nominal state again: six detections are enough of one camera.
_TO_START = 20
# Ways are looked for so often, each time without the poses that none was found to.
_TRIES = 20
# Poses to check by, as a share of the others; fewer than four are an anecdote.
_CHECKS, _LEAST_CHECKS = 0.2, 4
# A plan of fewer poses than were asked for is one still, and says so.
_ENOUGH = 0.5
_MORE_ROOM = ", or among more candidates, let the cameras stand further away, or move the arm elsewhere first."
_NO_WAY = "no free way was found from the last measured pose: bring the arm to the first pose of the plan yourself"
_UNKNOWN_START = "where the arm stands now is not known: bring it to the first pose of the plan yourself"


@dataclass(frozen=True, eq=False)
class Outlook:
    """The tip's expected error where it is to be accurate.

    Attributes:
        q: (M, n) joint values that stand for the workspace. [rad or m]
        before: (M,) as it is. [m]
        after: (M,) once the planned poses are measured. [m]
    """

    q: Floats
    before: Floats
    after: Floats


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure.

    Attributes:
        setup: the arm, its LEDs and its cameras.
        scene: where all that is thought to be.
        q: (K, n) joint values in the order of the moves. [rad or m]
        rank: (K,) which of the N poses each is, from 0, those that bring most first; -1 of others.
        check: (K,) which are random poses to check the calibration by; at the others of rank -1 the arm only passes.
        errors: (N + 1,) the tip's expected rms error over the workspace: as it is, and after each pose. [m]
        likely: (N + 1,) what it is at most in nine of ten arms. [m]
        floor: what no poses would take away of the expected error. [m]
        outlook: the expected error at each place of the workspace.
        warnings: what could not be checked, and what no poses tell.
        before: names of the poses of the session that it goes on from, those that are left out of it among them.
    """

    setup: Setup
    scene: Scene
    q: Floats
    rank: Ints
    check: Bools
    errors: Floats
    likely: Floats
    floor: float
    outlook: Outlook
    warnings: tuple[str, ...]
    before: tuple[str, ...] = ()

    @property
    def chain(self) -> Mechanism:
        """The arm."""
        return self.setup.chain

    @property
    def count(self) -> int:
        """Number of poses to calibrate by."""
        return int(np.count_nonzero(self.rank >= 0))

    @property
    def measured(self) -> Bools:
        """(K,) where something is measured."""
        return (self.rank >= 0) | self.check


class Planner:
    """Plan poses one by one or many at once, from a rig, an earlier result, or a session with a few measured ones."""

    def __init__(
        self,
        setup: Setup | Calibration,
        *,
        urdf: Urdf | None = None,
        scene: Sequence[Obstacle] = (),
        workspace: WorkspaceOfInterest = None,
        candidates: int = 2000,
        seed: int = 0,
        progress: Callable[[float], object] | None = None,
    ) -> None:
        """Start from what is there; the work is done when the first pose is asked for.

        Args:
            setup: a session; where nothing is measured yet a rig, or an earlier calibration of the arm, whose cameras
                still stand where they stood.
            urdf: with a calibration the corrected one, without which collisions are not looked for.
            scene: what stands around the arm beside what is known of that already.
            workspace: where the tip is to be accurate: joint values (M, n), a CSV file of them, two corners of a box
                in the base link's frame [m], or "session"; the joints' ranges by default.
            candidates: how many poses to choose from.
            seed: of all that is random.
            progress: called with the number of candidates done since the last call.

        Raises:
            SessionError: no camera measures, the arm moves while it is measured, or nothing says where it stands.
        """
        # Where all is thought to be, and the margin to keep for what it may be off; of a session nothing.
        self._known: tuple[tuple[Setup, Scene, float], ...] = ()
        if isinstance(setup, Calibration):
            setup, there = scene_of(setup, urdf)
            self._known = ((setup, there, MARGIN),)
        check_plannable(setup)
        if isinstance(setup, RigDescription):
            self._known = ((setup, nominal_scene(setup), base_margin(setup)),)
        if not self._known and not isinstance(setup, Session):
            remedy = "Give a session with a few poses, or a rig with its stand."
            raise SessionError("nothing says where the arm stands", where=str(setup.folder or "setup"), remedy=remedy)
        if candidates < 1:
            raise SessionError(f"{candidates} candidates are none", where="candidates")
        self._setup, self._workspace, self._seed = setup, workspace, seed
        self._count, self._progress, self._scene = candidates, progress, tuple(scene)
        self._prepared: Prospect | None = None

    def next(self, session: Session) -> Floats:
        """Return the joint values (n,) of the pose that brings most, all joints of the chain. [rad or m].

        The arm as the first session gives it is kept for the later ones: they add to what is known, not to where the
        arm is thought to be.

        Args:
            session: what is measured so far.

        Raises:
            SessionError: as :meth:`plan`.
        """
        with one_blas_thread():
            at = self._prepare(session)
            return at.best(at.belief.with_session(session), session.q)

    def plan(
        self,
        count: int,
        *,
        until: float = 0.0,
        check: bool = False,
        progress: Callable[[float], object] | None = None,
    ) -> Plan:
        """Plan poses, in an order of short moves that are free of collisions.

        Args:
            count: how many at most.
            until: fewer, where the tip's rms error comes to this in nine of ten arms. [m]
            check: whether to plan random poses, too, by which the calibration can be checked: a fifth more.
            progress: called with the number of poses done since the last call, each three times.

        Raises:
            SessionError: there are too few poses that the arm can take and the cameras see, or no way leads to them.
            CalibrationError: the session is none that a calibration can start from.
        """
        with one_blas_thread():
            session = self._setup if isinstance(self._setup, Session) else None
            found = self._planned(self._prepare(session), count, until, progress, check=check)
        return found if session is None else replace(found, before=(*session.poses, *session.excluded.poses))

    def _planned(
        self, at: Prospect, count: int, until: float, progress: Callable[[float], object] | None, *, check: bool
    ) -> Plan:
        rng, barred = np.random.default_rng(self._seed), set[int]()
        start, warnings, kept = at.belief.q, at.warnings, at.nothing
        if start is None:
            warnings = (*warnings, _UNKNOWN_START)
        for _ in range(_TRIES):
            chosen = at.choose(kept, count, barred=barred, until=until, rng=rng, progress=progress)
            checks = max(_LEAST_CHECKS, round(_CHECKS * len(chosen))) if check and len(chosen) else 0
            origin = (*chosen.origin, *at.spare(checks, chosen, barred))
            q = np.vstack([chosen.q, at.q[list(origin[len(chosen) :])]])
            way = route(q, start, at.moves, at.vias, progress) if len(q) else NOWHERE
            if not way.unreached:
                break
            if len(way.unreached) == len(q) and start is not None:
                start, warnings, kept = None, (*warnings, _NO_WAY), chosen
            else:
                barred |= {origin[k] for k in way.unreached}
                kept = chosen.of([k for k in range(len(chosen)) if k not in way.unreached])
        if way.unreached:
            lost = sum(k >= len(chosen) for k in way.unreached)
            warnings = (*warnings, f"no free way leads to {lost} of the poses to check by") if lost else warnings
            chosen, way = _reached(chosen, way)
        errors, likely = chosen.tell.course(at.belief.information, range(len(chosen)))
        if len(chosen) < count and likely[-1] > until:
            what = f"{len(chosen)} of {count} poses found, among {len(at.q)} in view, that are free and a way leads to"
            remedy = f"Ask for {'none to check by (--no-check), for ' if check else ''}fewer poses{_MORE_ROOM}"
            if not len(chosen) or (len(chosen) < _ENOUGH * count and not until):
                raise SessionError(what, where="plan", remedy=remedy)
            warnings = (*warnings, f"{what}: these are planned. {remedy}")
        spare = way.pose >= len(chosen)
        rank = frozen(np.where(spare, -1, way.pose), np.intp)
        then = at.belief.information + chosen.tell.information(range(len(chosen)))
        before, after = (at.belief.tip_errors(of, at.workspace) for of in (at.belief.information, then))
        outlook = Outlook(frozen(at.workspace), frozen(before), frozen(after))
        setup, scene, warnings = at.belief.setup, at.belief.scene, (*warnings, *at.limits(errors[-1]))
        return Plan(
            setup, scene, way.q, rank, frozen(spare, bool), errors, likely, at.floor(at.belief), outlook, warnings
        )

    def _prepare(self, session: Session | None) -> Prospect:
        if self._prepared is None:
            self._prepared = self._from_scene(*self._known[0]) if session is None else self._from_session(session)
        return self._prepared

    def _from_session(self, session: Session) -> Prospect:
        try:
            belief = Belief.of_calibration(calibrate(session, force=True, seed=self._seed))
        except CalibrationError:
            if not self._known:
                raise
            return self._from_scene(*self._known[0])
        return self._with_candidates(belief, session, MARGIN)

    def _from_scene(self, setup: Setup, scene: Scene, margin: float) -> Prospect:
        q, _, _ = in_view(scene.outlined(), _TO_START, np.random.default_rng(self._seed), margin)
        if len(q) < _TO_START:
            raise unfree(len(q), len(q), margin)
        return self._with_candidates(Belief.of_scene(setup, scene, q), None, margin)

    def _with_candidates(self, belief: Belief, session: Session | None, margin: float) -> Prospect:
        belief = replace(belief, setup=replace(belief.setup, scene=(*belief.setup.scene, *self._scene)))
        workspace = workspace_values(self._workspace, belief.setup.chain, session, self._seed)
        return Prospect.of(belief, workspace, self._count, margin=margin, seed=self._seed, progress=self._progress)


def _reached(chosen: Choice, way: Route) -> tuple[Choice, Route]:
    """Leave out of a choice, and of the numbers of a way's poses, those that it does not reach."""
    number = np.cumsum(~np.isin(np.arange(way.pose.max(initial=0) + 1), way.unreached)) - 1
    reached = chosen.of([k for k in range(len(chosen)) if k not in way.unreached])
    return reached, replace(way, pose=np.where(way.pose < 0, way.pose, number[way.pose]), unreached=())


def base_margin(rig: RigDescription) -> float:
    """Return how far from the images' borders to plan while the base's place is known to centimetres. [px]."""
    if rig.stand is None:
        return MARGIN
    near = float(np.linalg.norm(np.asarray(rig.stand.look_at) - rig.stand.position))
    shift, turn = _BASE_OFF
    focal = max(max(camera.intrinsics[:2]) for camera in rig.rig.cameras)
    smallest = min(min(camera.resolution) for camera in rig.rig.cameras)
    return float(min(MARGIN + focal * (shift / near + turn), _MOST_MARGIN * smallest))
