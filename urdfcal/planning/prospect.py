"""What planning starts from: an arm as far as it is known, and poses that it could be measured in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import evenly, frozen
from urdfcal.errors import SessionError
from urdfcal.planning.design import Candidates, choose, enough
from urdfcal.planning.reach import Reach
from urdfcal.planning.refinement import refine
from urdfcal.planning.route import Moves
from urdfcal.simulation.planning import load_collision_checker

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.planning.belief import Belief

# What an arm that is not calibrated, or is measured by hand, may be off by at its tip and at what stands around. [m]
_CLEARANCE = 0.02
# Fewer candidates are no choice, and too few to tell what they identify.
_LEAST = 10
# Poses that identify whatever more of them do.
_TO_IDENTIFY = 100
# Nearer than this in every joint [rad or m] it is the same pose: what errs there each time would count as known.
_SAME = 0.05
# Poses that a way may lead over: 300 of a ur5 connect what straight moves from pose to pose leave apart, in a second.
_VIAS = 300
# Each candidate so often: of what poses tell nothing is left to know.
_MANY = 1e4
# An error is worth a word if it is more than this share of another.
_MOST = 0.7
# How well a calliper tells the distance of two LEDs. [m]
_CALIPER = 1e-4


@dataclass(frozen=True, eq=False)
class Choice:
    """Poses that were chosen.

    Attributes:
        q: (K, n) joint values. [rad or m]
        tell: what they would tell.
        origin: (K,) the candidates that they were before they were refined.
    """

    q: Floats
    tell: Candidates
    origin: tuple[int, ...]

    def of(self, which: Sequence[int]) -> Choice:
        """Return some of them, in that order."""
        return Choice(self.q[list(which)], self.tell.of(which), tuple(self.origin[k] for k in which))

    def __add__(self, other: Choice) -> Choice:
        """Return these and others."""
        return Choice(np.vstack([self.q, other.q]), self.tell + other.tell, (*self.origin, *other.origin))

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.q)


@dataclass(frozen=True, eq=False)
class Prospect:
    """A belief, candidate poses in view, and what they would tell.

    Attributes:
        belief: what is known of the arm, of what the candidates identify.
        q: (M, n) candidates, in view of every camera. [rad or m]
        candidates: what they would tell.
        workspace: (N, n) where the tip is to be accurate. [rad or m]
        reach: says which of them the arm can take.
        moves: says where the arm can move.
        warnings: what could not be checked.
    """

    belief: Belief
    q: Floats
    candidates: Candidates
    workspace: Floats
    reach: Reach
    moves: Moves
    warnings: tuple[str, ...]

    @classmethod
    def of(
        cls,
        belief: Belief,
        workspace: Floats,
        count: int,
        *,
        margin: float,
        seed: int,
        progress: Callable[[float], object] | None = None,
    ) -> Prospect:
        """Draw candidates, and say what they would tell.

        Args:
            belief: what is known of the arm.
            workspace: (N, n) where its tip is to be accurate. [rad or m]
            count: how many candidates.
            margin: that they keep from the images' borders. [px]
            seed: of the candidates.
            progress: called with the number of candidates done since the last call.

        Raises:
            SessionError: the arm can take fewer than a few poses in view.
        """
        outlined = belief.scene.outlined()
        checker, warnings = load_collision_checker(outlined, belief.setup, _CLEARANCE)
        bare, _ = load_collision_checker(outlined, belief.setup) if checker is not None else (None, ())
        reach = Reach(outlined, checker, margin)
        q = reach.draw(count, np.random.default_rng(seed))
        free = len(list(islice(filter(reach.takes, q), _LEAST)))
        if free < _LEAST:
            raise unfree(free, len(q), margin)
        belief = belief.identified_by(q[evenly(np.arange(len(q)), _TO_IDENTIFY)])
        moves = Moves(None if checker is None else checker.is_free, None if bare is None else bare.is_free)
        told = belief.candidates(q, workspace, progress)
        return cls(belief, frozen(q), told, workspace, reach, moves, warnings)

    @cached_property
    def vias(self) -> Floats:
        """(N, n) candidates that the arm can pass through. [rad or m]."""
        clear = islice((q for q in self.q if self.moves.clear(q)), _VIAS)
        return np.array(list(clear)).reshape(-1, self.q.shape[1])

    def floor(self, belief: Belief) -> float:
        """Return the tip's expected rms error at a belief that no poses would take away. [m]."""
        return self.candidates.error(belief.information + _MANY * self.candidates.information(range(len(self.q))))

    def limits(self, error: float) -> tuple[str, ...]:
        """Say what no poses tell, where that is most of an expected error, and what would. [m]."""
        floor = self.floor(self.belief)
        if floor < _MOST * error:
            return ()
        said = f"{1e3 * floor:.2g} mm of the tip's expected error no poses take away: tolerances decide"
        known = self.belief.with_distance(_CALIPER)
        if known is not None and (left := self.floor(known[1])) < _MOST * floor:
            a, b = known[0]
            said += (
                f"; the distance of {a} and {b}, by calliper and named in led_distances, would leave {1e3 * left:.2g}"
            )
        return (said,)

    @property
    def nothing(self) -> Choice:
        """Return no pose."""
        return Choice(self.q[:0], self.candidates.of(()), ())

    def best(self, belief: Belief, measured: Floats) -> Floats:
        """Return the candidate (n,) that brings most to a belief, but for measured poses (N, n). [rad or m].

        Raises:
            SessionError: the arm can take none.
        """

        def allowed(k: int) -> bool:
            return _apart(self.q[k], measured) and self.reach.takes(self.q[k])

        best = self.candidates.best(belief.information, allowed)
        if best is None:
            raise unfree(0, len(self.q), self.reach.margin)
        found: Floats = self.q[best].copy()
        return found

    def choose(
        self,
        kept: Choice,
        count: int,
        *,
        barred: Container[int],
        until: float = 0.0,
        rng: np.random.Generator,
        progress: Callable[[float], object] | None = None,
    ) -> Choice:
        """Choose poses, the best candidates first, and refine these.

        Args:
            kept: poses that were chosen before, and stay.
            count: how many at most, with those.
            barred: candidates that may not be chosen.
            until: fewer, where the tip's rms error comes to this in nine of ten arms. [m]
            rng: the source of randomness.
            progress: called with the number of poses done since the last call, each twice.

        Returns:
            All of them, those that bring most first.
        """
        chosen = partial(self._chosen, kept, barred=barred, rng=rng, progress=progress)
        found = chosen(count, until=until)
        # They were chosen one by one: fewer that are chosen for each other may be enough, too.
        least, most = len(kept), len(found) if self._likely(found) <= until else 0
        trial = most - 1
        while trial > least:
            fewer = chosen(trial)
            if self._likely(fewer) <= until:
                found, most = fewer, len(fewer)
            else:
                least = trial
            trial = (least + most) // 2
        return found

    def _likely(self, chosen: Choice) -> float:
        """Return what the tip's rms error is at most in nine of ten arms, with some poses. [m]."""
        return chosen.tell.likely(self.belief.information + chosen.tell.information(range(len(chosen))))

    def _chosen(
        self,
        kept: Choice,
        count: int,
        *,
        barred: Container[int],
        until: float = 0.0,
        rng: np.random.Generator,
        progress: Callable[[float], object] | None = None,
    ) -> Choice:
        """Choose poses one by one until they are enough, exchange them, refine them, and leave out what is too many."""
        known = self.belief.information + kept.tell.information(range(len(kept)))

        def allowed(k: int) -> bool:
            return k not in barred and self.reach.takes(self.q[k])

        def apart(q: Floats, others: Floats) -> bool:
            return _apart(q, others) and _apart(q, kept.q)

        picked = choose(self.candidates, known, count - len(kept), allowed=allowed, until=until, progress=progress)
        more, order = Choice(self.q[list(picked)], self.candidates.of(picked), picked), list(range(len(picked)))
        while order:
            more = more.of(order)
            q, tell = refine(
                more.q, more.tell, known, self.reach, self.belief.told_by, apart=apart, rng=rng, progress=progress
            )
            more = Choice(q, tell, more.origin)
            order = enough(tell, known, until)
            if len(order) == len(more):
                break
        every = kept + more.of(order)
        return every.of(enough(every.tell, self.belief.information, until))

    def spare(self, count: int, chosen: Choice, barred: Container[int]) -> tuple[int, ...]:
        """Return random candidates beside chosen poses; fewer where the arm cannot take as many."""

        def allowed(k: int) -> bool:
            return k not in barred and _apart(self.q[k], chosen.q) and self.reach.takes(self.q[k])

        # They are in no order, and the last ones as random as any.
        return tuple(islice(filter(allowed, reversed(range(len(self.q)))), count))


def unfree(free: int, count: int, margin: float) -> SessionError:
    """Return the error that too few poses are free, of those in view ``margin`` px from the images' borders."""
    return SessionError(
        f"{free} poses are free, of {count} that every camera sees {margin:.0f} px from its image's border",
        where="plan",
        remedy="Let the cameras stand further away, look at the middle of the workspace, move what scene names out of "
        "the way, or ask for more candidates.",
    )


def _apart(q: Floats, others: Floats) -> bool:
    """Return whether a pose (n,) is another one than those of some (M, n)."""
    return bool((np.abs(others - q).max(axis=1) > _SAME).all())
