"""Plan the next poses of a calibration, in which the arm collides with nothing and every camera sees every LED."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, Ints, evenly, frozen
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.pipeline import calibrate
from urdfcal.planning.belief import Belief, check_plannable
from urdfcal.planning.design import choose
from urdfcal.planning.route import NOWHERE, Moves, route
from urdfcal.planning.workspace import workspace_values
from urdfcal.session.model import Session
from urdfcal.session.rig_description import RigDescription
from urdfcal.simulation.planning import MARGIN, in_view, load_collision_checker
from urdfcal.simulation.simulate import nominal_scene

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.planning.design import Candidates
    from urdfcal.planning.workspace import WorkspaceOfInterest
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Setup

# What an arm that is not calibrated, or is measured by hand, may be off by at its tip and at what stands around. [m]
_CLEARANCE = 0.02
# Before anything is measured, the base's place as a user gives it. [m, rad]
_BASE_OFF = (0.03, 0.02)
# ... but the middle of the image is kept.
_MOST_MARGIN = 0.3
# Poses from which the closed forms find a rig's nominal state again: six detections are enough of one camera.
_TO_START = 20
# Draws of candidates, each of as many as are missing: where one in five keeps clear, two thirds come together.
_BATCHES = 6
# Fewer candidates are no choice, and too few to tell what they identify.
_LEAST = 10
# Poses that identify whatever more of them do.
_TO_IDENTIFY = 100
# Ways are looked for so often, each time without the poses that none was found to.
_TRIES = 20
_NO_WAY = "no free way was found from the last measured pose: bring the arm to the first pose of the plan yourself"


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure.

    Attributes:
        chain: the arm.
        q: (K, n) joint values in the order of the moves. [rad or m]
        rank: (K,) which of the N poses each is, from 0, those that bring most first; -1 where the arm only passes.
        errors: (N + 1,) the tip's expected rms error over the workspace: as it is, and after each pose. [m]
        likely: (N + 1,) what it is at most in nine of ten arms. [m]
        warnings: what could not be checked.
    """

    chain: Mechanism
    q: Floats
    rank: Ints
    errors: Floats
    likely: Floats
    warnings: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of poses to measure."""
        return int(np.count_nonzero(self.rank >= 0))


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What planning starts from: a belief, poses (M, n) that the arm can take, and what they would tell."""

    belief: Belief
    q: Floats
    candidates: Candidates
    moves: Moves
    warnings: tuple[str, ...]


