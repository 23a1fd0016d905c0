"""Multistart: starts near and far, and minima distinguished by the kinematics they predict (METHOD 10)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import numbered
from urdfcal.errors import CalibrationError
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.assessment import IMPLAUSIBLE, corrections
from urdfcal.estimation.blocks.arm import ARM, no_offsets
from urdfcal.estimation.blocks.cameras import has_cameras, without_cameras
from urdfcal.estimation.joint_models import Readings
from urdfcal.estimation.joint_models.time_offset import time_offsets
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.session.trajectory import AT_REST

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.estimation.state import Key, State
    from urdfcal.session.model import Session

# Chi-square by which a minimum may lie above the best and still be chance: five standard deviations.
_CHANCE = 25.0
# Minima whose LEDs agree to this share of the arm's reach wherever it goes are one arm: the solver stops at 1e-6 of
# a standard deviation, other minima are millimetres away.
_SAME = 1e-5
# Near starts are drawn within a few tolerances; far ones have lengths off by up to this share of the reach and
# angles by up to half a turn.
_NEAR, _FAR_LENGTH = 3.0, 0.3


@dataclass(frozen=True, eq=False)
class Minimum:
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


def multistart(
    session: Session, problem: Problem, first: Solution, starts: int, seed: int, progress: Progress | None = None
) -> tuple[Minimum, ...]:
    """Start again from other arms, and screen what comes out.

    Args:
        session: what was measured.
        problem: of its measurements.
        first: the solution found from the nominal arm; it takes part.
        starts: how many others to start, every second one far beyond tolerance.
        seed: of the starts.
        progress: called after every solver step.

    Returns:
        All minima, the kept one first.
    """
    rng = np.random.default_rng(seed)
    found: list[Solution] = [first]
    failed: list[Minimum] = []
    for k in range(starts):
        try:
            start = _start(session, problem, first, rng, far=bool(k % 2))
            found.append(solve(problem, start, first.parameters, progress))
        except CalibrationError as error:
            failed.append(Minimum(None, False, f"no start: {error.what}"))
    return (*_screen(session, problem, found), *failed)


def _start(session: Session, problem: Problem, first: Solution, rng: np.random.Generator, *, far: bool) -> State:
    values: dict[Key[Any], Any] = {}
    for block in first.parameters.blocks:
        if not block.toleranced:
            continue
        step = np.zeros(len(block))
        for k in np.flatnonzero(block.active & np.isin(block.units, ("m", "rad"))):
            length = block.units[k] == "m"
            limit = _FAR_LENGTH * problem.arm.chain.reach if length else np.pi
            near = _NEAR * (session.tolerances.length if length else session.tolerances.zero)
            step[k] = rng.uniform(-limit, limit) if far else rng.normal(0.0, near)
        values[block.key] = block.retract(block.nominal, step)
    offsets = values.pop(ARM, no_offsets(problem.arm))
    known = {model.key: first.state[model.key] for model in problem.joint_models}
    session = session.with_time_offsets(time_offsets(first.state))
    start = first_state(session, problem.arm, offsets, {**known, **values})
    return start if has_cameras(first.state) else without_cameras(start)


def _screen(session: Session, problem: Problem, found: Sequence[Solution]) -> list[Minimum]:
    def largest(solution: Solution) -> float:
        moved = corrections(problem, solution, session.tolerances)
        return max((correction.tolerances for correction in moved), default=0.0)

    settled = [solution for solution in found if solution.converged]
    best = min((solution.cost for solution in settled), default=np.inf)
    likely = [solution for solution in settled if solution.cost <= best + _CHANCE]
    kept = min(likely, key=largest, default=None)
    candidates: list[Minimum] = []
    for solution in found:
        if solution is kept:
            candidates.insert(0, Minimum(solution, True, "nearest to nominal among the best"))
        elif not solution.converged:
            candidates.append(Minimum(solution, False, "the solver did not settle"))
        elif solution.cost > best + _CHANCE:
            reason = f"chi-square {solution.cost:.4g} against {best:.4g}: more than chance"
            candidates.append(Minimum(solution, False, reason))
        elif kept is not None and _same_arm(problem, kept, solution):
            twin = not np.allclose(kept.state[ARM], solution.state[ARM], rtol=0.0, atol=1e-3)
            reason = "the same arm in other signs of its DH parameters" if twin else "the same minimum"
            candidates.append(Minimum(solution, False, reason))
        else:
            word = "outside tolerance" if largest(solution) > IMPLAUSIBLE else "farther from nominal"
            candidates.append(Minimum(solution, False, f"{word}: an offset of {largest(solution):.0f} tolerances"))
    return candidates


def _same_arm(problem: Problem, a: Solution, b: Solution) -> bool:
    """Whether two solutions move the measured points alike, wherever the arm goes, up to where base and cameras are."""
    chain = problem.arm.chain
    for observed in problem.observations:
        q = chain.random_values(len(observed.pose), np.random.default_rng(0))
        # Where an arm that moved happened to go must not decide.
        same = observed.readings
        elsewhere = replace(observed, readings=Readings(problem.told(q), same.pose, AT_REST, same.part, same.torques))
        of_a, of_b = (
            elsewhere.table.points(elsewhere, problem.links(elsewhere.readings, of.state), of.state) for of in (a, b)
        )
        if of_a is None or of_b is None:
            continue
        (frames, p), (_, r) = of_a, of_b
        places = numbered([frames, observed.readings.part[:, None]])
        for place in np.unique(places[observed.valid]):
            here = observed.valid & (places == place)
            T = kabsch(p[here], r[here])
            apart = np.linalg.norm(p[here] @ T[:3, :3].T + T[:3, 3] - r[here], axis=1)
            if np.sqrt(np.mean(apart**2)) > _SAME * chain.reach:
                return False
    return True
