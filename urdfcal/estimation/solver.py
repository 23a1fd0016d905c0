"""Robust nonlinear least squares: Levenberg-Marquardt on normal equations accumulated over poses (METHOD 9).

Residuals are whitened by the noise of the measurements and of the joint readings, a Huber weight limits the pull of
each measurement, and what is left far outside the noise is taken out at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from urdfcal.arrays import covariance_of, one_blas_thread
from urdfcal.errors import CalibrationError, CameraError
from urdfcal.estimation.least_squares import LeastSquares, Neighbourhood, NormalEquations
from urdfcal.estimation.robust import REJECTED, HuberWeights, find_outliers, keep_weights, unit_weights

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.robust import Weights
    from urdfcal.estimation.state import State

# Ordinary sessions settle in ten; lenses that start a thousand pixels off need a hundred along a bent valley.
_MAX_ITERATIONS, _MAX_CUTS = 300, 5
# A session of more poses than this is first solved on an even selection of some: the rest then need few passes.
_MANY, _SOME = 1000, 300
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e16
# A step of this many standard deviations of the estimate is no step; the coarse one is for cross-validation.
_CONVERGED, _CONVERGED_COARSE = 1e-6, 1e-2
# Weights are settled when the step after they were renewed moves measurements by less than this share of their standard
# deviation, root mean square: it changes no decision on an outlier.
_SETTLED = 0.05
# Rounding of a cost that no longer falls.
_COST_ROUNDING = 1e-10
# A chi-square this many of its standard deviations above expectation is a misfit for certain (METHOD 12).
_CERTAIN = 3.0


class Progress(Protocol):
    """Called after every iteration with the cost so far."""

    def __call__(self, iteration: int, cost: float) -> None:
        """Take note of an accepted step."""


@dataclass(frozen=True, eq=False)
class Iteration:
    """One accepted step.

    Attributes:
        cost: weighted sum of squared whitened residuals, priors included.
        damping: Levenberg-Marquardt's lambda.
        step: its length in standard deviations of the estimate.
        state: after the step.
    """

    cost: float
    damping: float
    step: float
    state: State


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver arrived.

    Attributes:
        state: the estimate.
        parameters: what was estimated.
        information: (count, count) J^T J of the whitened residuals and the priors, outliers left out.
        norms: for each kind of measurement (N, m): whitened residual norm of each one.
        outlier: for each kind (N, m): taken out of the fit.
        kept: for each kind (N, m): the measurements that the fit rests on.
        cost: chi-square of residuals and priors, outliers left out.
        observations: scalar measurements used.
        history: accepted steps.
        converged: whether the last step was small.
        spread: (count, count) covariance over regions left out, which what is not modelled shows in; None where it is
            not known, or nothing of the kind is to be expected.
        doubt: (count, count) covariance over other joint models; None where it is not known.
    """

    state: State
    parameters: Parameters
    information: Floats
    norms: tuple[Floats, ...]
    outlier: tuple[Bools, ...]
    kept: tuple[Bools, ...]
    cost: float
    observations: int
    history: tuple[Iteration, ...]
    converged: bool
    spread: Floats | None = None
    doubt: Floats | None = None

    @property
    def reduced_chi2(self) -> float:
        """Chi-square per degree of freedom, priors counted as measurements; about 1 when the noise is as declared."""
        return self.cost / self.freedom if self.freedom > 0 else float("nan")

    @property
    def freedom(self) -> int:
        """Degrees of freedom: measured numbers and priors less parameters."""
        return self.observations + self.parameters.prior_count - self.parameters.count

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of outliers, and of measurements that the fit rests on."""
        outliers, kept = (sum(int(np.sum(part)) for part in parts) for parts in (self.outlier, self.kept))
        return outliers, kept

    @property
    def covariance(self) -> Floats:
        """(count, count) of the active parameters, with spread and doubt; of a misfit without spread, widened by it."""
        found = covariance_of(self.information)
        if self.spread is not None:
            found = found + self.spread
        elif self.misfit:
            found = found * self.reduced_chi2
        return found if self.doubt is None else found + self.doubt

    @property
    def misfit(self) -> bool:
        """Whether the residuals exceed the declared noise for certain."""
        return bool(self.reduced_chi2 > 1.0 + _CERTAIN * np.sqrt(2.0 / max(self.freedom, 1)))


def first_solved(problem: Problem) -> Problem:
    """The problem that is solved first: of thousands of poses an even selection, or the problem itself."""
    if max(len(observed.pose) for observed in problem.observations) <= _MANY:
        return problem
    some = problem.spread(_SOME)
    fewer = any(len(a.pose) < len(b.pose) for a, b in zip(some.observations, problem.observations, strict=True))
    return some if fewer else problem


def solve(problem: Problem, start: State, parameters: Parameters, progress: Progress | None = None) -> Solution:
    """Estimate the active parameters from a start that is near enough for Gauss-Newton.

    First Huber weights that follow a robust scale of the residuals (the nominal arm is many standard deviations off),
    of thousands of poses on an even selection; once they have settled, outliers are cut and least squares on the rest
    of all poses finishes, until the cut stays the same.

    Args:
        problem: what was measured, and of which arm.
        start: first state.
        parameters: what to estimate, with priors.
        progress: called after every step.

    Raises:
        CalibrationError: the start puts an LED behind a camera.
    """
    observations = problem.observations
    with one_blas_thread():
        whole = LeastSquares(problem, parameters)
        some = first_solved(problem)
        robust = whole if some is problem else LeastSquares(some, parameters)
        first, ones = robust.linearise(start), unit_weights(robust.problem.observations)
        descent = _descend(robust, first, ones, HuberWeights(), _FIRST_DAMPING, _settled(robust.problem), progress)
        history, at = list(descent.history), descent.at
        # Where the derivatives are no longer those of the start, the joint readings' noise may not be, either.
        if robust is not whole or at.J is not first.J:
            at = whole.linearise(descent.at.state)
        for _ in range(_MAX_CUTS):
            outlier = find_outliers(observations, at.norms)
            kept = [np.where(cut, REJECTED, 1.0) for cut in outlier]
            damping = min(descent.damping, _FIRST_DAMPING)
            descent = _descend(whole, at, kept, keep_weights, damping, _CONVERGED, progress)
            at = descent.at
            history += descent.history
            again = find_outliers(observations, at.norms)
            if all(np.array_equal(a, b) for a, b in zip(outlier, again, strict=True)):
                break
    used = tuple(observed.valid & ~cut for observed, cut in zip(observations, outlier, strict=True))
    return Solution(
        state=descent.at.state,
        parameters=parameters,
        information=descent.normal.H,
        norms=descent.normal.norms,
        outlier=tuple(outlier),
        kept=used,
        cost=descent.normal.cost,
        observations=sum(of.dimension * int(np.sum(use)) for of, use in zip(observations, used, strict=True)),
        history=tuple(history),
        converged=descent.converged,
    )


def sketch(
    problem: Problem, start: State, parameters: Parameters, steps: int, progress: Progress | None = None
) -> State:
    """Estimate roughly, to see whether measurements fit at all: with Huber weights, in at most so many steps.

    Args:
        problem: what was measured, and of which arm.
        start: first state.
        parameters: what to estimate, with priors.
        steps: after so many it ends where it is.
        progress: called after every step.

    Raises:
        CalibrationError: the start puts an LED behind a camera.
    """
    with one_blas_thread():
        robust = LeastSquares(problem, parameters)
        at, ones = robust.linearise(start), unit_weights(problem.observations)
        return _descend(robust, at, ones, HuberWeights(), _FIRST_DAMPING, _settled(problem), progress, steps).at.state


def refit(problem: Problem, kept: Sequence[Bools], start: Neighbourhood, parameters: Parameters) -> State:
    """Estimate from some of the measurements, near a start that is already good.

    Args:
        problem: what was measured.
        kept: for each kind (N, m): the measurements that count.
        start: the problem in the neighbourhood of the first state, see :meth:`LeastSquares.linearise`.
        parameters: what to estimate, with priors.
    """
    weights = [np.where(keep, 1.0, REJECTED) for keep in kept]
    with one_blas_thread():
        least_squares = LeastSquares(problem, parameters)
        return _descend(least_squares, start, weights, keep_weights, _FIRST_DAMPING, _CONVERGED_COARSE, None).at.state


@dataclass(frozen=True, eq=False)
class _Descent:
    """Where a descent ended.

    Attributes:
        at: its last state, and the neighbourhood.
        normal: the normal equations there.
        damping: Levenberg-Marquardt's lambda.
        history: accepted steps.
        converged: whether the last step was small.
    """

    at: Neighbourhood
    normal: NormalEquations
    damping: float
    history: tuple[Iteration, ...]
    converged: bool


def _descend(
    least_squares: LeastSquares,
    at: Neighbourhood,
    weights: Weights,
    renew: Callable[[Sequence[Observations], Sequence[Floats], Weights], Weights],
    damping: float,
    tolerance: float,
    progress: Progress | None,
    steps: int | None = None,
) -> _Descent:
    """Levenberg-Marquardt until steps are shorter than ``tolerance`` and stay so when weights are renewed.

    Damping follows the gain, the cost's fall over what the linear model promised (Nielsen, IMM-REP-1999-05). The
    joint readings' noise is that of the first state: a start may be another arm, but from there it hardly moves.
    """
    observations = least_squares.problem.observations
    seen = zip(at.residual, observations, strict=True)
    if not all(np.all(np.isfinite(residual[observed.valid])) for residual, observed in seen):
        remedy = "Check the cameras' order and places, the units of the joint readings, and the tip link."
        raise CalibrationError("the start puts an LED behind a camera", remedy=remedy)
    whitening = least_squares.whitening(at.noise, weights)
    normal = least_squares.evaluate(at, whitening)
    history: list[Iteration] = []
    most = _MAX_ITERATIONS if steps is None else steps
    growth, ahead, fresh = 2.0, np.inf, False
    step = _damped_step(normal, damping)
    while damping < _MOST_DAMPING and len(history) < most:
        if ahead < tolerance or not history:
            renewed = renew(observations, normal.norms, weights)
            same = all(np.array_equal(a, b) for a, b in zip(renewed, weights, strict=True))
            if ahead < tolerance and (same or fresh):
                break
            if not same:
                weights, whitening = renewed, least_squares.whitening(at.noise, renewed)
                normal = least_squares.evaluate(at, whitening)
                step = _damped_step(normal, damping)
            fresh = True
        promised = -float(step @ (2.0 * normal.g + normal.H @ step))
        try:
            candidate = least_squares.step(at, step)
            new = least_squares.evaluate(candidate, whitening)
            cost = new.cost
        except CameraError:  # a trial lens that is none
            cost = np.nan
        # NaN (an LED behind a camera) is no improvement either.
        if not cost <= normal.cost * (1.0 + _COST_ROUNDING) + _COST_ROUNDING:
            damping, growth = damping * growth, 2.0 * growth
            step = _damped_step(normal, damping)
            continue
        length = _length(normal, step)
        gain = (normal.cost - new.cost) / promised if promised > 0.0 else 1.0
        damping, growth = damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        at, normal = candidate, new
        step = _damped_step(normal, damping)
        following = _length(normal, step)
        # What is left if every step shrinks as the next one does, of which half is believed.
        ahead = following / (1.0 - min(following / length, 0.5)) if length > 0.0 else 0.0
        fresh = fresh and length < tolerance
        history.append(Iteration(normal.cost, damping, length, at.state))
        if progress is not None:
            progress(len(history), normal.cost)
    return _Descent(at, normal, damping, tuple(history), ahead < tolerance)


def _settled(problem: Problem) -> float:
    """The step below which weights are settled."""
    return _SETTLED * float(np.sqrt(sum(observed.count for observed in problem.observations)))


def _length(normal: NormalEquations, step: Floats) -> float:
    """The length of a step in standard deviations of the estimate."""
    return float(np.sqrt(max(float(step @ normal.H @ step), 0.0)))


def _damped_step(normal: NormalEquations, damping: float) -> Floats:
    """Solve the normal equations in column-scaled form, so that metres and radians weigh alike."""
    diagonal = np.diag(normal.H)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    H = normal.H * np.outer(scale, scale)
    return np.asarray(-scale * np.linalg.solve(H + damping * np.eye(len(H)), scale * normal.g))