class Planner:
    """Plan poses one by one or many at once, from a rig, or from a session with a few measured ones."""

    def __init__(
        self,
        setup: Setup,
        *,
        workspace: WorkspaceOfInterest = None,
        candidates: int = 2000,
        seed: int = 0,
        progress: Callable[[int], object] | None = None,
    ) -> None:
        """Start from what is there; the work is done when the first pose is asked for.

        Args:
            setup: a session, or a rig where nothing is measured yet.
            workspace: where the tip is to be accurate: joint values (M, n), a CSV file of them, two corners of a box
                in the base link's frame [m], or "session"; the joints' ranges by default.
            candidates: how many poses to choose from.
            seed: of all that is random.
            progress: called with the number of candidates done since the last call, each twice.

        Raises:
            SessionError: no camera measures, the arm moves while it is measured, or nothing says where it stands.
        """
        check_plannable(setup)
        if not isinstance(setup, (Session, RigDescription)):
            remedy = "Give a session with a few poses, or a rig with its stand."
            raise SessionError("nothing says where the arm stands", where=str(setup.folder or "setup"), remedy=remedy)
        if candidates < 1:
            raise SessionError(f"{candidates} candidates are none", where="candidates")
        self._setup, self._workspace, self._seed = setup, workspace, seed
        self._count, self._progress = candidates, progress
        self._prepared: _Prepared | None = None

    def next(self, session: Session) -> Floats:
        """Return the joint values (n,) of the pose that brings most, all joints of the chain. [rad or m].

        The arm as the first session gives it is kept for the later ones: they add to what is known, not to where the
        arm is thought to be.

        Args:
            session: what is measured so far.

        Raises:
            SessionError: as :meth:`plan`.
        """
        at = self._prepare(session)
        belief = at.belief.with_session(session)
        # Another look at a pose tells as much as the first, but for what repeats there and is no noise.
        free = np.array([not (np.abs(session.q - q).max(axis=1) < 1e-3).any() for q in at.q])
        best: Floats = at.q[at.candidates.best(belief.information, free)].copy()
        return best

    def plan(
        self,
        count: int,
        *,
        until: float = 0.0,
        progress: Callable[[int], object] | None = None,
    ) -> Plan:
        """Plan poses, in an order of short moves that are free of collisions.

        Args:
            count: how many at most.
            until: fewer, where the tip's rms error comes to this in nine of ten arms. [m]
            progress: called with the number of poses done since the last call, each twice.

        Raises:
            SessionError: there are too few poses that the arm can take and the cameras see, or no way leads to them.
            CalibrationError: the session is none that a calibration can start from.
        """
        at = self._prepare(self._setup if isinstance(self._setup, Session) else None)
        free = np.ones(len(at.q), dtype=bool)
        start, warnings, known = at.belief.q, at.warnings, at.belief.information
        for _ in range(_TRIES):
            chosen = choose(at.candidates, known, count, free=free, until=until, progress=progress)
            way = route(at.q[list(chosen)], start, at.moves, at.q, progress) if chosen else NOWHERE
            if not way.unreached:
                break
            if len(way.unreached) == len(chosen) and start is not None:
                start, warnings = None, (*warnings, _NO_WAY)
            else:
                free[[chosen[k] for k in way.unreached]] = False
        errors, likely = at.candidates.course(known, chosen)
        reached = len(chosen) - len(way.unreached)
        if way.unreached or (reached < count and likely[-1] > until):
            what = f"{reached} of {count} poses found, among {len(at.q)} that are free and seen, that a way leads to"
            remedy = "Ask for fewer poses, let the cameras stand further away, or move the arm elsewhere first."
            raise SessionError(what, where="plan", remedy=remedy)
        return Plan(at.belief.setup.chain, way.q, way.pose, errors, likely, warnings)

    def _prepare(self, session: Session | None) -> _Prepared:
        if self._prepared is None:
            self._prepared = self._from_rig(self._setup) if session is None else self._from_session(session)
        return self._prepared

    def _from_session(self, session: Session) -> _Prepared:
        try:
            belief = Belief.of_calibration(calibrate(session, force=True, seed=self._seed))
        except CalibrationError:
            if not isinstance(self._setup, RigDescription):
                raise
            return self._from_rig(self._setup)
        return self._with_candidates(belief, session, MARGIN)

    def _from_rig(self, setup: Setup) -> _Prepared:
        if not isinstance(setup, RigDescription):
            raise SessionError("nothing is measured", where="plan", remedy="Give a session to go on from.")
        scene, margin = nominal_scene(setup), base_margin(setup)
        q, _, _ = in_view(scene.outlined(), _TO_START, np.random.default_rng(self._seed), margin)
        if len(q) < _TO_START:
            raise _unseen(len(q), margin)
        return self._with_candidates(Belief.of_rig(setup, q), None, margin)

    def _with_candidates(self, belief: Belief, session: Session | None, margin: float) -> _Prepared:
        chain, rng, outlined = belief.setup.chain, np.random.default_rng(self._seed), belief.scene.outlined()
        checker, warnings = load_collision_checker(outlined, belief.setup, _CLEARANCE)
        found: list[Floats] = []
        for _ in range(_BATCHES):
            q, _, _ = in_view(outlined, self._count - len(found), rng, margin)
            centres = outlined.camera_centres(q)
            clear = [
                checker is None or (checker.is_free(a) and checker.is_seen(a, c))
                for a, c in zip(q, centres, strict=True)
            ]
            found += list(q[clear])
            if self._progress is not None:
                self._progress(int(np.sum(clear)))
            if len(found) >= self._count:
                break
        if len(found) < _LEAST:
            raise _unseen(len(found), margin)
        q = np.array(found)
        workspace = workspace_values(self._workspace, chain, session, self._seed)
        belief = belief.identified_by(q[evenly(np.arange(len(q)), _TO_IDENTIFY)])
        moves = Moves(None, None)
        if checker is not None:
            bare, _ = load_collision_checker(outlined, belief.setup)
            moves = Moves(checker.is_free, None if bare is None else bare.is_free)
        return _Prepared(belief, frozen(q), belief.candidates(q, workspace, self._progress), moves, warnings)


def base_margin(rig: RigDescription) -> float:
    """Return how far from the images' borders to plan while the base's place is known to centimetres. [px]."""
    if rig.stand is None:
        return MARGIN
    near = float(np.linalg.norm(np.asarray(rig.stand.look_at) - rig.stand.position))
    shift, turn = _BASE_OFF
    focal = max(max(camera.intrinsics[:2]) for camera in rig.rig.cameras)
    smallest = min(min(camera.resolution) for camera in rig.rig.cameras)
    return float(min(MARGIN + focal * (shift / near + turn), _MOST_MARGIN * smallest))


def _unseen(count: int, margin: float) -> SessionError:
    return SessionError(
        f"of all random poses {count} are free, and seen by every camera {margin:.0f} px from its image's border",
        where="plan",
        remedy="Let the cameras stand further away, or look at the middle of the workspace.",
    )
