"""Robust nonlinear least squares: Levenberg-Marquardt on normal equations accumulated over poses (METHOD 9).

Residuals are whitened by the noise of the measurements and of the joint readings, a Huber weight limits the pull of
each measurement, and what is left far outside the noise is taken out at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from urdfcal.arrays import one_blas_thread
from urdfcal.errors import CalibrationError, CameraError
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.robust import REJECTED, HuberWeights, find_outliers, keep_weights, unit_weights
from urdfcal.estimation.whitening import JointNoise, Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.parameters import Parameters
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.robust import Weights
    from urdfcal.estimation.state import State

# Poses evaluated at a time: large enough to hide Python's overhead, small enough that a block's Jacobian
# (a few MB) stays in cache and memory does not grow with the session.
_BLOCK = 1024
# Ordinary sessions settle in ten; lenses that start a thousand pixels off need a hundred along a bent valley.
_MAX_ITERATIONS, _MAX_CUTS = 300, 5
# A session of more poses than this is first solved on an even selection of some: the rest then need few passes.
_MANY, _SOME = 1000, 300
# Within this distance (rad, m, focal lengths, s) derivatives are the same to one part in a few thousand: steps taken
# with them shrink by as much each, and the estimate is off by less than that share of a standard deviation.
_NEAR = 2e-4
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
        """(count, count) of the active parameters, widened by their spread, and for a misfit if that is not known."""
        scale = 1.0 / np.sqrt(np.diag(self.information))
        inverse: Floats = np.linalg.inv(self.information * np.outer(scale, scale)) * np.outer(scale, scale)
        if self.spread is not None:
            return inverse + self.spread
        return inverse * self.reduced_chi2 if self.misfit else inverse

    @property
    def misfit(self) -> bool:
        """Whether the residuals exceed the declared noise for certain."""
        return bool(self.reduced_chi2 > 1.0 + _CERTAIN * np.sqrt(2.0 / max(self.freedom, 1)))


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
        whole = _LeastSquares(problem, parameters)
        robust = whole
        if max(len(observed.pose) for observed in observations) > _MANY:
            robust = _LeastSquares(problem.spread(_SOME), parameters)
        first, ones = robust.linearise(start), unit_weights(robust.problem.observations)
        descent = _descend(robust, first, ones, HuberWeights(), _FIRST_DAMPING, robust.settled, progress)
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


def refit(problem: Problem, kept: Sequence[Bools], start: State, parameters: Parameters) -> State:
    """Estimate from some of the measurements, near a start that is already good.

    Args:
        problem: what was measured.
        kept: for each kind (N, m): the measurements that count.
        start: first state.
        parameters: what to estimate, with priors.
    """
    weights = [np.where(keep, 1.0, REJECTED) for keep in kept]
    with one_blas_thread():
        least_squares = _LeastSquares(problem, parameters)
        at = least_squares.linearise(start)
        return _descend(least_squares, at, weights, keep_weights, _FIRST_DAMPING, _CONVERGED_COARSE, None).at.state


def residual_norms(problem: Problem, state: State, parameters: Parameters) -> tuple[Floats, ...]:
    """Return the whitened residual norm (N, m) of every measurement at a state: joint readings' noise counts, too."""
    return _LeastSquares(problem, parameters).linearise(state).norms


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """The normal equations at a state, the cost, and each measurement's whitened residual norm on its own."""

    H: Floats
    g: Floats
    cost: float
    norms: tuple[Floats, ...]


@dataclass(frozen=True, eq=False)
class _Local:
    """The residuals at a state, and what they do in its neighbourhood.

    Attributes:
        state: where.
        residual: for each kind (N, m, D).
        J: for each kind (N, m D, count) derivative, taken here or nearby.
        drift: how far (rad, m, focal lengths, s) the state may be from where J was taken.
        noise: for each kind, of the joint readings; taken where the descent began.
    """

    state: State
    residual: tuple[Floats, ...]
    J: tuple[Floats, ...]
    drift: float
    noise: tuple[JointNoise, ...]

    @property
    def norms(self) -> tuple[Floats, ...]:
        """For each kind (N, m): whitened residual norm of every measurement on its own."""
        return tuple(noise.norms(residual) for noise, residual in zip(self.noise, self.residual, strict=True))


