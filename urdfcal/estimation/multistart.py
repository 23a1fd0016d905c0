"""Several solutions: starts near and far, minima told apart by the kinematics they predict (seed's steps 5, 6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import CalibrationError
from urdfcal.estimation.linearize import view
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state, kabsch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Geometry
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

# Chi-square by which a minimum may lie above the best and still be chance: five standard deviations.
_CHANCE = 25.0
# Minima whose LEDs agree to this share of the arm's reach wherever it goes are one arm: the solver stops at 1e-6 of
# a standard deviation, other minima are millimetres away.
_SAME = 1e-5
# Offsets beyond this many tolerances contradict the arm's drawing.
_INCONGRUENT = 20.0
# Near starts are drawn within a few tolerances; far ones have lengths off by up to this share of the reach and
# angles by up to half a turn.
_NEAR, _FAR_LENGTH = 3.0, 0.3


@dataclass(frozen=True, eq=False)
class Candidate:
    """One local minimum.

    Attributes:
        solution: where the solver arrived; None where it never started.
        kept: whether it is the one that is used.
        reason: why it was discarded, or what makes it the one.
    """

    solution: Solution | None
    kept: bool
    reason: str

    @property
    def cost(self) -> float:
        """Chi-square of residuals and priors; NaN where there is none."""
        return self.solution.cost if self.solution is not None else float("nan")


def several(
    session: Session,
    table: Geometry,
    blocks: Sequence[Observations],
    first: Solution,
    starts: int,
    seed: int,
    progress: Progress | None = None,
) -> tuple[Candidate, ...]:
    """Start again from other arms, and screen what comes out.

    Args:
        session: what was measured.
        table: the arm's parameters.
        blocks: the session's observations.
        first: the solution found from the drawing; it takes part.
        starts: how many others to start, every second one far beyond tolerance.
        seed: of the starts.
        progress: called after every solver step.

    Returns:
        All minima, the kept one first.
    """
    rng = np.random.default_rng(seed)
    found: list[Solution] = [first]
    lost: list[Candidate] = []
    for k in range(starts):
        try:
            start = _start(session, table, first, rng, far=bool(k % 2))
            found.append(solve(table, blocks, start, first.parameters, session.noise.joint, progress))
        except CalibrationError as error:
            lost.append(Candidate(None, False, f"no start: {error.what}"))
    return (*_screen(session, table, blocks, found), *lost)


def _start(session: Session, table: Geometry, first: Solution, rng: np.random.Generator, *, far: bool) -> State:
    parameters = first.parameters
    offsets = np.zeros_like(first.state.offsets)
    for index, (row, name) in enumerate(parameters.rows):
        if not parameters.active[index]:
            continue
        length = name in ("d", "a", "x", "y", "z")
        limit = _FAR_LENGTH * table.chain.reach if length else np.pi
        near = _NEAR * (session.tolerances.length if length else session.tolerances.zero)
        offsets[row, parameters.columns.index(name)] = rng.uniform(-limit, limit) if far else rng.normal(0.0, near)
    clocks = first.state.time_offsets
    start = replace(first_state(session.with_clocks(clocks), table, offsets), time_offsets=clocks)
    return start if first.state.cameras else start.without_cameras


def _screen(
    session: Session, table: Geometry, blocks: Sequence[Observations], found: Sequence[Solution]
) -> list[Candidate]:
    settled = [solution for solution in found if solution.converged]
    best = min((solution.cost for solution in settled), default=np.inf)
    likely = [solution for solution in settled if solution.cost <= best + _CHANCE]
    kept = min(likely, key=lambda solution: _strangeness(session, solution), default=None)
    candidates: list[Candidate] = []
    for solution in found:
        if solution is kept:
            candidates.insert(0, Candidate(solution, True, "nearest to the drawing among the best"))
        elif not solution.converged:
            candidates.append(Candidate(solution, False, "the solver did not settle"))
        elif solution.cost > best + _CHANCE:
            reason = f"chi-square {solution.cost:.4g} against {best:.4g}: more than chance"
            candidates.append(Candidate(solution, False, reason))
        elif kept is not None and _same_arm(table, blocks, kept, solution):
            twin = not np.allclose(kept.state.offsets, solution.state.offsets, rtol=0.0, atol=1e-3)
            reason = "the same arm in other signs of its DH parameters" if twin else "the same minimum"
            candidates.append(Candidate(solution, False, reason))
        else:
            strangeness = _strangeness(session, solution)
            word = "outside tolerance" if strangeness > _INCONGRUENT else "farther from the drawing"
            candidates.append(Candidate(solution, False, f"{word}: an offset of {strangeness:.0f} tolerances"))
    return candidates


def _strangeness(session: Session, solution: Solution) -> float:
    """The largest offset in units of its tolerance."""
    tolerances, largest = session.tolerances, 0.0
    for row, name in solution.parameters.rows:
        offset = solution.state.offsets[row, solution.parameters.columns.index(name)]
        unit = tolerances.length if name in ("d", "a", "x", "y", "z") else tolerances.angle
        largest = max(largest, abs(offset) / unit if unit > 0.0 else 0.0)
    return largest


def _same_arm(table: Geometry, blocks: Sequence[Observations], a: Solution, b: Solution) -> bool:
    """Whether two solutions move the LEDs alike, wherever the arm goes, up to where base and cameras are."""
    for block in blocks:
        q = table.chain.random_values(len(block.q), np.random.default_rng(0))
        elsewhere = replace(block, q=q, trajectory=None)  # where an arm went that moved must not decide
        p, r = (view(table, elsewhere, solution.state) for solution in (a, b))
        for frame in np.unique(block.view_frame[block.valid]):
            here = block.valid & (block.view_frame == frame)
            T = kabsch(p[here], r[here])
            apart = np.linalg.norm(p[here] @ T[:3, :3].T + T[:3, 3] - r[here], axis=1)
            if np.sqrt(np.mean(apart**2)) > _SAME * table.chain.reach:
                return False
    return True