@dataclass(frozen=True, eq=False)
class _LeastSquares:
    """A problem and its parameters; evaluates states, knows nothing of the iteration."""

    problem: Problem
    parameters: Parameters

    @property
    def settled(self) -> float:
        """The step below which weights are settled."""
        return _SETTLED * float(np.sqrt(sum(observed.count for observed in self.problem.observations)))

    def linearise(self, state: State, noise: tuple[JointNoise, ...] | None = None) -> _Local:
        """Find residuals, derivatives, and the noise that the joint readings give at a state."""
        problem, count, readings = self.problem, self.parameters.count, self.problem.arm.chain.reading_jacobian
        residuals: list[Floats] = []
        derivatives: list[Floats] = []
        noises: list[JointNoise] = []
        for observed in problem.observations:
            tangent = Tangent.at(problem, observed, state, self.parameters)
            N, m, D = observed.value.shape
            residual, J = np.empty((N, m, D)), np.empty((N, m * D, count))
            joint = np.zeros((N, m * D, readings.shape[1] if problem.joint_sigma > 0.0 else 0))
            for poses in _chunks(N):
                at = tangent.linearise(poses)
                residual[poses], J[poses] = at.residual, at.J.reshape(-1, m * D, count)
                if noise is None and problem.joint_sigma > 0.0:
                    joint[poses] = joint_noise(at, readings, problem.joint_sigma)
            residuals.append(residual)
            derivatives.append(J)
            if noise is None:
                noises.append(JointNoise.of(observed.covariance, joint))
        return _Local(state, tuple(residuals), tuple(derivatives), 0.0, noise or tuple(noises))

    def step(self, at: _Local, step: Floats) -> _Local:
        """Find the residuals a step of the active parameters further; derivatives anew only where it leads far.

        Raises:
            CameraError: a lens that is none.
        """
        state = self.parameters.retract(at.state, step)
        scales = self.parameters.scales(at.state)[self.parameters.active]
        drift = at.drift + float(np.abs(step / scales).max(initial=0.0))
        if drift > _NEAR:
            return self.linearise(state, at.noise)
        residual = tuple(self.problem.residual(observed, state) for observed in self.problem.observations)
        return replace(at, state=state, residual=residual, drift=drift)

    def whitening(self, noise: Sequence[JointNoise], weights: Weights) -> tuple[Whitening, ...]:
        """Return for each kind what gives the residuals of whole poses unit variance."""
        return tuple(
            own.whitening(observed.covariance, weight)
            for observed, own, weight in zip(self.problem.observations, noise, weights, strict=True)
        )

    def evaluate(self, at: _Local, whitening: Sequence[Whitening]) -> _NormalEquations:
        """Accumulate the normal equations over all poses, whole poses whitened."""
        r, J = self.parameters.prior_residuals(at.state)
        H, g, cost = J.T @ J, J.T @ r, float(r @ r)
        for residual, J, W in zip(at.residual, at.J, whitening, strict=True):
            N, m, D = residual.shape
            for poses in _chunks(N):
                whitened = W.at(poses)(np.concatenate([residual[poses].reshape(-1, m * D, 1), J[poses]], axis=2))
                whitened = whitened.reshape(-1, 1 + J.shape[2])
                r, J_poses = whitened[:, 0], whitened[:, 1:]
                H += J_poses.T @ J_poses
                g += J_poses.T @ r
                cost += float(r @ r)
        return _NormalEquations(H, g, cost, at.norms)


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

    at: _Local
    normal: _NormalEquations
    damping: float
    history: tuple[Iteration, ...]
    converged: bool


def _descend(
    least_squares: _LeastSquares,
    at: _Local,
    weights: Weights,
    renew: Callable[[Sequence[Observations], Sequence[Floats], Weights], Weights],
    damping: float,
    tolerance: float,
    progress: Progress | None,
) -> _Descent:
    """Levenberg-Marquardt until steps are shorter than ``tolerance`` and stay so when weights are renewed.

    Damping follows the gain, the cost's fall over what the linear model promised (Nielsen, IMM-REP-1999-05). The
    joint readings' noise is that of the first state: a start may be another arm, but from there it hardly moves.
    """
    observations = least_squares.problem.observations
    whitening = least_squares.whitening(at.noise, weights)
    normal = least_squares.evaluate(at, whitening)
    if not np.isfinite(normal.cost):
        remedy = "Check the cameras' order and places, the units of the joint readings, and the tip link."
        raise CalibrationError("the start puts an LED behind a camera", remedy=remedy)
    history: list[Iteration] = []
    growth, length, ahead, fresh = 2.0, np.inf, np.inf, False
    while damping < _MOST_DAMPING and len(history) < _MAX_ITERATIONS:
        if ahead < tolerance or not history:
            renewed = renew(observations, normal.norms, weights)
            same = all(np.array_equal(a, b) for a, b in zip(renewed, weights, strict=True))
            if ahead < tolerance and (same or fresh):
                break
            if not same:
                weights, whitening = renewed, least_squares.whitening(at.noise, renewed)
                normal = least_squares.evaluate(at, whitening)
            length, fresh = np.inf, True
        step = _damped_step(normal, damping)
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
            continue
        before, length = length, float(np.sqrt(max(float(step @ normal.H @ step), 0.0)))
        ratio = min(length / before, 0.5) if before < np.inf else 0.5
        ahead = length * ratio / (1.0 - ratio)  # what is left if every step shrinks as this one did
        fresh = fresh and ahead < tolerance
        gain = (normal.cost - new.cost) / promised if promised > 0.0 else 1.0
        damping, growth = damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        at, normal = candidate, new
        history.append(Iteration(normal.cost, damping, length, at.state))
        if progress is not None:
            progress(len(history), normal.cost)
    return _Descent(at, normal, damping, tuple(history), ahead < tolerance)


def _damped_step(normal: _NormalEquations, damping: float) -> Floats:
    """Solve the normal equations in column-scaled form, so that metres and radians weigh alike."""
    diagonal = np.diag(normal.H)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    H = normal.H * np.outer(scale, scale)
    return np.asarray(-scale * np.linalg.solve(H + damping * np.eye(len(H)), scale * normal.g))


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _BLOCK, count)) for first in range(0, count, _BLOCK))
